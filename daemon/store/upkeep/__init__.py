"""Looks after a store while it is written to: packing, retention, backups, checks."""
