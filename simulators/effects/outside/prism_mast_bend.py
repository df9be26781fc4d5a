"""A prism on a slender mast: it hangs to the side that gravity pulls it to, as the frame under it turns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig import Rig
from simulators.effects.base import Effect, Floats, Sight, check_place


@dataclass(frozen=True)
class PrismMastBend(Effect):
    """The prism lies off by k times the part of gravity's direction that is across its mast.

    The mast is along the z axis of the frame that the prism is fixed to.

    Attributes:
        mm: k, for a level mast.
    """

    family: ClassVar[str] = "prism_mast_bend"
    size: ClassVar[tuple[str, ...]] = ("mm",)
    mm: float = 3.0

    def check(self, rig: Rig) -> None:
        check_place(self, *rig.prism_names)

    def fix_shift_mm(self, sight: Sight) -> Floats | None:
        if self.where != sight.prism:
            return None
        mast, down = sight.axes[:, :, 2], np.array([0.0, 0.0, -1.0])
        shift: Floats = self.mm * (down - (mast @ down)[:, None] * mast)
        return shift
