"""Joints that turn by a different angle than their encoder reads: play, friction, leakage and compliance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig.description import Rig
from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class Backlash(Effect):
    """Play between encoder and joint: the encoder lags behind the joint by half the play in the direction of motion.

    d_theta = width / 2 * direction of the last motion (column `<joint>_dir`).
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"width_rad": 5e-3}
    acts_at = ("revolute",)
    width_rad: float = 1.0e-3

    def joint_change(self, body: Body) -> Floats:
        return 0.5 * self.width_rad * body.column(f"{self.where}_dir")


@dataclass(frozen=True)
class GravityFlipPlay(Effect):
    """Clearance in a joint that always rests on the side to which gravity pushes it.

    d_theta = width / 2 * sign(torque), with the torque in the deflected posture.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"width_rad": 5e-3}
    needs_load = True
    acts_at = ("revolute",)
    width_rad: float = 1.0e-3

    def joint_change(self, body: Body) -> Floats:
        return 0.5 * self.width_rad * np.sign(body.torque(self.where))


@dataclass(frozen=True)
class LoadHysteresis(Effect):
    """Friction that grows with the load: an encoder stops short of its joint's last motion by an angle due to the load.

    d_theta = k * direction * |torque| * (1 + s exp(-(rate / v)^2)), with the torque in the deflected posture.

    Coulomb friction in a loaded bearing or slide pad holds the encoder's side back, and the parts between it and the
    link wind up: the link comes to rest farther along its last motion (column `<joint>_dir`) than its encoder reads. At
    creeping speed friction rises by the share s of stiction (Stribeck's curve with Stribeck speed v;
    Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30, 1994); the column `<joint>_rate` is then needed.

    Attributes:
        rad_per_Nm: k; 4e-9 at a joint that carries 250 kN m is 1 mrad.
        stiction_share: s; 0 for friction that does not depend on the speed.
        stribeck_deg_per_s: v.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rad_per_Nm": 5e-3}
    bounded_at = "largest_load"
    needs_load = True
    acts_at = ("revolute",)
    positive = ("stribeck_deg_per_s",)
    rad_per_Nm: float = 4e-9  # noqa: N815 - the unit is N m
    stiction_share: float = 0.0
    stribeck_deg_per_s: float = 0.3

    def joint_change(self, body: Body) -> Floats:
        friction: Floats = self.rad_per_Nm * body.column(f"{self.where}_dir") * np.abs(body.torque(self.where))
        if self.stiction_share == 0.0:
            return friction
        rate = body.column(f"{self.where}_rate") / self.stribeck_deg_per_s
        return friction * (1.0 + self.stiction_share * np.exp(-(rate**2)))


@dataclass(frozen=True)
class JointCompliance(Effect):
    """A joint that gives way: its deflection is proportional to the gravity torque on it.

    d_theta = compliance * torque, in the deflected posture.

    Attributes:
        compliance_rad_per_Nm: the compliance; 5e-9 at a joint that carries 250 kN m is about 1.2 mrad.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"compliance_rad_per_Nm": 20e-3}
    bounded_at = "largest_load"
    needs_load = True
    acts_at = ("revolute",)
    compliance_rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m

    def joint_change(self, body: Body) -> Floats:
        return self.compliance_rad_per_Nm * body.torque(self.where)


@dataclass(frozen=True)
class PayloadChange(Effect):
    """A joint that gives way only under the payload, such as a bracket that carries only the payload.

    d_theta = c (torque with `payload_kg` - torque without payload), in the deflected posture.

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


@dataclass(frozen=True)
class LeakDown(Effect):
    """A cylinder that leaks at standstill: its joint sinks below the encoder's reading by a rate times the dwell.

    d_theta = -rate * time since the last motion (column `dwell_s`).
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rad_per_s": 5e-5}
    needs_load = True
    acts_at = ("revolute",)
    rad_per_s: float = 1.0e-5

    def joint_change(self, body: Body) -> Floats:
        return -self.rad_per_s * body.column("dwell_s")
