"""The machine behind a rig description: the same structure, its own parameters, and imperfections not in any rig file.

It is deliberately independent of the calibration's kinematics: it uses a product of exponentials instead of multiplied
rows, and its own effects, so that a mistake in one is not hidden by the same mistake in the other.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.errors import RigError
from calibration.rig.description import Rig, Row, parse_rig, shipped_rig, shipped_rigs
from simulators.effects.base import Bend, Effect, Sight
from simulators.rig.body import LoadedBody, PointMass
from simulators.rig.screws import (
    RowConstants,
    nominal_constants,
    pose_chain,
    rotation_by_vector,
    screw_chain,
)

Floats = NDArray[np.float64]

STANDARD_GRAVITY = 9.80665  # m/s^2
MASS_UNCERTAINTY = 0.15  # the rig file's masses are within +-15 % of the machine's
TILT_SIGMA_DEG = 0.5  # tilt of a carrier on its jacks
_ROUNDS = 4  # most iterations of the fixed point load -> deflection -> load; each gains two to three digits


@dataclass(frozen=True)
class Placement:
    """Pose of the machine's base in the station's frame (x east, y north, z up, mm).

    Attributes:
        rotation: (3, 3) base axes in the station's frame.
        position_mm: (3,) the base's origin.
    """

    rotation: Floats
    position_mm: Floats

    def to_station_mm(self, points_mm: Floats) -> Floats:
        """Transform (n, 3) points from the base frame to the station's frame."""
        moved: Floats = points_mm @ self.rotation.T + self.position_mm
        return moved


def load_rig(name_or_path: str) -> Rig:
    """Return a shipped rig by name, or a rig by the path of its file; RigError if there is none."""
    if name_or_path in shipped_rigs():
        return shipped_rig(name_or_path)
    try:
        return parse_rig(Path(name_or_path).read_text(encoding="utf-8"), name_or_path)
    except (OSError, UnicodeDecodeError) as error:
        shipped = ", ".join(shipped_rigs())
        raise RigError(name_or_path, "", f"not a shipped rig ({shipped}) and not a readable file: {error}") from error


