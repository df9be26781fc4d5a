"""A displacement of the machine's last frame that two joints decide together: frames that bend and warp."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Bend, Body, Effect
from simulators.effects.unknown.surface import draw_surface


@dataclass(frozen=True)
class PlacePairError(Effect):
    """The last frame is off by a smooth function of two joints along each axis of the base's frame.

    Attributes:
        rms_mm: root mean square of each component over the ranges of its two joints.
        seed: the same seed draws the same functions.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rms_mm": 50.0}
    acts_at = ("boom",)
    where: str = "boom"
    rms_mm: float = 5.0
    seed: int = 0

    def bends(self, body: Body) -> Sequence[Bend]:
        axes = [draw_surface(body.rig, 3 * self.seed + axis).values(body.rig, body.read) for axis in range(3)]
        shift = self.rms_mm * np.stack(axes, axis=1)
        return (Bend(len(body.rig.rows), np.zeros_like(shift), np.zeros_like(shift), shift),)
