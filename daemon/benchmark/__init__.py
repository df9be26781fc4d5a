"""The benchmark of the gap workflow: blind cases, answers of worker processes, scores."""
