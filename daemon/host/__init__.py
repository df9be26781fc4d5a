"""The computer that the daemon runs on: its service manager, its terminals and its files."""
