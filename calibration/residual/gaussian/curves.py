"""Curves over one or two variables as sums of sines: a Gaussian process on an interval.

A stationary Gaussian process on [-L, L] is a sum of the Laplacian's eigenfunctions with independent weights, whose
variances are the spectral density at their frequencies (Solin and Särkkä 2020, Hilbert space methods for reduced-rank
Gaussian process regression). For a periodic variable the eigenfunctions are sines and cosines of the angle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.numerics.jit import compiled, part
from calibration.observations import Floats

Integers = NDArray[np.intp]

PADDING = 1.2  # width of the interval, relative to the variable's range
_ROUGHNESS = 1.5  # exponent of the square root of a Matern 5/2 spectral density
_LEAST_RANGE = 1e-9
_MOST_WAVES = 256


@dataclass(frozen=True)
class Variable:
    """A variable of curves.

    Attributes:
        low, high: its range in training; values beyond it are replaced by the nearest end.
        is_periodic: whether it is an angle, deg, that covers whole turns.
    """

    low: float
    high: float
    is_periodic: bool

    def check(self) -> None:
        """Raise ValueError unless the range is finite and in order."""
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low <= self.high):
            raise ValueError("a variable of the Gaussian process has no valid range")

    def scaled(self, value: Floats) -> Floats:
        """Scale values (n,) to [-1, 1], or to half turns if periodic; NaN stays NaN."""
        if self.is_periodic:
            return np.asarray(value / 180.0)
        middle, half = 0.5 * (self.high + self.low), max(0.5 * (self.high - self.low), _LEAST_RANGE)
        return np.asarray(np.clip((value - middle) / half, -1.0, 1.0))


def waves(axis: Variable, scaled: Floats, count: int) -> tuple[Floats, Floats]:
    """Evaluate the eigenfunctions of the lowest frequencies.

    Args:
        axis: the variable.
        scaled: (n,) scaled values; all functions are 0 at NaN.
        count: number of functions, even for a periodic variable.

    Returns:
        (n, count) values, (count,) frequencies in rad per unit of the scaled variable.
    """
    known = np.isfinite(scaled)
    at = np.where(known, scaled, 0.0)
    if axis.is_periodic:
        turns = np.arange(1, count // 2 + 1) * math.pi
        angle = np.outer(at, turns)
        values, frequency = np.hstack([np.cos(angle), np.sin(angle)]), np.concatenate([turns, turns])
    else:
        frequency = np.arange(1, count + 1) * (math.pi / (2.0 * PADDING))
        values = np.sin(np.outer(at + PADDING, frequency))
    return values * known[:, None], frequency


def products(one: Floats, other: Floats) -> Floats:
    """Return the (n, a * b) products of (n, a) and (n, b), with the index of the second varying fastest."""
    return np.asarray((one[:, :, None] * other[:, None, :]).reshape(len(one), -1))


def log_amplitudes(square_frequency: Floats, log_length: Floats | float) -> Floats:
    """Return the logarithm of a weight's standard deviation relative to that at frequency 0 (Matern 5/2).

    Args:
        square_frequency: (m,) squared frequencies, in rad per unit of the scaled variable.
        log_length: logarithm of the correlation length.
    """
    return np.asarray(-_ROUGHNESS * np.log1p(square_frequency * np.exp(2.0 * np.asarray(log_length))))


def slope_by_log_length(square_frequency: Floats, log_length: Floats | float) -> Floats:
    """Return the derivative of `log_amplitudes` by the logarithm of the length."""
    size = square_frequency * np.exp(2.0 * np.asarray(log_length))
    return np.asarray(-2.0 * _ROUGHNESS * size / (1.0 + size))


@dataclass(frozen=True)
class Curve:
    """One term of a sum: an error as a function of one or two variables.

    Attributes:
        lever: index of the joint with the error; indices after the joints are the base frame's x, y, z.
        axes: indices of one or two variables.
        counts: number of eigenfunctions of each variable.
    """

    lever: int
    axes: tuple[int, ...]
    counts: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of weights."""
        return math.prod(self.counts)

    def check(self, axes: Sequence[Variable]) -> None:
        """Raise ValueError unless it is a valid curve over some of these variables."""
        sound = len(self.axes) == len(self.counts) in (1, 2) and self.lever >= 0
        sound = sound and all(0 <= a < len(axes) for a in self.axes) and all(0 < c <= _MOST_WAVES for c in self.counts)
        if not sound or any(axes[a].is_periodic and c % 2 for a, c in zip(self.axes, self.counts, strict=True)):
            raise ValueError("a curve of the Gaussian process is not over variables of the process")


