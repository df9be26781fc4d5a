"""Physical effects that the simulated machine can hide, written for the simulator alone."""
