"""The calibrated model: its data, files, predictions, warnings and inverse."""
