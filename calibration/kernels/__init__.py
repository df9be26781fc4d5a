"""Compiled loops: fitness of whole populations, positions with their derivatives."""

from calibration.kernels.fitness import Fitness, evaluate

__all__ = ["Fitness", "evaluate"]