class RigTruth:
    """A true machine.

    Attributes:
        rig: the description, from which the machine deviates.
        effects: its hidden effects.
        constants: its true row constants.

    Args:
        rig: the description.
        seed: the same seed builds the same machine.
        perturbation: deviation in units of build tolerances (and of mass uncertainties); 0 gives the nominal machine. A
            prism with an unknown offset is always drawn with its full tolerance.
        effects: hidden effects.

    Raises:
        ValueError: an effect has no place on this rig.
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
        self._chain = screw_chain(rig, self.constants)
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

    def _build_masses(self, rng: np.random.Generator, perturbation: float) -> tuple[PointMass, ...]:
        masses = []
        for mass in self.rig.masses:
            kg = mass.kg * (1.0 + perturbation * rng.uniform(-MASS_UNCERTAINTY, MASS_UNCERTAINTY))
            if mass.centre_mm is not None:
                masses.append(PointMass(mass.frame, np.array(mass.centre_mm), kg, mass.payload))
            else:  # midway between two origins: half at each gives the same force, moment and energy
                origins = (mass.frame, mass.frame + 1)
                masses.extend(PointMass(frame, np.zeros(3), kg / 2, mass.payload) for frame in origins)
        return tuple(masses)

    def prism_offset_mm(self, name: str) -> Floats:
        """Return the (3,) true position of a prism in its frame; KeyError if it is unknown."""
        return self._prisms[name][1]

    @property
    def masses(self) -> tuple[PointMass, ...]:
        """The true weights."""
        return self._masses

    def placement(self, setup: str = "") -> Placement:
        """Return the machine's pose in the frame of a station set-up: a few metres away, facing away from it."""
        if setup not in self._placements:
            self._placements[setup] = self._place(np.random.default_rng([self.seed, 3, zlib.crc32(setup.encode())]))
        return self._placements[setup]

    def _place(self, rng: np.random.Generator) -> Placement:
        down = np.array(self.rig.gravity) / np.linalg.norm(self.rig.gravity)
        upright = _turn_onto(-down, np.array([0.0, 0.0, 1.0]))
        yaw = rotation_by_vector(np.array([[0.0, 0.0, rng.uniform(0, 2 * np.pi)]]))[0]
        tilt = rotation_by_vector(np.array([[*np.deg2rad(rng.normal(0, TILT_SIGMA_DEG, 2)), 0.0]]))[0]
        R = tilt @ yaw @ upright
        # The middle of the work volume, relative to the base, gives reach and working direction
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
        """Return the (n, 3) true position of a prism in the station's frame.

        Args:
            name: name of the prism.
            joints: joint name -> (n,) noise-free readings of encoders and transducers, deg or mm.
            columns: name -> (n,) further observation columns that effects need (`theta4_dir`, `payload_kg`, ...).
            setup: name of the station set-up.

        Raises:
            KeyError: the prism is unknown, or a joint is missing.
            ValueError: an effect needs a column that is missing.
        """
        frame, place = self._prisms[name]
        body = self._solve(joints, columns or {}, setup)
        placement = self.placement(setup)
        station_mm = placement.to_station_mm(body.place_mm(frame, place))
        if not self.effects:
            return station_mm
        sight = Sight(name, station_mm, placement.rotation @ body.axes(frame), body.column)
        shifts = [shift for effect in self.effects if (shift := effect.fix_shift_mm(sight)) is not None]
        return station_mm + np.sum(shifts, axis=0) if shifts else station_mm

    def gravity_load(
        self, joint: str, joints: Mapping[str, Floats], columns: Mapping[str, Floats] | None = None, *, setup: str = ""
    ) -> Floats:
        """Return the (n,) generalised gravity force on a joint, N m or N; positive increases the joint's value.

        Args:
            joint: name of the joint.
            joints: joint name -> (n,) noise-free readings, deg or mm.
            columns: `payload_kg` -> (n,) if the payload differs from the rig description's.
            setup: name of the station set-up.
        """
        loose = replace_effects(self, ()) if self.effects else self
        return loose._solve(joints, columns or {}, setup).torque(joint)

    def row_moment(self, row: int, joints: Mapping[str, Floats]) -> Floats:
        """Return the (n, 3) moment, in the base frame in N m, of all weights that turn with a row about its axis point.

        Args:
            row: number of the row, whose `theta` must be driven.
            joints: joint name -> (n,) noise-free readings, deg or mm.
        """
        loose = replace_effects(self, ()) if self.effects else self
        return loose._solve(joints, {}, "").turning(row).moment_newton_m

    def _solve(self, joints: Mapping[str, Floats], columns: Mapping[str, Floats], setup: str | None) -> LoadedBody:
        read = {}
        for joint in self.rig.joints:
            values = np.atleast_1d(np.asarray(joints[joint.name], dtype=float))
            read[joint.name] = np.deg2rad(values) if joint.kind == "revolute" else values
        rotation = np.eye(3) if setup is None else self.placement(setup).rotation
        gravity = rotation.T @ np.array([0.0, 0.0, -STANDARD_GRAVITY])
        n = len(next(iter(read.values())))
        posture = pose_chain(self._chain, read)
        body = LoadedBody(
            self.rig, read, read, columns, gravity, self._masses, self.constants, posture, (), np.zeros(n)
        )
        if setup is None or not self.effects:
            return body
        read = self._at_the_fix(body)
        body = replace(body, read=read, true=read)
        before: tuple[Floats, ...] = ()
        for _ in range(_ROUNDS):
            true, turns, bends, growth = dict(read), dict[int, Floats](), list[Bend](), np.zeros(n)
            for effect in self.effects:
                if (change := effect.joint_change(body)) is not None:
                    true[effect.where] = true[effect.where] + change
                for row, turn in effect.row_turns(body).items():
                    turns[row] = turns.get(row, 0.0) + turn
                bends.extend(effect.bends(body))
                if (share := effect.growth(body)) is not None:
                    growth = growth + share
            now = (growth, *true.values(), *turns.values())
            now += tuple(part for bend in bends for part in (bend.rotation_vector, bend.shift_mm, bend.about_mm))
            if len(before) == len(now) and all(map(np.array_equal, now, before)):
                break
            before = now
            bent = tuple(sorted(bends, key=lambda bend: -bend.frame))
            posture = pose_chain(self._chain, true, self._screw_turns(turns))
            body = replace(body, true=true, posture=posture, bent=bent, growth=growth)
        return body

    def _at_the_fix(self, body: LoadedBody) -> dict[str, Floats]:
        """Return the readings at the instant of the fix, computed from readings taken slightly later."""
        delays = [delay for effect in self.effects if (delay := effect.delay_s(body)) is not None]
        read = dict(body.read)
        if delays:
            for joint in self.rig.joints:
                rate = body.column(f"{joint.name}_rate")
                travelled = np.sum(delays, axis=0) * (np.deg2rad(rate) if joint.kind == "revolute" else rate)
                read[joint.name] = read[joint.name] - travelled
        return read

    def _screw_turns(self, turns: Mapping[int, Floats]) -> dict[int, Floats]:
        """Convert row number -> angle to number of the row's turning motion -> angle."""
        return {i: turns[s.row] for i, s in enumerate(self._chain.screws) if s.turns and s.row in turns}


def replace_effects(truth: RigTruth, effects: Sequence[Effect]) -> RigTruth:
    """Return the same machine with different hidden effects; ValueError as in `RigTruth`."""
    for effect in effects:
        effect.check(truth.rig)
    other = object.__new__(RigTruth)
    other.__dict__.update(truth.__dict__, effects=tuple(effects))
    return other


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
    """Return the shortest rotation that maps one unit vector to another."""
    cross, cosine = np.cross(source, target), float(source @ target)
    sine = float(np.linalg.norm(cross))
    if sine < 1e-12:  # parallel or opposite: any perpendicular axis is suitable
        across = np.cross(source, [1.0, 0.0, 0.0] if abs(source[0]) < 0.9 else [0.0, 1.0, 0.0])
        cross, sine = across, float(np.linalg.norm(across))
        vector = np.zeros(3) if cosine > 0 else cross / sine * np.pi
    else:
        vector = cross / sine * np.arctan2(sine, cosine)
    upright: Floats = rotation_by_vector(vector[None, :])[0]
    return upright
