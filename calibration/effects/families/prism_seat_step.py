"""A prism that came loose in its seat, or was put back into it a little otherwise."""

from __future__ import annotations

import numpy as np

from calibration.effects.base import Coefficient, Settings, SizedFamily, check_sizes, sizes
from calibration.effects.context import EffectContext
from calibration.effects.timing import STEP_SETTINGS, StepFamily, check_step, refined_steps, step_grid
from calibration.observations import Floats
from calibration.rig.description import Rig


class PrismSeatStep(StepFamily, SizedFamily):
    """From an instant on a prism sits elsewhere in the frame that it is fixed to."""

    name = "prism_seat_step"
    equation = "prism's offset in its frame + (x, y, z) for t > time_s"
    source = "a mount that was struck, a prism taken off and put on again"
    confused_with = ("transducer_index_jump", "zero_step", "base_shift")
    revealed_by = "a second prism on the same link, and poses measured before"
    fixed = tuple(Coefficient(f"{axis}_mm", "mm", 3.0, -30.0, 30.0) for axis in "xyz")

    def places(self, rig: Rig) -> tuple[str, ...]:
        return rig.prism_names

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        return self._sized(context, where, step_grid(_own_time_s(context, where)))

    def refined(self, context: EffectContext, where: str, settings: Settings) -> tuple[Settings, ...]:
        return self._sized(context, where, refined_steps(_own_time_s(context, where), settings))

    def check_settings(self, settings: Settings) -> None:
        check_sizes(settings, STEP_SETTINGS, len(self.fixed))
        check_step(settings)

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        # A comparison with NaN is false: rows without a time, as those of other prisms, stay as they are.
        after = _own_time_s(context, where) > settings["time_s"]
        return context.to_station(context.facing.axes.transpose(0, 2, 1) * after[:, None, None])

    def _sized(self, context: EffectContext, where: str, steps: tuple[Settings, ...]) -> tuple[Settings, ...]:
        known = self.known(context, where)
        return tuple({**step, **sizes(self.shift_mm(context, where, step)[known])} for step in steps)


def _own_time_s(context: EffectContext, prism: str) -> Floats:
    """Return the time (n,) of the rows of one prism; NaN in all others."""
    return np.where(context.rows_of_prism(prism), context.extra("time_s"), np.nan)


FAMILY = PrismSeatStep()
