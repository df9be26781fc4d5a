"""Metrics, and notices of alarms, for people who are elsewhere."""
