"""Links that bend, tilt, grow or couple."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig.description import Rig
from simulators.effects.base import Bend, Body, BoomEffect, Effect, Floats, boom_row, first_turned, warming


@dataclass(frozen=True)
class BoomDroop(BoomEffect):
    """A boom that bends: a cantilever from its root to its tip, whose length grows as it extends.

    Euler-Bernoulli cantilever under tip load F, tip moment M and its own weight W spread over length L.

    deflection = (F L^3 / 3 + M L^2 / 2 + W L^3 / 8) / EI,  slope = (F L^2 / 2 + M L + W L^2 / 6) / EI,
    with F and M perpendicular to the boom's axis, in the bent posture.

    Attributes:
        flexibility_per_Nm2: 1 / EI; 4e-9 is about 20 mm at full reach of a 7 m boom with 2.8 t at its tip.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"flexibility_per_Nm2": 300.0}
    bounded_at = "full_reach"
    flexibility_per_Nm2: float = 4e-9  # noqa: N815 - the unit is N m^2

    def bends(self, body: Body) -> Sequence[Bend]:
        row = boom_row(body.rig)
        beam = body.beam(row)
        axis, L = beam.axis, beam.length_m[:, None]

        def across(vectors: Floats) -> Floats:
            along: Floats = np.sum(vectors * axis, axis=1)[:, None]
            return vectors - along * axis

        F, M, W = across(beam.force_newton), across(beam.moment_newton_m), across(beam.own_weight_newton)
        shift_m = F * L**3 / 3 + np.cross(M, axis) * L**2 / 2 + W * L**3 / 8
        slope = np.cross(axis, F) * L**2 / 2 + M * L + np.cross(axis, W) * L**2 / 6
        scale = self.flexibility_per_Nm2
        return (Bend(row, beam.tip_mm, scale * slope, 1e3 * scale * shift_m),)


@dataclass(frozen=True)
class PadPlay(BoomEffect):
    """Worn slide pads: the inner section of the boom tilts in the outer section to the side of its load.

    Tilt clearance / overlap about the level axis across the boom, at the mouth of the outer section.

    The overlap is the stroke's upper limit + 0.4 strokes - the extension. The sign of the tilt is the sign of the
    moment at the mouth. Everything from the boom's tip on moves.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"clearance_mm": 8.0}
    clearance_mm: float = 2.0

    def bends(self, body: Body) -> Sequence[Bend]:
        row = boom_row(body.rig)
        beam, outer_mm = body.beam(row), body.rig.rows[row - 1].a_mm
        transducer = next(joint for n, what, joint, _ in body.rig.couplings() if n == row and what == "a")
        low, high = body.rig.joint(transducer).limits
        overlap_mm = high + 0.4 * (high - low) - body.true[transducer]
        mouth = beam.tip_mm - (1e3 * beam.length_m - outer_mm)[:, None] * beam.axis
        moment = beam.moment_newton_m + np.cross((beam.tip_mm - mouth) / 1e3, beam.force_newton)
        level = np.cross(beam.axis, body.gravity)
        level = level / np.maximum(np.linalg.norm(level, axis=1), 1e-12)[:, None]  # a vertical boom has none
        side = np.sign(np.sum(moment * level, axis=1))
        tilt = (side * self.clearance_mm / overlap_mm)[:, None] * level
        return (Bend(row, mouth, tilt, np.zeros_like(tilt)),)


@dataclass(frozen=True)
class LateralCompliance(Effect):
    """A link that tilts in its bearing: a sideways load turns it out of its joint's plane.

    A joint's link, and everything beyond, turns by compliance times the weights' moment perpendicular to its axis.

    Attributes:
        where: a revolute joint, but not the first one that turns.
        compliance_rad_per_Nm: the same about both axes perpendicular to the joint's axis.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"compliance_rad_per_Nm": 20e-3}
    bounded_at = "largest_moment"
    acts_at = ("revolute",)
    compliance_rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m

    def check(self, rig: Rig) -> None:
        super().check(rig)
        turned = {number for number, what, _, _ in rig.couplings() if what == "theta"}
        row = first_turned(rig).get(self.where)
        if not rig.masses or row is None or not turned & set(rig.path(row)[:-1]):
            raise ValueError(f"{self.family}@{self.where}: it can act only under weights, beyond a turning joint")

    def moment_row(self, rig: Rig) -> int:
        return first_turned(rig)[self.where]

    def bends(self, body: Body) -> Sequence[Bend]:
        row = self.moment_row(body.rig)
        turning = body.turning(row)
        # z x (M x z) is M without its part along z
        across = np.cross(turning.axis, np.cross(turning.moment_newton_m, turning.axis))
        tilt = self.compliance_rad_per_Nm * across
        return (Bend(row, turning.straight_mm, tilt, np.zeros_like(tilt)),)


