"""Points that fill a box evenly (Halton 1960). scipy.stats has them too, and takes half a second to import."""

from __future__ import annotations

import itertools

import numpy as np

from calibration.observations import Floats


def halton(dimensions: int, count: int) -> Floats:
    """(count, dimensions) points in [0, 1): 0, 1, 2, ... with their digits mirrored at the point, in prime bases."""
    points = np.zeros((count, dimensions))
    primes = (n for n in itertools.count(2) if all(n % divisor for divisor in range(2, n)))
    for axis, base in zip(range(dimensions), primes, strict=False):
        left, unit = np.arange(count), 1.0 / base
        while left.any():
            left, digit = np.divmod(left, base)
            points[:, axis] += unit * digit
            unit /= base
    return points
