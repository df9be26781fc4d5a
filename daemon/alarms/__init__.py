"""Alarms: what is wrong, since when, and what to do about it. Rules say it, the board keeps it."""
