"""From observations to a calibrated model, in one call."""
