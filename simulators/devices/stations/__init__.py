"""Simulated total stations."""
