"""A coupled row that gives way: the far link of a parallel linkage turns further under its load."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig.description import Rig
from simulators.effects.base import Body, Effect, Floats, first_turned


@dataclass(frozen=True)
class PassiveCompliance(Effect):
    """A row turns further by compliance times the moment about its axis of all weights that it carries.

    Attributes:
        where: `row` and its number; a row that turns and is not the first that a revolute joint turns.
        compliance_rad_per_Nm: of the linkage.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"compliance_rad_per_Nm": 20e-3}
    bounded_at = "largest_moment"
    compliance_rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m

    def check(self, rig: Rig) -> None:
        turned = {number for number, what, _, _ in rig.couplings() if what == "theta"}
        passive = sorted(turned - set(first_turned(rig).values()))
        if not rig.masses or self.where not in [f"row{number}" for number in passive]:
            there = ", ".join(f"row{number}" for number in passive if rig.masses) or "no row"
            raise ValueError(f"{self.family}@{self.where}: under weights it acts at {there} of rig {rig.name!r}")

    def moment_row(self, rig: Rig) -> int:
        del rig
        return int(self.where[len("row") :])

    def row_turns(self, body: Body) -> Mapping[int, Floats]:
        row = self.moment_row(body.rig)
        turning = body.turning(row)
        return {row: self.compliance_rad_per_Nm * np.sum(turning.moment_newton_m * turning.axis, axis=1)}
