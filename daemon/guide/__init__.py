"""Guided sessions: a whole calibration, step by step, with estimates of the remaining gain."""
