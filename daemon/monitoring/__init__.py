"""Metrics, and notices of alarms, for people who are not at the machine."""
