"""A link that the sun warms from above: it bows away from the sun, the more the flatter it lies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Body, Effect, Floats, warming

_LEAST_LINK_MM = 500.0


@dataclass(frozen=True)
class SolarBow(Effect):
    """d_theta = k (T - T0) cos(elevation of the link that the joint moves), T of the column `temperature_degC`.

    The link runs from the frame whose origin is on the joint's axis to the next along the machine that is half a metre
    away or more.

    Attributes:
        rad_per_K: k.
        at_degC: T0; None: the mean of the rows given.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rad_per_K": 5e-4}
    has_either_sign = True
    needs_load = True
    acts_at = ("revolute",)
    rad_per_K: float = 1.0e-4  # noqa: N815 - the unit is K
    at_degC: float | None = None  # noqa: N815 - the unit is degC

    def joint_change(self, body: Body) -> Floats:
        return self.rad_per_K * warming(body, self.at_degC) * self._flatness(body)

    def _flatness(self, body: Body) -> Floats:
        rig = body.rig
        row = next(n for n, driven, joint, _ in rig.couplings() if joint == self.where and driven == "theta")
        axis_frame = row
        if rig.convention == "dh":  # a row turns about the axis of the one before
            axis_frame = (0, *rig.path(row)[:-1])[-1]
        root = body.origin_mm(axis_frame)
        up = -body.gravity / np.linalg.norm(body.gravity)
        link = np.zeros_like(root)
        for frame in range(axis_frame + 1, len(rig.rows) + 1):
            if row not in rig.path(frame):
                continue
            link = body.origin_mm(frame) - root
            if np.min(np.linalg.norm(link, axis=1)) >= _LEAST_LINK_MM:
                break
        length = np.linalg.norm(link, axis=1)
        flatness: Floats = np.sqrt(np.clip(1.0 - (link @ up / np.where(length > 0.0, length, 1.0)) ** 2, 0.0, 1.0))
        return flatness
