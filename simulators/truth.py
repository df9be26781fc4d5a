"""The machine behind a rig description: the same shape, its own parameters, and imperfections that no rig file names.

Written apart from the calibration's kinematics on purpose: a product of exponentials in place of multiplied rows, and
effects of its own, so that a mistake in one cannot hide behind the same mistake in the other.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.rig import Rig, Row
from simulators.effects.base import Beam, Bend, Effect
from simulators.screws import (
    Posture,
    RowConstants,
    Screw,
    nominal_constants,
    pose_chain,
    rotation_by_vector,
    screw_chain,
)

Floats = NDArray[np.float64]

STANDARD_GRAVITY = 9.80665  # m/s^2
MASS_UNCERTAINTY = 0.15  # the rig file's masses are within +-15 % of the machine's
TILT_SIGMA_DEG = 0.5  # a carrier on its jacks
_ROUNDS = 4  # of the fixed point load -> deflection -> load; each gains two to three digits


@dataclass(frozen=True)
class Placement:
    """Where the machine's base is in the station's frame (x east, y north, z up, mm).

    Attributes:
        rotation: (3, 3) base axes in the station's frame.
        position_mm: (3,) the base's origin.
    """

    rotation: Floats
    position_mm: Floats

    def to_station_mm(self, points_mm: Floats) -> Floats:
        """(n, 3) points of the base frame, in the station's frame."""
        moved: Floats = points_mm @ self.rotation.T + self.position_mm
        return moved


@dataclass(frozen=True)
class _PointMass:
    frame: int
    place_mm: Floats
    kg: float
    is_payload: bool


