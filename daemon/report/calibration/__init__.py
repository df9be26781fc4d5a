"""The calibration report: its input, its figures and its page."""
