"""Special forms of library effects: gear teeth with an error map, a compliant reducer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from simulators.effects.base import Body, DrawContext, Effect, Floats


@dataclass(frozen=True)
class GearMesh(Effect):
    """Teeth that mesh unevenly: an error that repeats with every tooth of a worm wheel or rack.

    d_theta = A cos(n theta) + B sin(n theta), n cycles per turn, theta as read.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"cos_rad": 6e-3, "sin_rad": 6e-3}
    has_either_sign = True
    acts_at = ("revolute",)
    cos_rad: float = 1.0e-3
    sin_rad: float = 1.0e-3
    cycles: int = 9

    def joint_change(self, body: Body) -> Floats:
        angle = self.cycles * body.read[self.where]
        change: Floats = self.cos_rad * np.cos(angle) + self.sin_rad * np.sin(angle)
        return change


@dataclass(frozen=True)
class StiffeningCompliance(Effect):
    """A reducer that stiffens under load: soft while its teeth and bearings take up their play, then stiff.

    The compliance falls from a soft zone around zero torque to that of the loaded reducer, in the deflected posture.

    dtheta/dtau = stiff + (soft - stiff) / (1 + (tau / knee)^2), so that
    theta(tau) = stiff * tau + (soft - stiff) * knee * arctan(tau / knee).
    Manufacturers of strain wave and cycloidal reducers give this curve as two or three straight pieces with rising
    slopes K1 < K2 < K3 (Harmonic Drive engineering data, "torsional stiffness"; Nabtesco RV, "lost motion"). In a real
    joint the slope changes gradually.

    Attributes:
        soft_rad_per_Nm: 1 / K1, without load.
        stiff_rad_per_Nm: 1 / K3, far above the knee; with 4e-7, 4 kN m turn a joint by 1.6 mrad.
        knee_Nm: torque at which half of the difference remains.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"soft_rad_per_Nm": 20e-3, "stiff_rad_per_Nm": 20e-3}
    bounded_at = "largest_load"
    needs_load = True
    acts_at = ("revolute",)
    positive = ("knee_Nm",)
    soft_rad_per_Nm: float = 1.6e-6  # noqa: N815 - the unit is N m
    stiff_rad_per_Nm: float = 4e-7  # noqa: N815 - the same
    knee_Nm: float = 500.0  # noqa: N815 - the same

    def draw_shape(self, data: DrawContext, rng: np.random.Generator) -> Effect:
        return replace(self, knee_Nm=data.largest_load(self.where) * float(rng.uniform(0.1, 0.3)))

    def joint_change(self, body: Body) -> Floats:
        torque = body.torque(self.where)
        soft = (self.soft_rad_per_Nm - self.stiff_rad_per_Nm) * self.knee_Nm * np.arctan(torque / self.knee_Nm)
        change: Floats = self.stiff_rad_per_Nm * torque + soft
        return change
