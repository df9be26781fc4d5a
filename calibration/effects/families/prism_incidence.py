"""A 360 degree prism whose distance error depends on the side from which it is seen."""

from __future__ import annotations

import numpy as np

from calibration.effects.base import Coefficient, PrismFamily, Settings
from calibration.effects.context import EffectContext
from calibration.observations import Floats
from calibration.rig.description import Rig

_LEAST = 1e-9  # smallest component across the prism's axis; below it the line of sight is along the axis
_AXIS = "axis"
_AXES = (3.0, 1.0, 2.0)  # z, x, y


class PrismIncidence(PrismFamily):
    """The first harmonic of psi, the azimuth of the station about the prism's own axis.

    A rig file does not give the orientation of a prism on its frame. The axis is one of the frame's three axes,
    selected by the data: 1 for x, 2 for y, 3 for z. psi is 0 along the next axis in cyclic order (x after z), and
    90 deg along the one after that.
    """

    name = "prism_incidence"
    equation = "shift = (cos1 cos psi + sin1 sin psi) * (unit vector from the station to the prism)"
    source = "errors of 360 degree prisms of several mm, depending on the angle of incidence (Favre and Hennes 2000)"
    confused_with = ("prism_constant", "encoder_harmonic", "angle_scale")
    revealed_by = "poses that turn the prism through all directions to the station, or a second set-up"
    fixed = (Coefficient("cos1_mm", "mm", 1.0, -8.0, 8.0), Coefficient("sin1_mm", "mm", 1.0, -8.0, 8.0))
    moves_machine = False

    def places(self, rig: Rig) -> tuple[str, ...]:
        return rig.prism_names

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        return tuple({_AXIS: axis} for axis in _AXES) if context.rows_of_prism(where).any() else ()

    def form(self, settings: Settings) -> str:
        return f"about {' xyz'[int(settings[_AXIS])]} of the prism's frame"

    def check_settings(self, settings: Settings) -> None:
        if set(settings) != {_AXIS} or settings[_AXIS] not in _AXES:
            raise ValueError("the only setting is the prism's axis: 1, 2 or 3 for x, y or z of its frame")

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        across = [int(settings[_AXIS]) % 3, (int(settings[_AXIS]) + 1) % 3]
        away = context.line_of_sight
        back = -(context.rotation.transpose(0, 2, 1) @ away[:, :, None])
        level = (context.facing.axes @ back)[:, across, 0]  # towards the station, along the axes across the prism's
        size = np.sqrt((level**2).sum(axis=1))[:, None]
        harmonic = np.where(size > _LEAST, level / np.maximum(size, _LEAST), 0.0)
        return (away * context.rows_of_prism(where)[:, None])[:, :, None] * harmonic[:, None, :]


FAMILY = PrismIncidence()
