"""Friction that grows with the load: an encoder stops short of its joint on the side it came from, by the load."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class LoadHysteresis(Effect):
    """d_theta = k * direction * |torque| * (1 + s exp(-(rate / v)^2)), the torque that of the deflected posture.

    Coulomb friction in a loaded bearing or slide pad holds the encoder's side back, and what lies between it and the
    link winds up: the link comes to rest further along its last motion (column `<joint>_dir`) than its encoder says. At
    creeping speed it rises by the share s of stiction (Stribeck's curve, with his speed v; Armstrong-Helouvry, Dupont
    and Canudas de Wit, Automatica 30, 1994); it needs `<joint>_rate` then.

    Attributes:
        rad_per_Nm: k; 4e-9 at a joint that carries 250 kN m is 1 mrad.
        stiction_share: s; 0 is friction that does not care for the speed.
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
