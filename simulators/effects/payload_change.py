"""A joint that gives way under the payload alone, as a bracket that only the load rests on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_kind


@dataclass(frozen=True)
class PayloadChange(Effect):
    """d_theta = c (torque with `payload_kg` - torque without payload), in the deflected posture.

    Attributes:
        compliance_rad_per_Nm: c.
    """

    family: ClassVar[str] = "payload_change"
    size: ClassVar[tuple[str, ...]] = ("compliance_rad_per_Nm",)
    compliance_rad_per_Nm: float = 5e-8  # noqa: N815 - the unit is N m

    def check(self, rig: Rig) -> None:
        super().check(rig)
        check_kind(self, rig, "revolute")
        if not any(mass.payload for mass in rig.masses):
            raise ValueError(f"{self.family}@{self.where}: rig {rig.name!r} has no payload")

    def joint_change(self, body: Body) -> Floats:
        body.column("payload_kg")
        return self.compliance_rad_per_Nm * body.payload_torque(self.where)
