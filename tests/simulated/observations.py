"""Observations of a simulated machine, as `rigcal simulate` makes them."""

from simulators.rig.observations import anchored_truth, simulate_observations

__all__ = ["anchored_truth", "simulate_observations"]
