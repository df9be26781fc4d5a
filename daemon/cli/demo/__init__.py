"""The demonstration: an operator of the simulated rig, and the search for the effect that it hides."""
