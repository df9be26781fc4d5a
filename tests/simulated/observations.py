"""Observations of a simulated machine, as `rigcal simulate` makes them."""

from simulators.rig.observations import anchored_truth as anchored_truth
from simulators.rig.observations import simulate_observations as simulate_observations
