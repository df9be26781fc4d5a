"""Physical effects that can be hidden in the simulated machine, written only for the simulator."""
