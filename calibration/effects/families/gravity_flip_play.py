"""Play of a joint that gravity pushes to one side."""

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
_LEAST_LOAD = 2e-3  # uncertainty as a share of the largest load: inclination and posture are known to about 0.1 deg
_TERMS = 2
_GRID, _STEP = np.linspace(-2.0, 2.0, 9).tolist(), 0.2  # grid of the largest shape, and sigma between its points
_NEAR = 3.0  # a load further from zero than this number of sigmas has a certain sign
_MOST_SHAPES = 3  # shapes of a load that finer variants vary; more hardly move its zero
_CLOUD, _FINER = 128, 0.15  # number of finer variants, and sigma between them


class GravityFlipPlay(TorqueFamily):
    """The joint moves by half the play in the direction of its load, and to the other side where the load changes sign.

    The load follows from the rig file's masses, to +-15 %. The angle at which it changes sign is therefore uncertain by
    some tenths of a degree, and many poses are near it, as a face is drilled with the feed level. Variants therefore
    place the masses at one of several values, with the remaining uncertainty around it. With t the load divided by its
    uncertainty, the expected sign is 2 Phi(t) - 1. Where a single number moves the zero of all poses together, the
    deviation of the sign from this is a Brownian bridge in u = Phi(t), with the independent Karhunen-Loeve terms
    sqrt(8) / (k pi) sin(k pi u) (Shorack and Wellner 1986, chapter 5). The first terms have coefficients.
    """

    name = "gravity_flip_play"
    equation = "d_theta = width / 2 * sign(torque)"
    source = "clearance of pins and gears under a load that changes sign"
    confused_with = ("joint_compliance", "backlash", "encoder_harmonic")
    revealed_by = "poses close to the sign change of the joint's load, on both sides"

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
        """Return variants with masses from their normal prior, by a transformed low-discrepancy sequence."""
        variants = self.variants(context, where)
        if len(variants) < 2:
            return ()
        shapes = min(len(gravity_shapes(context, where, constant=True)), _MOST_SHAPES)
        cloud = ndtri(halton(shapes, _CLOUD + 1)[1:])
        common = {**variants[1], _SPREAD: _FINER}
        return (settings, *({**common, **{_shape(k): p for k, p in enumerate(at)}} for at in cloud.tolist()))

    def posterior_settings(self, forms: Sequence[Settings], probability: Floats) -> Settings:
        """Return the posterior mean of the masses; the first variant if its probability is above 0.5."""
        if probability[0] > 0.5:
            return forms[0]
        finer, weight = forms[1:], probability[1:] / probability[1:].sum()
        return {name: float(weight @ [form[name] for form in finer]) for name in finer[0]}

    def odds(self, settings: Settings) -> float:
        """Return the prior odds of the masses; the middle of the grid repeats those of the rig file."""
        return math.exp(-0.5 * settings.get(_shape(0), 0.0) ** 2)

    def names(self, settings: Settings) -> tuple[str, ...]:
        if not settings:
            return ("width_rad",)
        shapes = len(settings) - 2
        expected = {_SPREAD, _OTHER, *map(_shape, range(shapes))}
        if set(settings) != expected or not 0.0 < settings[_SPREAD] <= 1.0 or settings[_OTHER] <= 0.0:
            raise ValueError(
                f"the settings are {_SPREAD}, at most 1, {_OTHER}, and {_shape(0)} ... for the load's shapes"
            )
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
    """Return the values of the first shapes of the load, in sigmas, and the remaining sigma of every shape.

    Args:
        settings: the variant.
        shapes: number of shapes of the load.

    Returns:
        Values of the shapes that the settings contain; (shapes,) sigmas.

    Raises:
        ModelError: the load has fewer shapes than the settings.
    """
    at = [settings[_shape(number)] for number in range(len(settings) - 2)]
    if len(at) > shapes:
        raise ModelError(f"the model has {len(at)} shapes of a load, its rig {shapes}; calibrate again")
    return at, np.where(np.arange(shapes) < len(at), settings[_SPREAD], 1.0)


def other_newton_m(settings: Settings) -> float:
    """Return the uncertainty of the load in addition to its shapes, N m."""
    return settings[_OTHER]


def _shape(number: int) -> str:
    """Return the setting's name for a shape's deviation from the rig file's masses, in sigmas."""
    return f"shape{number + 1}"


FAMILY = GravityFlipPlay()
