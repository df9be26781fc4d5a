"""Evaluation of a model on observations, and comparison with the live model."""
