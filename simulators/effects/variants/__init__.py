"""Particular forms of library effects: gear teeth make an error map, a reducer is compliant."""
