"""Design of poses: which to measure so that a model becomes as true as it can."""