class RigTruth:
    """A true machine.

    Attributes:
        rig: the description that it deviates from.
        effects: its hidden effects.
        constants: its true row constants.

    Args:
        rig: the description.
        seed: the same seed builds the same machine.
        perturbation: how many times the build tolerances (and the mass uncertainty) it deviates; 0 is the nominal
            machine. A prism whose offset is unknown is drawn from its own tolerance whatever the perturbation.
        effects: hidden effects.

    Raises:
        ValueError: an effect that this rig has no place for.
    """

    def __init__(self, rig: Rig, seed: int, *, perturbation: float = 1.0, effects: Sequence[Effect] = ()) -> None:
        for effect in effects:
            effect.check(rig)
        self.rig = rig
        self.seed = seed
        self.effects = tuple(effects)
        rng = np.random.default_rng([seed, 1])
        self.constants = tuple(
            _perturbed(own, row, rig, rng.standard_normal(6) * perturbation)
            for own, row in zip(nominal_constants(rig), rig.rows, strict=True)
        )
        self._chain = screw_chain(rig.convention, rig.rows, self.constants)
        self._prisms = {
            p.name: (
                p.frame,
                np.array(p.offset_mm)
                + rng.standard_normal(3) * rig.tolerances.prism_mm * (perturbation if p.offset_known else 1.0),
            )
            for p in rig.prisms
        }
        self._masses = self._build_masses(np.random.default_rng([seed, 2]), perturbation)
        self._placements: dict[str, Placement] = {}

    def _build_masses(self, rng: np.random.Generator, perturbation: float) -> tuple[_PointMass, ...]:
        masses = []
        for mass in self.rig.masses:
            kg = mass.kg * (1.0 + perturbation * rng.uniform(-MASS_UNCERTAINTY, MASS_UNCERTAINTY))
            if mass.centre_mm is not None:
                masses.append(_PointMass(mass.frame, np.array(mass.centre_mm), kg, mass.payload))
            else:  # midway between two origins: half of it at each gives the same force, moment and energy
                origins = (mass.frame, mass.frame + 1)
                masses.extend(_PointMass(frame, np.zeros(3), kg / 2, mass.payload) for frame in origins)
        return tuple(masses)

    def prism_offset_mm(self, name: str) -> Floats:
        """(3,) true place of a prism in its frame; KeyError if there is no such prism."""
        return self._prisms[name][1]

    def placement(self, setup: str = "") -> Placement:
        """Where the machine stands in the frame of a station set-up: a few metres away, swinging away from it."""
        if setup not in self._placements:
            self._placements[setup] = self._place(np.random.default_rng([self.seed, 3, zlib.crc32(setup.encode())]))
        return self._placements[setup]

    def _place(self, rng: np.random.Generator) -> Placement:
        down = np.array(self.rig.gravity) / np.linalg.norm(self.rig.gravity)
        upright = _turn_onto(-down, np.array([0.0, 0.0, 1.0]))
        yaw = rotation_by_vector(np.array([[0.0, 0.0, rng.uniform(0, 2 * np.pi)]]))[0]
        tilt = rotation_by_vector(np.array([[*np.deg2rad(rng.normal(0, TILT_SIGMA_DEG, 2)), 0.0]]))[0]
        R = tilt @ yaw @ upright
        # The middle of the work volume, seen from the base, gives reach and working direction.
        middle = {j.name: np.array([sum(j.limits) / 2]) for j in self.rig.joints}
        prisms = [self._solve(middle, {}, setup=None).place_mm(*self._prisms[p])[0] for p in self.rig.prism_names]
        outward = R @ np.mean(prisms, axis=0)
        reach = float(max(np.linalg.norm(p) for p in prisms))
        heading = np.arctan2(outward[1], outward[0]) + np.deg2rad(rng.uniform(-40, 40))
        distance = 1500.0 + reach * rng.uniform(0.3, 0.7)
        height = rng.uniform(-1500, 300) if reach > 5000 else rng.uniform(-600, 0)
        return Placement(R, np.array([distance * np.cos(heading), distance * np.sin(heading), height]))

    def prism_mm(
        self, name: str, joints: Mapping[str, Floats], columns: Mapping[str, Floats] | None = None, *, setup: str = ""
    ) -> Floats:
        """(n, 3) true position of a prism in the station's frame.

        Args:
            name: prism.
            joints: joint name -> (n,) what a noise-free encoder or transducer says, deg or mm.
            columns: further observation columns that effects need (`theta4_dir`, `payload_kg`, ...) -> (n,).
            setup: station set-up.

        Raises:
            KeyError: no such prism, or a joint is missing.
            ValueError: an effect needs a column that was not given.
        """
        frame, place = self._prisms[name]
        body = self._solve(joints, columns or {}, setup)
        return self.placement(setup).to_station_mm(body.place_mm(frame, place))

    def gravity_load(
        self, joint: str, joints: Mapping[str, Floats], columns: Mapping[str, Floats] | None = None, *, setup: str = ""
    ) -> Floats:
        """(n,) generalised gravity force on a joint, N m or N; positive drives the joint's value up.

        Args:
            joint: its name.
            joints, setup: as for `prism_mm`.
            columns: `payload_kg` where the payload differs from the rig description's.
        """
        loose = replace_effects(self, ()) if self.effects else self
        return loose._solve(joints, columns or {}, setup).torque(joint)

    def _solve(self, joints: Mapping[str, Floats], columns: Mapping[str, Floats], setup: str | None) -> _Body:
        read = {}
        for joint in self.rig.joints:
            values = np.atleast_1d(np.asarray(joints[joint.name], dtype=float))
            read[joint.name] = np.deg2rad(values) if joint.kind == "revolute" else values
        rotation = np.eye(3) if setup is None else self.placement(setup).rotation
        gravity = rotation.T @ np.array([0.0, 0.0, -STANDARD_GRAVITY])
        effects = () if setup is None else self.effects
        body = _Body(self.rig, read, columns, gravity, self._masses, self.constants, pose_chain(self._chain, read), ())
        for _ in range(_ROUNDS if effects else 0):
            true = dict(read)
            bends: list[Bend] = []
            for effect in effects:
                change = effect.joint_change(body)
                if change is not None:
                    true[effect.where] = true[effect.where] + change
                bends.extend(effect.bends(body))
            body = replace(body, posture=pose_chain(self._chain, true), bent=tuple(bends))
        return body


