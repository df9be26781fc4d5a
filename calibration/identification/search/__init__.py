"""Global search: differential evolution on islands."""
