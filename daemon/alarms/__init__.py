"""Alarms: what is wrong, since when, and what to do about it. Rules find the faults; the board keeps the alarms."""
