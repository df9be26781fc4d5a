"""A joint that gives way under the payload alone, as a bracket that only the load rests on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from calibration.rig.description import Rig
from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class PayloadChange(Effect):
    """d_theta = c (torque with `payload_kg` - torque without payload), in the deflected posture.

    Attributes:
        compliance_rad_per_Nm: c.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"compliance_rad_per_Nm": 20e-3}
    bounded_at = "largest_load"
    needs_load = True
    acts_at = ("revolute",)
    compliance_rad_per_Nm: float = 5e-8  # noqa: N815 - the unit is N m

    def check(self, rig: Rig) -> None:
        super().check(rig)
        if not any(mass.payload for mass in rig.masses):
            raise ValueError(f"{self.family}@{self.where}: rig {rig.name!r} has no payload")

    def joint_change(self, body: Body) -> Floats:
        body.column("payload_kg")
        return self.compliance_rad_per_Nm * body.payload_torque(self.where)
