"""The commands of `rigcal`."""
