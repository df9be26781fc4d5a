"""A length transducer that loses its reference."""

from __future__ import annotations

from calibration.effects.base import Coefficient
from calibration.effects.timing import JointStepFamily


class TransducerIndexJump(JointStepFamily):
    """From an instant on, true length minus reading is offset: counts were lost, or a draw wire slipped."""

    name = "transducer_index_jump"
    equation = "d_L = jump for t > t0, t0 found from the data"
    source = "lost counts or a wrong reference mark of an incremental length transducer"
    confused_with = ("transducer_cumulative", "base_step", "base_settlement")
    revealed_by = "returning to a pose measured before, and moving the transducer past its reference mark"
    fixed = (Coefficient("jump_mm", "mm", 8.0, -30.0, 30.0),)
    kind = "prismatic"


FAMILY = TransducerIndexJump()
