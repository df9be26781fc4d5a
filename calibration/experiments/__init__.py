"""Comparisons of methods on the same data."""
