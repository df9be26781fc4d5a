"""The daemon's state, jobs, clock and rig in lines for people."""
