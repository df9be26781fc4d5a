"""A joint that deflects under its load, linearly or along a curve."""

from __future__ import annotations

from functools import cache

import numpy as np

from calibration.effects.base import Coefficient, Settings
from calibration.effects.context import EffectContext
from calibration.effects.load_shapes import (
    UNIT,
    TorqueFamily,
    UncertainLoadFamily,
    gravity_shapes,
    load_columns,
    load_variants,
    part_coefficients,
    part_names,
)
from calibration.numerics.jit import compiled
from calibration.observations import Floats

_LINEAR = "compliance_rad_per_Nm"
_SIGMA_RAD = 1e-3  # at the largest torque
_BOUND_RAD = 20e-3
_KNOTS = 7
_BENDS_RAD = (0.15e-3, 0.5e-3, 1.5e-3)
_BEND_BOUND_RAD = 50e-3
_KNOT_POWERS = (1.0, 2.0)
_SYMMETRIC, _ASYMMETRIC = {"torque_Nm", "knot_power", "bend_rad"}, {"low_Nm", "high_Nm", "bend_rad"}
_LOAD_SIGMA = "load_sigma"  # a setting of all variants with a computed load, linear or curved
_ASYMMETRIC_ODDS = 0.01  # relative to the symmetric curves
_CURVED_ODDS = 0.2  # of all curves of a computed load together, relative to the linear variants
_UNKNOWN_LOADS = 101


