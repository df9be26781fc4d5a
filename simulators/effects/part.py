"""An effect that acts only in a part of the data: beyond an angle, under load, when warm, or from some time on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import Rig
from simulators.effects.base import Bend, Body, Effect, Floats


@dataclass(frozen=True)
class Part:
    """The rows in which a variable is above a border, or not above it.

    Attributes:
        variable: name of a joint (its reading in deg or mm), `torque(JOINT)` (N m, or N) or an observation column.
        above: True for the rows above the border, False for all other rows.
        border: border in the variable's unit.
    """

    variable: str
    above: bool
    border: float

    def holds(self, values: Floats) -> NDArray[np.bool_]:
        """Return an (n,) mask that is True in the rows of the part; `values` are the (n,) values of the variable."""
        beyond = values > self.border
        return beyond if self.above else ~beyond


def part_variable(body: Body, variable: str) -> Floats:
    """Return the (n,) values of a part's variable; ValueError if the caller did not provide its column."""
    if variable.startswith("torque("):
        return body.torque(variable.removeprefix("torque(").removesuffix(")"))
    if variable in body.rig.joint_names:
        is_angle = body.rig.joint(variable).kind == "revolute"
        return np.rad2deg(body.read[variable]) if is_angle else body.read[variable]
    return body.column(variable)


@dataclass(frozen=True)
class PartialEffect(Effect):
    """An effect that acts only in the rows of a part. Effects in the line of sight, which know no rows, do nothing.

    Attributes:
        effect: the effect.
        part: the rows in which it acts.
    """

    effect: Effect
    part: Part

    def check(self, rig: Rig) -> None:
        self.effect.check(rig)

    def anchored(self, first_s: float, mean_degC: float) -> Effect:
        return replace(self, effect=self.effect.anchored(first_s, mean_degC))

    def delay_s(self, body: Body) -> Floats | None:
        delay = self.effect.delay_s(body)
        return None if delay is None else delay * self._acts(body)

    def joint_change(self, body: Body) -> Floats | None:
        change = self.effect.joint_change(body)
        return None if change is None else change * self._acts(body)

    def row_turns(self, body: Body) -> Mapping[int, Floats]:
        acts = self._acts(body)
        return {row: turn * acts for row, turn in self.effect.row_turns(body).items()}

    def growth(self, body: Body) -> Floats | None:
        growth = self.effect.growth(body)
        return None if growth is None else growth * self._acts(body)

    def bends(self, body: Body) -> Sequence[Bend]:
        acts = self._acts(body)[:, None]
        return [
            replace(bend, rotation_vector=bend.rotation_vector * acts, shift_mm=bend.shift_mm * acts)
            for bend in self.effect.bends(body)
        ]

    def _acts(self, body: Body) -> Floats:
        return self.part.holds(part_variable(body, self.part.variable)).astype(float)
