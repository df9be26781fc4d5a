"""An encoder that slips on its shaft."""

from __future__ import annotations

from calibration.effects.base import Coefficient
from calibration.effects.timing import JointStepFamily


class ZeroStep(JointStepFamily):
    """From an instant on, a revolute joint has a different zero; for prismatic joints see `transducer_index_jump`."""

    name = "zero_step"
    equation = "d_theta = jump for t > time_s, time_s found from the data"
    source = "a coupling that slips, an encoder that was remounted or lost its reference"
    confused_with = ("base_shift", "base_step", "prism_seat_step", "backlash")
    revealed_by = "returning to poses measured before, with one prism before the joint and one behind it"
    fixed = (Coefficient("jump_rad", "rad", 2e-3, -35e-3, 35e-3),)
    kind = "revolute"


FAMILY = ZeroStep()
