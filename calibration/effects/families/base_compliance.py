"""A carrier that leans under the weight of its boom: jacks, tracks and the ground are compliant."""

from __future__ import annotations

import math

import numpy as np

from calibration.effects.base import Coefficient, PrismFamily, Settings
from calibration.effects.context import EffectContext
from calibration.observations import Floats
from calibration.rig.description import Rig

_SIGMA_RAD = 1e-3  # at the largest moment
_BOUND_RAD = 15e-3
_UNIT = "rad/(N m)"
_POWERS = (1.0, 2.0, 3.0)
_POWER, _HEIGHT = "power", "height_mm"
_LEAST_NM = 1e-6


class BaseCompliance(PrismFamily):
    """The base tilts about each level axis in proportion to the moment of all weights about that axis.

    If the first joint is a lift, the mast below it may bend instead. The tilt then grows with a power of the lift's
    height: 1 for a mast that turns at its foot, up to 3 for a mast that bends along its whole length.
    """

    name = "base_compliance"
    equation = (
        "tilts about the base's level x and y axes = compliances * moment of all weights [* (height/highest)^power]"
    )
    source = "rigid body on linear springs; cantilever mast (Euler-Bernoulli)"
    confused_with = ("joint_compliance", "boom_droop", "base_step")
    revealed_by = "the boom far out to all sides, or a prism on the carrier while the boom swings"
    load_kind = "weights"
    limit_sigma = 0.15
    place = "base"
    moves_machine = False

    def places(self, rig: Rig) -> tuple[str, ...]:
        return (self.place,) if rig.masses else ()

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        del where
        if _greatest_newton_m(context) < _LEAST_NM:
            return ()
        lift = _lift(context.rig)
        highest = 0.0 if lift is None else float(np.abs(context.reading(lift)).max(initial=0.0))
        return ({}, *({_POWER: power, _HEIGHT: highest} for power in _POWERS if highest > 0.0))

    def odds(self, settings: Settings) -> float:
        return 1.0 / len(_POWERS) if settings else 1.0

    def form(self, settings: Settings) -> str:
        return f"with power {settings[_POWER]:.0f} of the lift's height" if settings else ""

    def check_settings(self, settings: Settings) -> None:
        if settings and (set(settings) != {_POWER, _HEIGHT} or not all(0.0 < v < math.inf for v in settings.values())):
            raise ValueError(f"the settings are {_POWER} and {_HEIGHT}, both above 0")

    def names(self, settings: Settings) -> tuple[str, ...]:
        self.check_settings(settings)
        return ("x_rad_per_Nm", "y_rad_per_Nm")

    def coefficients(self, context: EffectContext, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del where
        most = max(_greatest_newton_m(context), _LEAST_NM)
        return tuple(Coefficient(n, _UNIT, _SIGMA_RAD / most, 0.0, _BOUND_RAD / most) for n in self.names(settings))

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del where
        amount = np.ones(len(context))
        lift = _lift(context.rig)
        if settings and lift is not None:
            amount = (np.abs(context.reading(lift)) / settings[_HEIGHT]) ** settings[_POWER]
        return context.base_motion_mm(amount)[:, :, :2] * context.overturning_Nm[:, None, :]


def _lift(rig: Rig) -> str | None:
    """Return the first joint if it is prismatic, so that it lifts the whole machine."""
    first = rig.joints[0]
    return first.name if first.kind == "prismatic" else None


def _greatest_newton_m(context: EffectContext) -> float:
    """Return the largest moment of all weights about a level axis in the work volume."""
    return float(np.abs(context.work_volume.overturning_Nm).max(initial=0.0)) if context.rig.masses else 0.0


FAMILY = BaseCompliance()
