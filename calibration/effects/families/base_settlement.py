"""A carrier that sinks into the ground, or whose jacks give way, little by little."""

from __future__ import annotations

from typing import ClassVar

from calibration.effects.base import Coefficient, Settings, Situation
from calibration.effects.base_motion import base_motion_mm
from calibration.effects.elapsed import ELAPSED_SETTINGS, check_elapsed, elapsed_s, elapsed_settings
from calibration.effects.trained import TrainedFamily, check_settings, sizes
from calibration.observations import Floats

_NAMES = ("tilt_x_rad_per_h", "tilt_y_rad_per_h", "z_mm_per_h")


class BaseSettlement(TrainedFamily):
    """The base drifts as a rigid body at a steady rate from the first row of the training on."""

    name: ClassVar[str] = "base_settlement"
    equation: ClassVar[str] = "tilts about the base's level x and y axes and rise = rates * (t - t_first)"
    source: ClassVar[str] = "rigid motion of the set-up, constant rate: settlement under a load, creep of jacks"
    confused_with: ClassVar[tuple[str, ...]] = ("base_step", "thermal_expansion", "payload_change")
    revealed_by: ClassVar[str] = (
        "the same few poses at the start, in the middle and at the end, or fixed control points"
    )
    place: ClassVar[str] = "base"
    column: ClassVar[str] = "time_s"

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        known = self.known(situation, where)
        elapsed = elapsed_settings(situation.extra("time_s")[known])
        return () if elapsed is None else ({**elapsed, **sizes(_shift_mm(situation, elapsed)[known])},)

    def names(self, settings: Settings) -> tuple[str, ...]:
        check_settings(settings, ELAPSED_SETTINGS, len(_NAMES))
        check_elapsed(settings)
        return _NAMES

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        tilts = (Coefficient(name, "rad/h", 0.2e-3, -1e-3, 1e-3) for name in _NAMES[:2])
        return (*tilts, Coefficient(_NAMES[2], "mm/h", 1.0, -5.0, 5.0))

    def shift_mm(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del where
        return _shift_mm(situation, settings)


def _shift_mm(situation: Situation, elapsed: Settings) -> Floats:
    return base_motion_mm(situation, elapsed_s(situation, elapsed) / 3600.0)


FAMILY = BaseSettlement()