@dataclass(frozen=True)
class PassiveCompliance(Effect):
    """A coupled row that gives way: the far link of a parallel linkage turns farther under its load.

    A row turns farther by compliance times the moment about its axis of all weights that it carries.

    Attributes:
        where: `row` and its number; the row must turn and must not be the first row that a revolute joint turns.
        compliance_rad_per_Nm: compliance of the linkage.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"compliance_rad_per_Nm": 20e-3}
    bounded_at = "largest_moment"
    compliance_rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m

    def check(self, rig: Rig) -> None:
        turned = {number for number, what, _, _ in rig.couplings() if what == "theta"}
        passive = sorted(turned - set(first_turned(rig).values()))
        if not rig.masses or self.where not in [f"row{number}" for number in passive]:
            there = ", ".join(f"row{number}" for number in passive if rig.masses) or "no row"
            raise ValueError(f"{self.family}@{self.where}: it can act under weights at {there} of rig {rig.name!r}")

    def moment_row(self, rig: Rig) -> int:
        del rig
        return int(self.where[len("row") :])

    def row_turns(self, body: Body) -> Mapping[int, Floats]:
        row = self.moment_row(body.rig)
        turning = body.turning(row)
        return {row: self.compliance_rad_per_Nm * np.sum(turning.moment_newton_m * turning.axis, axis=1)}


@dataclass(frozen=True)
class LinkageCoupling(Effect):
    """A parallel linkage that is not a parallelogram: the rows that a joint drives turn by different angles.

    All rows that the joint turns, except the first, turn by (1 + k) times their nominal angle.

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
            raise ValueError(f"{self.family}@{self.where}: {self.where} does not turn a second row of rig {rig.name!r}")

    def _rows(self, rig: Rig) -> Mapping[int, float]:
        driven = {n: share for n, what, joint, share in rig.couplings() if joint == self.where and what == "theta"}
        return {n: share for n, share in driven.items() if n != min(driven)}

    def row_turns(self, body: Body) -> Mapping[int, Floats]:
        angle = body.true[self.where]
        return {row: self.coupling * share * angle for row, share in self._rows(body.rig).items()}


@dataclass(frozen=True)
class ThermalExpansion(Effect):
    """Steel that expands with its temperature: every length of the machine by the same share.

    All lengths x (1 + alpha (T - T0)), T the column `temperature_degC`; the base's origin does not move.

    Attributes:
        per_K: alpha; 12e-6 for steel.
        at_degC: T0; None for the mean of the given rows.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"per_K": 2.5e-5}
    acts_at = ("boom",)
    where: str = "boom"
    per_K: float = 12.0e-6  # noqa: N815 - the unit is K
    at_degC: float | None = None  # noqa: N815 - the unit is degC

    def growth(self, body: Body) -> Floats:
        return self.per_K * warming(body, self.at_degC)


_LEAST_LINK_MM = 500.0


@dataclass(frozen=True)
class SolarBow(Effect):
    """A link that the sun warms from above: it bows away from the sun, most if it is level.

    d_theta = k (T - T0) cos(elevation of the link that the joint moves), T the column `temperature_degC`.

    The link runs from the frame whose origin is on the joint's axis to the next frame along the machine that is at
    least half a metre away.

    Attributes:
        rad_per_K: k.
        at_degC: T0; None for the mean of the given rows.
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
        if rig.convention == "dh":  # a row turns about the axis of the previous row
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
