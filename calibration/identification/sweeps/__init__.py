"""Single-joint sweeps: the axes that their circles and lines show."""
