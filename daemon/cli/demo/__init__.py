"""The demonstration: an operator of the simulated rig, and the search for its hidden effect."""