@dataclass(frozen=True)
class _Body:
    """The machine at n instants: `simulators.effects.base.Body`."""

    rig: Rig
    read: Mapping[str, Floats]
    columns: Mapping[str, Floats]
    gravity: Floats
    masses: tuple[_PointMass, ...]
    constants: tuple[RowConstants, ...]
    posture: Posture
    bent: tuple[Bend, ...]

    def column(self, name: str) -> Floats:
        if name not in self.columns:
            raise ValueError(f"an effect of this machine needs the column {name!r}")
        return np.atleast_1d(np.asarray(self.columns[name], dtype=float))

    def place_mm(self, frame: int, place_mm: Floats) -> Floats:
        """(n, 3) position in the base frame of a point fixed to a frame, bends included."""
        point = self.posture.point_mm(frame, place_mm)
        for bend in self.bent:
            if self._follows(frame, bend.frame):
                point = _bent(bend, point)
        return point

    def torque(self, joint: str) -> Floats:
        n = len(self.read[joint])
        total = np.zeros(n)
        places = [self.place_mm(m.frame, m.place_mm) for m in self.masses]
        weights = [self._weight_newton(m) for m in self.masses]
        for index, screw in enumerate(self.posture.chain.screws):
            coefficient = screw.weights.get(joint, 0.0)
            if coefficient == 0.0:
                continue
            axis, point = self._axis(index, screw)
            for mass, place, weight in zip(self.masses, places, weights, strict=True):
                if not self.posture.chain.carries(index, mass.frame):
                    continue
                motion = np.cross(axis, (place - point) / 1e3) if screw.turns else axis
                total += coefficient * np.sum(motion * weight, axis=1)
        return total

    def beam(self, row: int) -> Beam:
        screws = self.posture.chain.screws
        index = next(i for i, s in enumerate(screws) if s.row == row and not s.turns)
        axis, root = self.posture.axis(index)
        before = self.posture.shifts_mm[screws[index].before]
        carried = self.posture.shifts_mm[index + 1] - before  # pure translation along the axis
        length_mm = self.constants[row - 1].a + np.sum(carried * axis, axis=1)
        # The bent tip: loads act where the beam has come to rest.
        tip = root + length_mm[:, None] * axis
        for bend in self.bent:
            if self._follows(row, bend.frame):
                tip = tip + bend.shift_mm
        force, moment, own = np.zeros_like(tip), np.zeros_like(tip), np.zeros_like(tip)
        for mass in self.masses:
            weight = self._weight_newton(mass)
            if self._follows(mass.frame, row):
                force += weight
                moment += np.cross((self.place_mm(mass.frame, mass.place_mm) - tip) / 1e3, weight)
            elif mass.frame == row - 1:
                own += weight
        return Beam(axis, length_mm / 1e3, root + length_mm[:, None] * axis, force, moment, own)

    def _axis(self, index: int, screw: Screw) -> tuple[Floats, Floats]:
        axis, point = self.posture.axis(index)
        for bend in self.bent:
            # A bend comes after its row's driven length and before its row's joint.
            if self._follows(screw.row, bend.frame) and (screw.row != bend.frame or screw.turns):
                axis = (rotation_by_vector(bend.rotation_vector) @ axis[:, :, None])[:, :, 0]
                point = _bent(bend, point)
        return axis, point

    def _follows(self, frame: int, other: int) -> bool:
        """Whether a frame is another one or beyond it."""
        return other in (0, *self.rig.path(frame))

    def _weight_newton(self, mass: _PointMass) -> Floats:
        n = len(next(iter(self.read.values())))
        kg = np.full(n, mass.kg)
        if mass.is_payload and "payload_kg" in self.columns:
            kg = self.column("payload_kg")
        return kg[:, None] * self.gravity


def replace_effects(truth: RigTruth, effects: Sequence[Effect]) -> RigTruth:
    """The same machine with other hidden effects; ValueError as for `RigTruth`."""
    for effect in effects:
        effect.check(truth.rig)
    other = object.__new__(RigTruth)
    other.__dict__.update(truth.__dict__, effects=tuple(effects))
    return other


def _bent(bend: Bend, point: Floats) -> Floats:
    turned = (rotation_by_vector(bend.rotation_vector) @ (point - bend.about_mm)[:, :, None])[:, :, 0]
    moved: Floats = bend.about_mm + turned + bend.shift_mm
    return moved


def _perturbed(own: RowConstants, row: Row, rig: Rig, draw: Floats) -> RowConstants:
    length, angle, beta = rig.tolerances.length_mm, *np.deg2rad([rig.tolerances.angle_deg, rig.tolerances.beta_deg])
    has_beta = rig.convention != "dh" or "beta" in row.identify
    return RowConstants(
        alpha=own.alpha + angle * draw[0],
        a=own.a + length * draw[1],
        d=own.d + length * draw[2],
        theta=own.theta + angle * draw[3],
        beta=own.beta + (beta * draw[4] if has_beta else 0.0),
        b=own.b + (length * draw[5] if rig.convention == "mdh_beta_before" else 0.0),
    )


def _turn_onto(source: Floats, target: Floats) -> Floats:
    """The shortest rotation that takes one unit vector onto another."""
    cross, cosine = np.cross(source, target), float(source @ target)
    sine = float(np.linalg.norm(cross))
    if sine < 1e-12:  # parallel, or upside down: any axis across will do
        across = np.cross(source, [1.0, 0.0, 0.0] if abs(source[0]) < 0.9 else [0.0, 1.0, 0.0])
        cross, sine = across, float(np.linalg.norm(across))
        vector = np.zeros(3) if cosine > 0 else cross / sine * np.pi
    else:
        vector = cross / sine * np.arctan2(sine, cosine)
    upright: Floats = rotation_by_vector(vector[None, :])[0]
    return upright
