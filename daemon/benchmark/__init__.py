"""Benchmark of the gap workflow: blind cases, answers from worker processes, scores."""
