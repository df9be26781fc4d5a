"""Play that rests on the side that gravity pushes to."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import ndtr, ndtri

from calibration.effects.base import Coefficient, FittedCoefficient, Settings
from calibration.effects.context import EffectContext
from calibration.effects.load_shapes import TorqueFamily, gravity_shapes
from calibration.errors import ModelError
from calibration.numerics.statistics import halton
from calibration.observations import Floats

_SIGMA_RAD = 1e-3
_BOUND_RAD = 5e-3
_SPREAD, _OTHER = "spread", "other_Nm"
_LEAST_LOAD = 2e-3  # of the largest: what a machine leans, and its posture, are known to about 0.1 deg
_TERMS = 2
_GRID, _STEP = np.linspace(-2.0, 2.0, 9).tolist(), 0.2  # of the largest shape, and what is open between its points
_NEAR = 3.0  # times what is open of it: a load this far from zero has its sign for certain
_MOST_SHAPES = 3  # of a load that finer forms take; more hardly move its zero
_CLOUD, _FINER = 128, 0.15  # finer forms, and what is open between them


class GravityFlipPlay(TorqueFamily):
    """The joint gives way by half the play in the direction of its load, and flips over where the load does.

    The load is known from the rig file's masses, to +-15 %, so where it changes its sign is known to some tenths of a
    degree, and poses are many there: a face is drilled with the feed level. So variants have the masses at one of
    several places, with what is open about it. With t the load over what is open of it, the expected sign is
    2 Phi(t) - 1; and where one number moves the zero of all poses alike, the sign goes about this as a Brownian bridge
    in u = Phi(t), whose Karhunen-Loeve terms are sqrt(8) / (k pi) sin(k pi u), independent of each other (Shorack and
    Wellner 1986, chapter 5). The first of them have coefficients of their own.
    """

    name = "gravity_flip_play"
    equation = "d_theta = width / 2 * sign(torque)"
    source = "clearance of pins and gears under a load that changes sides"
    confused_with = ("joint_compliance", "backlash", "encoder_harmonic")
    revealed_by = "poses close to either side of where the joint's load changes its sign"

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        largest = context.greatest_torque(where)
        if largest == 0.0:
            return ()
        if context.is_torque_measured(where) or not context.rig.masses:
            return ({},)
        shapes = gravity_shapes(context, where, constant=True)
        load = context.torque(where)
        change = shapes(np.nan_to_num(load), context.torque_parts(where))
        if not len(shapes) or not (np.abs(load) < _NEAR * np.sqrt((change**2).sum(axis=1))).any():
            return ({},)
        common = {_SPREAD: _STEP, _OTHER: _LEAST_LOAD * largest}
        return ({}, *({**common, _shape(0): at} for at in _GRID))

    def refined(self, context: EffectContext, where: str, settings: Settings) -> tuple[Settings, ...]:
        """Return forms with masses drawn from their prior: a low-discrepancy sequence, made normal."""
        variants = self.variants(context, where)
        if len(variants) < 2:
            return ()
        shapes = min(len(gravity_shapes(context, where, constant=True)), _MOST_SHAPES)
        cloud = ndtri(halton(shapes, _CLOUD + 1)[1:])
        common = {**variants[1], _SPREAD: _FINER}
        return (settings, *({**common, **{_shape(k): p for k, p in enumerate(at)}} for at in cloud.tolist()))

    def settled(self, forms: Sequence[Settings], probability: Floats) -> Settings:
        """Return the mean of the masses; the first form where that is more likely than all others together."""
        if probability[0] > 0.5:
            return forms[0]
        finer, weight = forms[1:], probability[1:] / probability[1:].sum()
        return {name: float(weight @ [form[name] for form in finer]) for name in finer[0]}

    def odds(self, settings: Settings) -> float:
        """Return the prior odds of the masses; those of the rig file are in the middle of the grid as well."""
        return math.exp(-0.5 * settings.get(_shape(0), 0.0) ** 2)

    def names(self, settings: Settings) -> tuple[str, ...]:
        if not settings:
            return ("width_rad",)
        shapes = len(settings) - 2
        expected = {_SPREAD, _OTHER, *map(_shape, range(shapes))}
        if set(settings) != expected or not 0.0 < settings[_SPREAD] <= 1.0 or settings[_OTHER] <= 0.0:
            raise ValueError(f"the settings are {_SPREAD}, to 1, {_OTHER}, and {_shape(0)} ... for the load's shapes")
        return ("width_rad", *(f"flip{number}_rad" for number in range(1, _TERMS + 1)))

    def coefficients(self, context: EffectContext, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del context, where
        width, *flips = self.names(settings)
        return (
            Coefficient(width, "rad", _SIGMA_RAD, 0.0, _BOUND_RAD),
            *(Coefficient(name, "rad", _SIGMA_RAD, -_BOUND_RAD, _BOUND_RAD) for name in flips),
        )

    def reported(
        self, settings: Settings, coefficients: tuple[FittedCoefficient, ...]
    ) -> tuple[FittedCoefficient, ...]:
        del settings
        return coefficients[:1]

    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        load = context.torque(where)
        known = np.isfinite(load)[:, None]
        load = np.nan_to_num(load)
        if not settings:
            sharp: Floats = np.degrees(0.5) * known * np.sign(load)[:, None]
            return sharp
        shapes = gravity_shapes(context, where, constant=True)
        at, open_to = places_and_spreads(settings, len(shapes))
        change = shapes(load, context.torque_parts(where))
        wide = np.sqrt(((change * open_to) ** 2).sum(axis=1) + other_newton_m(settings) ** 2)
        u = ndtr((load + change[:, : len(at)] @ at) / wide)
        terms = np.arange(1, _TERMS + 1)
        about = math.sqrt(8.0) / (np.pi * terms) * np.sin(np.pi * terms * u[:, None])
        change_deg: Floats = np.degrees(0.5) * known * np.column_stack([2.0 * u - 1.0, about])
        return change_deg

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        del plausible, settings
        return float(np.degrees(0.5 * values[0])) ** 2


def places_and_spreads(settings: Settings, shapes: int) -> tuple[list[float], Floats]:
    """Return where the first shapes of the load are, in sigmas, and (shapes,) what is open of each.

    Raises:
        ModelError: the load has fewer shapes than the settings.
    """
    at = [settings[_shape(number)] for number in range(len(settings) - 2)]
    if len(at) > shapes:
        raise ModelError(f"the model has {len(at)} shapes of a load that has {shapes}; calibrate again")
    return at, np.where(np.arange(shapes) < len(at), settings[_SPREAD], 1.0)


def other_newton_m(settings: Settings) -> float:
    """Return what is open of the load beside its shapes, N m."""
    return settings[_OTHER]


def _shape(number: int) -> str:
    """Return the name of a setting: by how many sigmas a shape of the load differs from the rig file's masses."""
    return f"shape{number + 1}"


FAMILY = GravityFlipPlay()
