"""Guided sessions: a whole calibration, step by step, with what is still to gain."""
