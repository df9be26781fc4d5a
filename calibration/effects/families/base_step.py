"""A carrier that tilted or rose suddenly: a jack slipped, something struck it, or it was set down again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.effects.base import Coefficient, Settings, sizes
from calibration.effects.context import EffectContext
from calibration.effects.timing import SizedStepFamily
from calibration.observations import Floats


class BaseStep(SizedStepFamily):
    """The base has different tilts and a different height, as a rigid body, in all rows after one instant."""

    name = "base_step"
    equation = "tilts about the base's level x and y axes and rise, for t > time_s"
    source = "rigid motion of the set-up at one instant: a jack that slips, a knock"
    confused_with = ("base_settlement", "payload_change", "transducer_index_jump")
    revealed_by = "fixed control points, or one pose repeated throughout the session"
    fixed = (
        Coefficient("tilt_x_rad", "rad", 1e-3, -5e-3, 5e-3),
        Coefficient("tilt_y_rad", "rad", 1e-3, -5e-3, 5e-3),
        Coefficient("z_mm", "mm", 3.0, -20.0, 20.0),
    )
    place = "base"
    moves_machine = False

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        return context.base_motion_mm(self.after(context, where, settings))

    def sized(self, context: EffectContext, where: str, steps: Sequence[Settings]) -> tuple[Settings, ...]:
        if not steps:
            return ()
        known = self.known(context, where)
        squares = context.base_motion_mm(np.ones(len(context)))[known] ** 2
        time_s = context.extra("time_s")[known]
        return tuple({**s, **sizes(np.sqrt(squares) * (time_s > s["time_s"])[:, None, None])} for s in steps)


FAMILY = BaseStep()
