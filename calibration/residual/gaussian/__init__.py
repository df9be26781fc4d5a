"""Gaussian processes on joint errors."""
