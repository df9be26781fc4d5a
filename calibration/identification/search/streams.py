"""Counter-based random numbers: every draw is a function of (seed, generation, candidate, number of the draw).

SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014) addressed by its
counter. There is no state, so the result of a search does not depend on which worker computes a candidate or on
whether the search was interrupted and resumed.
"""

from __future__ import annotations

import numpy as np

from calibration.numerics.jit import compiled
from calibration.observations import Floats

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_UNIT = 2.0**-53


def word(seed: int) -> np.uint64:
    """Return any integer modulo 2^64, as the seed of streams."""
    return np.uint64(seed % 2**64)


@compiled
def mixed(z: np.uint64) -> np.uint64:
    """Return SplitMix64's finaliser of `z`: a bijection of 64 bits that removes the pattern of a counter."""
    z = (z ^ (z >> _S30)) * _FIRST
    z = (z ^ (z >> _S27)) * _SECOND
    return z ^ (z >> _S31)


@compiled
def stream(seed: np.uint64, generation: int, candidate: int) -> np.uint64:
    """Return the key of the draws for one candidate of one generation."""
    key = mixed(np.uint64(seed) + _GAMMA)
    key = mixed(key ^ (np.uint64(generation) + _GAMMA))
    return mixed(key ^ (np.uint64(candidate) + _GAMMA))


@compiled
def uniform(key: np.uint64, draw: int) -> float:
    """Return draw number `draw` of a stream, uniform in [0, 1)."""
    return float(mixed(key + np.uint64(draw) * _GAMMA) >> _S11) * _UNIT


@compiled
def below(key: np.uint64, draw: int, n: int) -> int:
    """Return draw number `draw` of a stream, an integer from 0 to n - 1 (bias below n / 2^53)."""
    return int(uniform(key, draw) * n)


@compiled
def scatter(seed: np.uint64, generation: int, first: int, lower: Floats, upper: Floats, population: Floats) -> None:
    """Fill a population (n, p) uniformly from a box; the candidates have the numbers `first` and up."""
    n, p = population.shape
    for i in range(n):
        key = stream(seed, generation, first + i)
        for j in range(p):
            population[i, j] = lower[j] + (upper[j] - lower[j]) * uniform(key, j)
