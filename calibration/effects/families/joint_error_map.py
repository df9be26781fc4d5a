"""A joint whose error is a curve of its own angle: the sum of gear, encoder disc and bearing errors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache

import numpy as np

from calibration.effects.base import Coefficient, FittedCoefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.numerics.jit import compiled
from calibration.observations import Floats

_RMS, _RMS_RAD, _RMS_BOUND_RAD = "rms_rad", 1e-3, 5e-3
_SIGMAS_RAD = (0.4e-3, 0.7e-3)  # prior sigmas of a weight; the RMS of the curve is about 0.7 times this
_LEAST_PIECES, _MOST_PIECES, _PIECE_RATIO = 9, 360, 1.5
_LEAST_PIECE_DEG = 1.25
_POSES_PER_PIECE = 2
_SAME_DEG = 0.1  # angles closer than this belong to the same pose
_WHOLE_TURN_DEG = 300.0  # a wider range counts as a full turn, with the curve closed
_GRID = 16  # points per piece
_ON_RANGE, _ON_TURN = {"low_deg", "high_deg", "pieces", "sigma_rad"}, {"pieces", "sigma_rad"}


class JointErrorMap(JointFamily):
    """A sum of cubic B-splines, evenly spaced over the range of the training data or over a full turn.

    With independent weights of equal size this is a stationary Gaussian process with wavelengths longer than about two
    pieces (Higdon 2002, process convolutions). The number of pieces sets the resolution of the curve and `sigma_rad`
    its size; the data select both. Only four splines are nonzero at any angle, which keeps predictions fast.

    The curve includes the slow parts that encoder_harmonic and angle_scale describe. Where one of these explains the
    data, it needs only one or two coefficients, so its evidence is greater. Beyond the trained range the curve is
    constant. A range of more than 300 deg counts as a full turn, and the curve is periodic.
    """

    name = "joint_error_map"
    equation = "d_theta = sum of c_i B_i(theta), B_i evenly spaced cubic B-splines, theta as read"
    source = "P-splines (Eilers and Marx 1996) with independent weights (Higdon 2002)"
    kind = "revolute"
    depends_on_readings_only = True
    confused_with = ("encoder_harmonic", "angle_scale", "joint_compliance")
    revealed_by = "poses that cover the joint's range densely, several in each wave of the curve"

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        reading = context.reading(where)
        poses = len(np.unique(np.rint(reading / _SAME_DEG)))
        range_deg = float(np.ptp(reading)) if len(reading) else 0.0
        span: dict[str, float] = {}
        if range_deg > _WHOLE_TURN_DEG:
            range_deg = 360.0
        else:
            span = {"low_deg": float(reading.min(initial=np.inf)), "high_deg": float(reading.max(initial=-np.inf))}
        most = min(poses / _POSES_PER_PIECE, range_deg / _LEAST_PIECE_DEG)
        found, pieces = [], float(_LEAST_PIECES)
        while pieces <= most:
            found += [{**span, "pieces": float(round(pieces)), "sigma_rad": sigma} for sigma in _SIGMAS_RAD]
            pieces *= _PIECE_RATIO
        return tuple(found)

    def names(self, settings: Settings) -> tuple[str, ...]:
        sound = set(settings) in (_ON_RANGE, _ON_TURN) and all(map(math.isfinite, settings.values()))
        sound = sound and settings["sigma_rad"] > 0.0
        sound = sound and settings["pieces"] in range(_LEAST_PIECES, _MOST_PIECES + 1)
        if not sound or settings.get("low_deg", -math.inf) >= settings.get("high_deg", math.inf):
            raise ValueError(
                f"the settings are pieces (a whole number from {_LEAST_PIECES} to {_MOST_PIECES}) and sigma_rad, with "
                "low_deg and high_deg unless it is a full turn"
            )
        return tuple(f"basis{number}_rad" for number in range(1, _count(settings) + 1))

    def coefficients(self, context: EffectContext, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        """Return the weights of the splines; their bounds allow a wave of the largest RMS."""
        del context, where
        bound = math.sqrt(2.0) * _RMS_BOUND_RAD
        return tuple(Coefficient(name, "rad", settings["sigma_rad"], -bound, bound) for name in self.names(settings))

    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        return _splines(context.reading(where), settings, math.degrees(1.0))

    def reported_limits(self) -> Mapping[str, tuple[float, float]]:
        return {_RMS: (0.0, _RMS_BOUND_RAD)}

    def reported(
        self, settings: Settings, coefficients: tuple[FittedCoefficient, ...]
    ) -> tuple[FittedCoefficient, ...]:
        """Return the RMS of the curve about its mean over its range, as the mean is not separable from a joint offset.

        Its standard error treats the errors of the weights as independent.
        """
        weights = np.array([c.value for c in coefficients])
        errors = np.array([c.standard_error for c in coefficients])
        moved = _squares(int(settings["pieces"]), "low_deg" not in settings) @ weights
        rms = math.sqrt(max(float(weights @ moved), 0.0))
        error = float(np.linalg.norm(moved * errors)) / rms if rms > 0.0 else float(np.linalg.norm(errors))
        return (FittedCoefficient(_RMS, "rad", rms, error, _RMS_RAD),)


def _count(settings: Settings) -> int:
    """Return the number of splines; on a range that is not a full turn, three extend beyond its ends."""
    return int(settings["pieces"]) + (3 if "low_deg" in settings else 0)


def _splines(angle_deg: Floats, settings: Settings, unit: float = 1.0) -> Floats:
    """Return the values (n, k) of all splines, multiplied by `unit`."""
    is_turn = "low_deg" not in settings
    low, high = (0.0, 360.0) if is_turn else (settings["low_deg"], settings["high_deg"])
    out = np.zeros((len(angle_deg), _count(settings)))
    _fill(np.ascontiguousarray(angle_deg), low, high, int(settings["pieces"]), is_turn, unit, out)
    return out


@cache
def _squares(pieces: int, is_turn: bool) -> Floats:
    """Return the covariance S (k, k) of the splines over the range; w' S w is the variance of a curve."""
    settings = {"pieces": float(pieces), "sigma_rad": 1.0} | ({} if is_turn else {"low_deg": 0.0, "high_deg": 360.0})
    middle_deg = np.asarray((np.arange(_GRID * pieces) + 0.5) * (360.0 / (_GRID * pieces)), dtype=np.float64)
    values = _splines(middle_deg, settings)
    from_mean = values - values.mean(axis=0)
    return np.asarray(from_mean.T @ from_mean / len(middle_deg))


@compiled
def _fill(angle_deg: Floats, low: float, high: float, pieces: int, is_turn: bool, unit: float, out: Floats) -> None:
    """Write the four nonzero splines of each angle, multiplied by `unit`, into its row of zeros."""
    for n in range(len(angle_deg)):
        if not math.isfinite(angle_deg[n]):
            out[n] = math.nan  # propagate NaN, which must not become an index
            continue
        at = (angle_deg[n] - low) / (high - low)
        at = pieces * (at - np.floor(at) if is_turn else min(1.0, max(0.0, at)))
        piece = min(int(at), pieces - 1)
        u = at - piece
        v = 1.0 - u
        weights = (
            v * v * v / 6.0,
            (4.0 + 3.0 * u * u * (u - 2.0)) / 6.0,
            (4.0 + 3.0 * v * v * (v - 2.0)) / 6.0,
            u * u * u / 6.0,
        )
        for i in range(4):
            out[n, (piece + i) % out.shape[1]] = unit * weights[i]


FAMILY = JointErrorMap()
