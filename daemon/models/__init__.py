"""Model files, the live model and what it predicts."""
