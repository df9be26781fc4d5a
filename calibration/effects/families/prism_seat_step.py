"""A prism that came loose in its seat, or was put back slightly differently."""

from __future__ import annotations

import numpy as np

from calibration.effects.base import Coefficient, Settings
from calibration.effects.context import EffectContext
from calibration.effects.timing import SizedStepFamily
from calibration.observations import Floats
from calibration.rig.description import Rig


class PrismSeatStep(SizedStepFamily):
    """From an instant on, a prism has a different position in the frame that it is fixed to."""

    name = "prism_seat_step"
    equation = "prism's offset in its frame + (x, y, z) for t > time_s"
    source = "a mount that was struck, or a prism that was removed and put back"
    confused_with = ("transducer_index_jump", "zero_step", "base_shift")
    revealed_by = "a second prism on the same link, and poses measured before"
    fixed = tuple(Coefficient(f"{axis}_mm", "mm", 3.0, -30.0, 30.0) for axis in "xyz")

    def places(self, rig: Rig) -> tuple[str, ...]:
        return rig.prism_names

    def time_s(self, context: EffectContext, where: str) -> Floats:
        """Return the times (n,) of the prism's rows, NaN in rows of other prisms."""
        return np.where(context.rows_of_prism(where), context.extra("time_s"), np.nan)

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        after = self.after(context, where, settings)
        return context.to_station(context.facing.axes.transpose(0, 2, 1) * after[:, None, None])


FAMILY = PrismSeatStep()
