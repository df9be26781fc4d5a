"""What leaves the daemon for people who are elsewhere: metrics, and notices of alarms."""
