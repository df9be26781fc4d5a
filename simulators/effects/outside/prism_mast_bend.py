"""A prism on a slender mast: it hangs to the side that gravity pulls it to, as the frame under it turns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Effect, Floats, Sight


@dataclass(frozen=True)
class PrismMastBend(Effect):
    """The prism lies off by k times the part of gravity's direction that is across its mast.

    The mast is along the z axis of the frame that the prism is fixed to.

    Attributes:
        mm: k, for a level mast.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"mm": 15.0}
    acts_at = ("prism",)
    mm: float = 3.0

    def fix_shift_mm(self, sight: Sight) -> Floats | None:
        if self.where != sight.prism:
            return None
        mast, down = sight.axes[:, :, 2], np.array([0.0, 0.0, -1.0])
        shift: Floats = self.mm * (down - (mast @ down)[:, None] * mast)
        return shift
