"""Model files, the live model and its predictions."""
