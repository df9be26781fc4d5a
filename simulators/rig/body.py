"""The machine under load at n instants: positions, weights, and displacements due to effects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import Rig
from simulators.effects.base import Beam, Bend, Turning
from simulators.rig.screws import Posture, RowConstants, Screw, rotation_by_vector

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PointMass:
    """A weight: its frame, its position in that frame, and whether `payload_kg` overrides its mass."""

    frame: int
    place_mm: Floats
    kg: float
    is_payload: bool


@dataclass(frozen=True)
class LoadedBody:
    """The machine at n instants; implements `simulators.effects.base.Body`.

    Attributes:
        rig: description of the rig.
        read, true: joint name -> (n,) reading and true value, rad or mm.
        columns: name -> (n,) further observation columns.
        gravity: (3,) acceleration of gravity in the base frame, m/s^2.
        masses, constants: true weights and row constants.
        posture: posture at the true joint values.
        bent: displacements, ordered from the tip towards the base. Each moves everything beyond its frame rigidly, so
            its positions are those of a machine that is straight up to that frame.
        growth: (n,) relative increase of all lengths.
    """

    rig: Rig
    read: Mapping[str, Floats]
    true: Mapping[str, Floats]
    columns: Mapping[str, Floats]
    gravity: Floats
    masses: tuple[PointMass, ...]
    constants: tuple[RowConstants, ...]
    posture: Posture
    bent: tuple[Bend, ...]
    growth: Floats

    def column(self, name: str) -> Floats:
        """Return an (n,) observation column; ValueError if the caller did not provide it."""
        if name not in self.columns:
            raise ValueError(f"an effect of this machine needs the column {name!r}")
        return np.atleast_1d(np.asarray(self.columns[name], dtype=float))

    def has(self, name: str) -> bool:
        """Return True if the caller provided an observation column."""
        return name in self.columns

    def place_mm(self, frame: int, place_mm: Floats) -> Floats:
        """Return the (n, 3) position in the base frame of a point fixed to a frame, with displacements.

        Args:
            frame: number of the frame.
            place_mm: (3,) position of the point in that frame.
        """
        point: Floats = self.posture.point_mm(frame, place_mm) * (1.0 + self.growth)[:, None]
        for bend in self.bent:
            if self._follows(frame, bend.frame):
                point = _bent(bend, point)
        return point

    def axes(self, frame: int) -> Floats:
        """Return the (n, 3, 3) axes of a frame as columns, in the base frame."""
        axes = self.posture.axes(frame)
        for bend in self.bent:
            if self._follows(frame, bend.frame):
                axes = rotation_by_vector(bend.rotation_vector) @ axes
        return axes

    def origin_mm(self, frame: int) -> Floats:
        """Return the (n, 3) origin of a frame in the base frame."""
        return self.place_mm(frame, np.zeros(3))

    def torque(self, joint: str) -> Floats:
        """Return the (n,) generalised force of gravity on a joint: N m or N."""
        return self._torque(joint, self.masses)

    def payload_torque(self, joint: str) -> Floats:
        """Return the (n,) part of `torque` that is due to the payload."""
        return self._torque(joint, tuple(mass for mass in self.masses if mass.is_payload))

    def overturning_newton_m(self) -> Floats:
        """Return the (n, 3) moment of all weights about the base's origin, in the base frame."""
        total = np.zeros((len(self.growth), 3))
        for mass in self.masses:
            total += _cross(self.place_mm(mass.frame, mass.place_mm) / 1e3, self._weight_newton(mass))
        return total

    def _torque(self, joint: str, masses: tuple[PointMass, ...]) -> Floats:
        total = np.zeros(len(self.growth))
        places = [self.place_mm(m.frame, m.place_mm) for m in masses]
        weights = [self._weight_newton(m) for m in masses]
        for index, screw in enumerate(self.posture.chain.screws):
            coefficient = screw.weights.get(joint, 0.0)
            if coefficient == 0.0:
                continue
            if screw.turns != (self.rig.joint(joint).kind == "revolute"):
                coefficient *= 1e3 if screw.turns else 1e-3  # rad or mm of a motion per m or rad of its joint
            axis, point = self._axis(index, screw)
            for mass, place, weight in zip(masses, places, weights, strict=True):
                if not self.posture.chain.carries(index, mass.frame):
                    continue
                motion = _cross(axis, (place - point) / 1e3) if screw.turns else axis
                total += coefficient * np.sum(motion * weight, axis=1)
        return total

    def beam(self, row: int) -> Beam:
        """Return the beam of a row's driven length `a`, with the loads on it."""
        screws = self.posture.chain.screws
        index = next(i for i, s in enumerate(screws) if s.row == row and not s.turns)
        axis, root = self.posture.axis(index)
        before = self.posture.shifts_mm[screws[index].before]
        carried = self.posture.shifts_mm[index + 1] - before  # pure translation along the axis
        length_mm = self.constants[row - 1].a + np.sum(carried * axis, axis=1)
        straight_tip = root + length_mm[:, None] * axis
        # The bent tip: loads act on the deflected beam
        tip = straight_tip
        for bend in self.bent:
            if self._follows(row, bend.frame):
                tip = _bent(bend, tip)
        force, moment, own = np.zeros_like(tip), np.zeros_like(tip), np.zeros_like(tip)
        for mass in self.masses:
            weight = self._weight_newton(mass)
            if self._follows(mass.frame, row):
                force += weight
                moment += _cross((self.place_mm(mass.frame, mass.place_mm) - tip) / 1e3, weight)
            elif mass.frame == row - 1:
                own += weight
        return Beam(axis, length_mm / 1e3, straight_tip, force, moment, own)

    def turning(self, row: int) -> Turning:
        """Return the axis of a row's driven angle `theta`, with the moment on it."""
        index, screw = next((i, s) for i, s in enumerate(self.posture.chain.screws) if s.row == row and s.turns)
        axis, place = self._axis(index, screw)
        moment = np.zeros_like(place)
        for mass in self.masses:
            if self.posture.chain.carries(index, mass.frame):
                arm_m = (self.place_mm(mass.frame, mass.place_mm) - place) / 1e3
                moment += _cross(arm_m, self._weight_newton(mass))
        return Turning(axis, self.posture.axis(index)[1] * (1.0 + self.growth)[:, None], moment)

    def _axis(self, index: int, screw: Screw) -> tuple[Floats, Floats]:
        axis, point = self.posture.axis(index)
        point = point * (1.0 + self.growth)[:, None]
        for bend in self.bent:
            # A bend acts after its row's driven length and before its row's joint
            if self._follows(screw.row, bend.frame) and (screw.row != bend.frame or screw.turns):
                axis = (rotation_by_vector(bend.rotation_vector) @ axis[:, :, None])[:, :, 0]
                point = _bent(bend, point)
        return axis, point

    def _follows(self, frame: int, other: int) -> bool:
        """Return True if a frame is the same as `other` or beyond it."""
        return other in (0, *self.rig.path(frame))

    def _weight_newton(self, mass: PointMass) -> Floats:
        kg = np.full(len(self.growth), mass.kg)
        if mass.is_payload and "payload_kg" in self.columns:
            kg = self.column("payload_kg")
        return kg[:, None] * self.gravity


def _bent(bend: Bend, point: Floats) -> Floats:
    turned = (rotation_by_vector(bend.rotation_vector) @ (point - bend.about_mm)[:, :, None])[:, :, 0]
    moved: Floats = bend.about_mm + turned + bend.shift_mm
    return moved


def _cross(a: Floats, b: Floats) -> Floats:
    """Return the (n, 3) cross products of rows, a few times faster than NumPy's for three columns."""
    ax, ay, az = a[:, 0], a[:, 1], a[:, 2]
    bx, by, bz = b[:, 0], b[:, 1], b[:, 2]
    return np.column_stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))
