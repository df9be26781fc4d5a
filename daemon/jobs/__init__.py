"""Background jobs: scheduling, running, results."""
