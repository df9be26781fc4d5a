"""A parallel linkage that is no parallelogram: the rows that a joint drives turn by different angles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from calibration.rig.description import Rig
from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class LinkageCoupling(Effect):
    """All rows that the joint turns, but for the first, turn by (1 + k) times their nominal angle.

    Attributes:
        where: the driving joint.
        coupling: k.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"coupling": 1e-2}
    has_either_sign = True
    coupling: float = 2.0e-3

    def check(self, rig: Rig) -> None:
        super().check(rig)
        if not self._rows(rig):
            raise ValueError(f"{self.family}@{self.where}: {self.where} turns no second row of rig {rig.name!r}")

    def _rows(self, rig: Rig) -> Mapping[int, float]:
        driven = {n: share for n, what, joint, share in rig.couplings() if joint == self.where and what == "theta"}
        return {n: share for n, share in driven.items() if n != min(driven)}

    def row_turns(self, body: Body) -> Mapping[int, Floats]:
        angle = body.true[self.where]
        return {row: self.coupling * share * angle for row, share in self._rows(body.rig).items()}
