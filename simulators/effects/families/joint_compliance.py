"""A joint that gives way: its deflection is proportional to the gravity torque on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class JointCompliance(Effect):
    """d_theta = compliance * torque, in the deflected posture.

    Attributes:
        compliance_rad_per_Nm: 5e-9 at a joint that carries 250 kN m is about 1.2 mrad.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"compliance_rad_per_Nm": 20e-3}
    bounded_at = "largest_load"
    needs_load = True
    acts_at = ("revolute",)
    compliance_rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m

    def joint_change(self, body: Body) -> Floats:
        return self.compliance_rad_per_Nm * body.torque(self.where)
