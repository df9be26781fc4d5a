"""Maintenance of a store while it is written: packing, retention, backups, checks."""
