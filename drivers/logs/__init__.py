"""Captured traffic as log files."""
