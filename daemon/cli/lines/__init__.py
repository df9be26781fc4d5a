"""Text for people about the daemon's state, jobs, clock and rig."""
