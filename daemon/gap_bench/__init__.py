"""The benchmark of the gap workflow: blind data from a keeper process, answers from workers, scores after unsealing."""