class JointCompliance(UncertainLoadFamily, TorqueFamily):
    """Deflection by the gravity torque, with a stiffness that is constant or changes smoothly with the torque.

    Gears stiffen as they wind up: harmonic drives in three steps, bearings and teeth with a soft zone around zero. The
    curved variants add a natural cubic spline of s, the torque divided by the largest torque of the training data. Its
    coefficients are the changes of slope at the knots, in rad per unit of s. They are independent a priori with size
    `bend_rad`: the prior of a smoothing spline (Wahba 1978). Beyond the last knot the spline continues linearly.

    If the load is computed, the linear variants also include the uncertainty of the load's course due to uncertain
    masses, and a curve has low prior odds, as residuals of masses and of other joints often resemble one. A measured
    load is more conclusive.

    A symmetric curve is odd, g(-s) = -g(s), so that data of one side determine the other. Its knots are spaced evenly
    (`knot_power` 1) or denser towards zero (2). An asymmetric curve has s from the lowest to the highest torque and
    evenly spaced knots; gears rarely behave like this.
    """

    name = "joint_compliance"
    equation = "d_theta = compliance * torque [+ g(s), g a spline, s = torque / largest torque]"
    source = "ICIC 2020, Eqs. 16, 17; curve: stiffness of harmonic drives (Tuttle and Seering 1996)"
    confused_with = ("boom_droop", "encoder_harmonic", "payload_change")
    revealed_by = "the same reading of the joint at low and high load: short and long reach, with and without a payload"

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        torque = context.greatest_torque(where)
        if torque == 0.0:
            return ()
        measured = context.is_torque_measured(where)
        straight = ({},) if measured else load_variants(gravity_shapes(context, where), _SIGMA_RAD / torque)
        known = context.torque(where)[self.known(context, where)]
        low, high = float(known.min(initial=np.inf)), float(known.max(initial=-np.inf))
        if high <= low:
            return straight
        most = max(-low, high)
        curves: tuple[Settings, ...] = (
            *({"torque_Nm": most, "knot_power": power, "bend_rad": b} for power in _KNOT_POWERS for b in _BENDS_RAD),
            *({"low_Nm": low, "high_Nm": high, "bend_rad": b} for b in _BENDS_RAD),
        )
        return (*straight, *({**straight[0], **curve} for curve in curves))

    def odds(self, settings: Settings) -> float:
        if "bend_rad" not in settings:
            return 1.0
        odds = _CURVED_ODDS / (len(_KNOT_POWERS) * len(_BENDS_RAD)) if _LOAD_SIGMA in settings else 1.0
        return odds * (_ASYMMETRIC_ODDS if "low_Nm" in settings else 1.0)

    def names(self, settings: Settings) -> tuple[str, ...]:
        if "bend_rad" not in settings:
            return (_LINEAR, *part_names(settings))
        curve = {name: value for name, value in settings.items() if name != _LOAD_SIGMA}
        if set(curve) == _SYMMETRIC:
            sound = settings["torque_Nm"] > 0.0 and settings["knot_power"] in _KNOT_POWERS
        else:
            sound = set(curve) == _ASYMMETRIC and settings["low_Nm"] < settings["high_Nm"]
        if not sound or settings.get(_LOAD_SIGMA, 0.0) < 0.0:
            raise ValueError(
                "the settings of a curve are bend_rad with torque_Nm and knot_power 1 or 2, or with low_Nm and high_Nm"
            )
        return (_LINEAR, *(f"bend{knot}_rad" for knot in range(1, _KNOTS + 1)))

    def coefficients(self, context: EffectContext, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        torque = context.greatest_torque(where)
        linear, *bends = self.names(settings)
        most = _BOUND_RAD / torque
        # A drive may report the holding torque instead of the load, with the opposite sign.
        least = -most if context.is_torque_measured(where) else 0.0
        own = Coefficient(linear, UNIT, _SIGMA_RAD / torque, least, most)
        if "bend_rad" not in settings:
            return (own, *part_coefficients(settings, most))
        return (
            own,
            *(Coefficient(name, "rad", settings["bend_rad"], -_BEND_BOUND_RAD, _BEND_BOUND_RAD) for name in bends),
        )

    def has_implausible_shape(self, settings: Settings, values: Floats, standard_errors: Floats) -> bool:
        return "bend_rad" not in settings and super().has_implausible_shape(settings, values, standard_errors)

    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        load = context.torque(where)
        known = np.isfinite(load)
        torque = np.where(known, load, 0.0)
        if "bend_rad" in settings:
            return np.degrees(known[:, None] * _curved(torque, settings))
        columns = load_columns(
            torque, settings, lambda: gravity_shapes(context, where), lambda: context.torque_parts(where)
        )
        return np.degrees(columns)

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        """Return the mean square for a link in any direction: its load varies as a sine within the training range."""
        most = _SIGMA_RAD / float(plausible[0])  # inverse of `coefficients`
        low, high = (settings["low_Nm"], settings["high_Nm"]) if "low_Nm" in settings else (-most, most)
        turns = np.sin(np.linspace(-0.5, 0.5, _UNKNOWN_LOADS) * np.pi)
        torque = 0.5 * (low + high) + 0.5 * (high - low) * turns
        # The shapes of a linear variant are small compared with the compliance itself.
        change = _curved(torque, settings) @ values if "bend_rad" in settings else torque * values[0]
        return float(np.mean(np.degrees(change) ** 2))


def _curved(torque: Floats, settings: Settings) -> Floats:
    """Return the deflection (n, k) in rad per unit of each coefficient of a curve."""
    return np.hstack([torque[:, None], _curves(torque, settings)])


def _curves(torque: Floats, settings: Settings) -> Floats:
    """Return the splines (n, knots), rad per unit change of slope at each knot.

    The best fitting straight line over the whole range is subtracted, so that the compliance is the mean one.
    """
    if "torque_Nm" in settings:
        return _straightened(torque / settings["torque_Nm"], settings["knot_power"])
    low, high = settings["low_Nm"], settings["high_Nm"]
    return _straightened((2.0 * torque - low - high) / (high - low), None)


def _straightened(s: Floats, knot_power: float | None) -> Floats:
    """Return the splines (n, knots) at loads between -1 and 1; symmetric if there is a knot power."""
    knots, line = shape_of_curve(knot_power)
    out = np.empty((len(s), _KNOTS))
    _bent(np.ascontiguousarray(s), knots, line, knot_power is not None, out)
    return out


@cache
def shape_of_curve(knot_power: float | None) -> tuple[Floats, Floats]:
    """Return the knots, and the best fitting straight lines (2, inner knots) of the splines between -1 and 1."""
    spread = np.linspace(0.0, 1.0, _KNOTS + 2)
    knots = 2.0 * spread - 1.0 if knot_power is None else spread**knot_power
    whole = np.linspace(-1.0, 1.0, 201)
    over = np.empty((len(whole), _KNOTS))
    _bent(whole, knots, np.zeros((2, _KNOTS)), knot_power is not None, over)
    return knots, np.asarray(np.polynomial.polynomial.polyfit(whole, over, 1), dtype=np.float64)


@compiled
def _bent(s: Floats, knots: Floats, line: Floats, symmetric: bool, out: Floats) -> None:
    """Fill `out` (n, inner knots) with cubic splines whose slope changes by 1 around one knot, minus `line`.

    The second derivative is a triangle from the preceding knot to the following one.
    """
    for n in range(len(s)):
        for k in range(out.shape[1]):
            left, at, right = knots[k], knots[k + 1], knots[k + 2]
            value = _triangle(s[n], left, at, right)
            if symmetric:
                value -= _triangle(-s[n], left, at, right)
            out[n, k] = value - line[0, k] - s[n] * line[1, k]


@compiled
def _triangle(s: float, left: float, at: float, right: float) -> float:
    a, b, c = abs(s - left) ** 3, abs(s - at) ** 3, abs(s - right) ** 3
    return ((c - b) / (right - at) - (b - a) / (at - left)) / (6.0 * (right - left))


FAMILY = JointCompliance()
