"""Comparisons of calibration methods on the same data."""