class CurveSum:
    """Curves with their weights, compiled for prediction.

    Args:
        axes: variables.
        curves: terms.
        weights: (sum of sizes,) weights, deg or mm for a joint, mm for a base axis.
    """

    def __init__(self, axes: Sequence[Variable], curves: Sequence[Curve], weights: Floats) -> None:
        self._middle = np.array([0.5 * (axis.high + axis.low) for axis in axes])
        self._half = np.array([max(0.5 * (axis.high - axis.low), _LEAST_RANGE) for axis in axes])
        self._is_periodic = np.array([axis.is_periodic for axis in axes], dtype=np.bool_)
        self._lever = np.array([curve.lever for curve in curves], dtype=np.intp)
        self._axis = np.array([[c.axes[0], c.axes[-1] if len(c.axes) > 1 else -1] for c in curves], dtype=np.intp)
        self._count = np.array([[c.counts[0], c.counts[-1] if len(c.axes) > 1 else 1] for c in curves], dtype=np.intp)
        self._axis, self._count = self._axis.reshape(-1, 2), self._count.reshape(-1, 2)
        self._weights = np.ascontiguousarray(weights)

    def moved_mm(self, values: Floats, joint_jacobian: Floats) -> Floats:
        """Return the (n, 3) displacement by the curves in the base frame, mm.

        Args:
            values: (n, axes) variables; terms with a variable that is NaN are left out.
            joint_jacobian: (n, 3, joints) mm per deg or mm.
        """
        out = np.zeros((len(values), 3))
        _moved(
            np.ascontiguousarray(values),
            np.ascontiguousarray(joint_jacobian),
            self._middle,
            self._half,
            self._is_periodic,
            self._lever,
            self._axis,
            self._count,
            self._weights,
            out,
        )
        return out


@part()
def _sines(angle: float, count: int, out: Floats) -> None:
    """Write sin(k * angle), k = 1 .. count, to `out` by Chebyshev's recurrence."""
    twice = 2.0 * math.cos(angle)
    before, now = 0.0, math.sin(angle)
    for k in range(count):
        out[k] = now
        before, now = now, twice * now - before


@part()
def _cosines(angle: float, count: int, out: Floats) -> None:
    """Write cos(k * angle), k = 1 .. count, to `out`."""
    twice = 2.0 * math.cos(angle)
    before, now = 1.0, 0.5 * twice
    for k in range(count):
        out[k] = now
        before, now = now, twice * now - before


@part()
def _waves(value: float, middle: float, half: float, is_periodic: bool, count: int, out: Floats) -> None:
    """Write the eigenfunctions (see `waves`) at one value to `out`."""
    if not math.isfinite(value):
        out[:count] = 0.0
    elif is_periodic:
        angle = value * (math.pi / 180.0)
        _cosines(angle, count // 2, out)
        _sines(angle, count // 2, out[count // 2 :])
    else:
        scaled = min(1.0, max(-1.0, (value - middle) / half))
        _sines((scaled + PADDING) * (math.pi / (2.0 * PADDING)), count, out)


@compiled
def _moved(
    values: Floats,
    joint_jacobian: Floats,
    middle: Floats,
    half: Floats,
    is_periodic: NDArray[np.bool_],
    lever: Integers,
    axis: Integers,
    count: Integers,
    weights: Floats,
    out: Floats,
) -> None:
    joints = joint_jacobian.shape[2]
    one, other = np.empty(_MOST_WAVES), np.empty(_MOST_WAVES)
    for row in range(len(values)):
        at = 0
        for term in range(len(lever)):
            a, b = axis[term]
            m, k = count[term]
            _waves(values[row, a], middle[a], half[a], is_periodic[a], m, one)
            error = 0.0
            if b < 0:
                for i in range(m):
                    error += one[i] * weights[at + i]
            else:
                _waves(values[row, b], middle[b], half[b], is_periodic[b], k, other)
                for i in range(m):
                    inner = 0.0
                    for j in range(k):
                        inner += other[j] * weights[at + i * k + j]
                    error += one[i] * inner
            at += m * k
            if lever[term] < joints:
                for i in range(3):
                    out[row, i] += joint_jacobian[row, i, lever[term]] * error
            else:
                out[row, lever[term] - joints] += error
