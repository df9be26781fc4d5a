"""Benchmark cases with hidden effects."""
