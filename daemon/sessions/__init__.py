"""Calibration sessions and station set-ups."""
