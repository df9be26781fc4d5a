"""A 360 degree prism whose distance depends on the side it is seen from."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from calibration.effects.base import Coefficient, PrismFamily, Settings, Situation, refuse_settings
from calibration.effects.sight import of_prism, sight
from calibration.observations import Floats
from calibration.rig import Rig

_LEAST = 1e-9  # cosine of a line of sight that is along the prism's own axis


class PrismIncidence(PrismFamily):
    """The first harmonic of the azimuth at which the station is seen about the z axis of the prism's frame."""

    name: ClassVar[str] = "prism_incidence"
    equation: ClassVar[str] = "shift = (cos1 cos psi + sin1 sin psi) * (unit vector from the station to the prism)"
    source: ClassVar[str] = "360 degree prisms err by several mm with the angle of incidence (Favre and Hennes 2000)"
    confused_with: ClassVar[tuple[str, ...]] = ("prism_constant", "encoder_harmonic", "angle_scale")
    revealed_by: ClassVar[str] = "poses that turn the prism all round before the station, or a second set-up"

    def places(self, rig: Rig) -> tuple[str, ...]:
        return rig.prism_names

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        return ({},) if of_prism(situation, where).any() else ()

    def names(self, settings: Settings) -> tuple[str, ...]:
        refuse_settings(settings)
        return "cos1_mm", "sin1_mm"

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where
        return tuple(Coefficient(name, "mm", 1.0, -8.0, 8.0) for name in self.names(settings))

    def shift_mm(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del settings
        away = sight(situation)
        back = -(situation.rotation.transpose(0, 2, 1) @ away[:, :, None])
        level = (situation.facing.axes @ back)[:, :2, 0]  # towards the station, along the frame's x and y axes
        size = np.sqrt((level**2).sum(axis=1))[:, None]
        harmonic = np.where(size > _LEAST, level / np.maximum(size, _LEAST), 0.0)
        return (away * of_prism(situation, where)[:, None])[:, :, None] * harmonic[:, None, :]


FAMILY = PrismIncidence()
