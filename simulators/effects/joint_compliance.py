"""A joint that gives way: its deflection is proportional to the gravity torque on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_kind


@dataclass(frozen=True)
class JointCompliance(Effect):
    """d_theta = compliance * torque, in the deflected posture.

    Attributes:
        compliance_rad_per_Nm: 5e-9 at a joint that carries 250 kN m is about 1.2 mrad.
    """

    family: ClassVar[str] = "joint_compliance"
    size: ClassVar[tuple[str, ...]] = ("compliance_rad_per_Nm",)
    compliance_rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m

    def check(self, rig: Rig) -> None:
        super().check(rig)
        check_kind(self, rig, "revolute")

    def joint_change(self, body: Body) -> Floats:
        return self.compliance_rad_per_Nm * body.torque(self.where)
