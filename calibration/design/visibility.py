"""Reachable poses and prisms in view of the station, with links modelled as capsules.

A rig file gives frames but no shapes. Every link is therefore the straight line between the origins of two consecutive
frames, with its row's `radius_mm`, or by default 1.2 % of the reach. A pedestal stands between the base and the floor.
All coordinates are in the base frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.kinematics.chain import Chain, ChainData, Placement
from calibration.kinematics.compiled_chain import CompiledChain
from calibration.observations import Floats
from calibration.rig.description import Rig

Flags = NDArray[np.bool_]

NEAREST_MM = 1500.0  # shortest range of a total station, and a safe distance from a moving boom
FARTHEST_MM = 500_000.0
STEEPEST_DEG = 60.0  # above and below the horizon
_RADIUS = 0.012  # assumed radius of a link, half the width of a boom, as a share of the reach
_FLOOR = 0.15  # assumed depth of the floor below the base, as a share of the reach
_SURFACE = 0.7  # a prism is mounted on its link's surface: the radius is at most this share of its distance to the axis
_NEIGHBOURS = 2.0  # links closer along the chain than this multiple of their summed radii are joined by a bracket
_BY_DESIGN = 0.5  # links that touch in more than this share of poses touch by design, as they are not really straight
_LEAST_LINK_MM = 1.0
_SPREAD_POSES = 256
_RING = 16  # directions around the base that are tried for the station
_DISTANCES = (0.4, 0.8, 1.2)  # distances that are tried for the station, as shares of the reach
_EYE_MM = 1600.0  # height of the instrument above the floor


@dataclass(frozen=True)
class Site:
    """The surroundings of a rig: station and floor.

    Attributes:
        station_mm: (3,) the instrument's centre.
        up: (3,) unit vector against gravity.
        reach_mm: largest distance of a frame or prism from the base's origin.
        floor_mm: height of the floor above the base's origin, along `up`.
        radii_mm: (row number, radius) of the links whose rows give a radius.
        apart: pairs of links that must not touch, by row number; 0 is the pedestal.
    """

    station_mm: Floats
    up: Floats
    reach_mm: float
    floor_mm: float
    radii_mm: tuple[tuple[int, float], ...] = ()
    apart: tuple[tuple[int, int], ...] = ()

    @property
    def assumed_radius_mm(self) -> float:
        """Radius of the pedestal and of the links whose rows give no radius."""
        return _RADIUS * self.reach_mm

    def radius_mm(self, number: int) -> float:
        """Return the radius of the link with a row number, or of the pedestal for 0."""
        return dict(self.radii_mm).get(number, self.assumed_radius_mm)

    @property
    def rules(self) -> tuple[str, ...]:
        """Sentences that define reachable and in view."""
        given = ", ".join(f"{radius:g} mm of row {number}" for number, radius in self.radii_mm)
        radii = f"an assumed radius of {self.assumed_radius_mm:.0f} mm{f', but {given}' if given else ''}"
        return (
            f"reachable: inside the joint limits, nothing lower than the floor at {self.floor_mm:.0f} mm above the "
            f"base's origin, links (straight between their frames, with {radii}; a row's radius_mm sets it) clear of "
            f"each other and of the base",
            f"in view: the line of sight is clear of all links, {NEAREST_MM / 1e3:g} .. {FARTHEST_MM / 1e3:g} m long "
            f"and within {STEEPEST_DEG:g} deg of the horizon",
        )


@dataclass(frozen=True)
class Bodies:
    """The machine in n poses, in the base frame.

    Attributes:
        rig: the rig description.
        frames_mm: (n, rows + 1, 3) origins of the base and of the frame after each row.
        prisms_mm: (n, prisms, 3).
    """

    rig: Rig
    frames_mm: Floats
    prisms_mm: Floats

    @classmethod
    def of(cls, chain: Chain, x: Floats, readings: Floats) -> Bodies:
        """Compute the machine's bodies at readings (n, joints), deg or mm, of a chain with parameters `x` (p,)."""
        n, prisms = len(readings), len(chain.rig.prisms)
        here = Chain(chain.rig, {"": Placement.identity()})
        own = np.concatenate([x[: chain.base_start], np.zeros(6)])
        zero = np.zeros(n * prisms, dtype=np.intp)
        every = ChainData(np.repeat(readings, prisms, axis=0), np.tile(np.arange(prisms), n), zero)
        located = CompiledChain(here, own).locate(every)
        return cls(chain.rig, located.frames_mm[::prisms], located.position_mm.reshape(n, prisms, 3))

    def __len__(self) -> int:
        return len(self.frames_mm)

    @property
    def everything_mm(self) -> Floats:
        """(n, frames + prisms, 3) positions of all frames and prisms."""
        return np.concatenate([self.frames_mm, self.prisms_mm], axis=1)

    @cached_property
    def _parents(self) -> tuple[int, ...]:
        """The frame that each row continues from."""
        return tuple((0, *self.rig.path(number))[-2] for number in range(1, len(self.rig.rows) + 1))

    @cached_property
    def _lengths_mm(self) -> Floats:
        """(rows,) mean length of every link."""
        span = self.frames_mm[:, 1:] - self.frames_mm[:, list(self._parents)]
        lengths: Floats = np.linalg.norm(span, axis=2).mean(axis=0)
        return lengths

    @cached_property
    def links(self) -> tuple[int, ...]:
        """Numbers of the rows whose link has a length."""
        return tuple(int(i) + 1 for i in np.flatnonzero(self._lengths_mm >= _LEAST_LINK_MM))

    def link_mm(self, number: int) -> tuple[Floats, Floats]:
        """Return both ends, each (n, 3), of the link of a row."""
        return self.frames_mm[:, self._parents[number - 1]], self.frames_mm[:, number]

    def length_mm(self, number: int) -> float:
        """Return the mean length of the link of a row."""
        return float(self._lengths_mm[number - 1])

    def between_mm(self, one: int, other: int) -> float:
        """Return the mean length along the chain between two links; 0 where they share a frame.

        Links are given by row number; the pedestal is 0 and ends at the base.
        """
        ends = [(self._parents[number - 1], number) if number else (0, 0) for number in (one, other)]
        paths = [set(self.rig.path(a)) ^ set(self.rig.path(b)) for a in ends[0] for b in ends[1]]
        return min(float(sum(self._lengths_mm[number - 1] for number in path)) for path in paths)


def limits(rig: Rig) -> tuple[Floats, Floats]:
    """(joints,) lowest and highest value of every joint, deg or mm."""
    low, high = np.array([joint.limits for joint in rig.joints]).T
    return low, high


def spread_poses(rig: Rig, n: int = _SPREAD_POSES) -> Floats:
    """(n, joints) poses that fill the joint limits evenly, always the same (Kronecker sequence, Roberts' ratios)."""
    joints = len(rig.joints)
    ratio = 2.0
    for _ in range(50):  # the root of g^(d+1) = g + 1
        ratio = (1.0 + ratio) ** (1.0 / (joints + 1))
    low, high = limits(rig)
    turn = (0.5 + np.arange(1, n + 1)[:, None] * ratio ** -np.arange(1.0, joints + 1)) % 1.0
    return np.asarray(low + (high - low) * turn, dtype=np.float64)


def site(
    chain: Chain,
    x: Floats,
    *,
    setup: int | None = None,
    station_mm: Floats | None = None,
    floor_mm: float | None = None,
) -> Site:
    """Determine station and floor of a rig.

    Args:
        chain: kinematics.
        x: (p,) parameters of the chain.
        setup: index of the set-up that gives the station's place.
        station_mm: (3,) place of the station in the base frame. Without it and without a set-up, the station is placed
            on the floor around the base, outside the machine's reach, where it sees most.
        floor_mm: height of the floor above the base's origin; by default 15 % of the reach below it.
    """
    up = -np.array(chain.rig.gravity) / np.linalg.norm(chain.rig.gravity)
    bodies = Bodies.of(chain, x, spread_poses(chain.rig))
    reach = float(np.linalg.norm(bodies.everything_mm, axis=2).max())
    floor = -_FLOOR * reach if floor_mm is None else floor_mm
    radii = tuple((n, row.radius_mm) for n, row in enumerate(chain.rig.rows, 1) if row.radius_mm is not None)
    at = Site(np.zeros(3), up, reach, floor, radii)
    if setup is not None:
        base = chain.base(x, setup)
        at = replace(
            at, station_mm=-base.rotation.T @ base.translation_mm, up=base.rotation.T @ np.array([0.0, 0.0, 1.0])
        )
    elif station_mm is not None:
        at = replace(at, station_mm=np.asarray(station_mm, dtype=np.float64))
    at = replace(at, apart=_apart(bodies, at))
    return _best_place(bodies, at) if setup is None and station_mm is None else at


def placement(at: Site) -> Placement:
    """Return the placement of the base in the frame of a levelled station at `at`."""
    up = at.up
    across = np.cross(np.eye(3)[int(np.argmin(np.abs(up)))], up)
    east = across / np.linalg.norm(across)
    rotation = np.array([east, np.cross(up, east), up])
    if np.allclose(up, [0.0, 0.0, 1.0]):
        rotation = np.eye(3)
    return Placement(rotation, -rotation @ at.station_mm)


def _best_place(bodies: Bodies, at: Site) -> Site:
    toward = placement(at).rotation
    reachable = is_reachable(bodies, at)
    seen_most, best = -1, at
    for distance in _DISTANCES:
        for turn in np.arange(_RING) * (2.0 * math.pi / _RING):
            level = distance * at.reach_mm * (math.cos(turn) * toward[0] + math.sin(turn) * toward[1])
            place = replace(at, station_mm=level + (at.floor_mm + _EYE_MM) * at.up)
            clear = np.linalg.norm(bodies.everything_mm - place.station_mm, axis=2).min() > NEAREST_MM
            seen = int(in_view(bodies, place)[reachable].sum()) if clear or distance == _DISTANCES[-1] else -1
            if seen > seen_most:
                seen_most, best = seen, place
    return best


def is_reachable(bodies: Bodies, at: Site) -> Flags:
    """(n,) mask of the poses in which nothing is below the floor and no link touches another or the pedestal."""
    good: Flags = np.all(bodies.everything_mm @ at.up >= at.floor_mm, axis=1)
    for one, other in at.apart:
        good &= _gap_mm(bodies, at, one, other) >= at.radius_mm(one) + at.radius_mm(other)
    return good


def _apart(bodies: Bodies, at: Site) -> tuple[tuple[int, int], ...]:
    """Return pairs of links that are not neighbours and do not touch by design, by row number; 0 is the pedestal."""
    found = []
    for i, one in enumerate((0, *bodies.links)):
        for other in bodies.links[i:]:
            width = at.radius_mm(one) + at.radius_mm(other)
            if bodies.between_mm(one, other) > _NEIGHBOURS * width:
                touches = _gap_mm(bodies, at, one, other) < width
                if touches.mean() < _BY_DESIGN:
                    found.append((one, other))
    return tuple(found)


def _gap_mm(bodies: Bodies, at: Site, one: int, other: int) -> Floats:
    """(n,) distance between the axes of two links, or of the pedestal and a link."""
    ends = bodies.link_mm(one) if one else _pedestal(at, len(bodies))
    return segment_distance(*ends, *bodies.link_mm(other))


def in_view(bodies: Bodies, at: Site) -> Flags:
    """(n, prisms) mask of the prisms that the station sees."""
    n = len(bodies)
    station = np.broadcast_to(at.station_mm, (n, 3))
    obstacles = [(at.radius_mm(number), bodies.link_mm(number)) for number in bodies.links]
    obstacles.append((at.assumed_radius_mm, _pedestal(at, n)))
    seen = np.ones((n, len(bodies.rig.prisms)), dtype=bool)
    for prism in range(seen.shape[1]):
        target = bodies.prisms_mm[:, prism]
        sight = target - station
        range_mm = np.linalg.norm(sight, axis=1)
        steep = np.abs(sight @ at.up) > math.sin(math.radians(STEEPEST_DEG)) * range_mm
        seen[:, prism] = (range_mm >= NEAREST_MM) & (range_mm <= FARTHEST_MM) & ~steep
        for radius_mm, ends in obstacles:
            on_it = _SURFACE * segment_distance(*ends, target, target)
            seen[:, prism] &= segment_distance(*ends, station, target) >= np.minimum(radius_mm, on_it)
    return seen


def segment_distance(p0: Floats, p1: Floats, q0: Floats, q1: Floats) -> Floats:
    """(n,) shortest distances between line segments p0 p1 and q0 q1, all (n, 3).

    Source: Ericson, Real-Time Collision Detection (2005), section 5.1.9.
    """
    u, v, w = p1 - p0, q1 - q0, p0 - q0
    a, e, b = _dot(u, u), _dot(v, v), _dot(u, v)
    c, f = _dot(u, w), _dot(v, w)
    tiny = 1e-12
    determinant = a * e - b * b
    s = np.clip(np.where(determinant > tiny * a * e, (b * f - c * e) / np.maximum(determinant, tiny), 0.0), 0.0, 1.0)
    t = np.where(e > tiny, (b * s + f) / np.maximum(e, tiny), 0.0)
    t = np.clip(t, 0.0, 1.0)
    s = np.clip(np.where(a > tiny, (b * t - c) / np.maximum(a, tiny), 0.0), 0.0, 1.0)
    distance: Floats = np.linalg.norm(w + s[:, None] * u - t[:, None] * v, axis=1)
    return distance


def _dot(a: Floats, b: Floats) -> Floats:
    product: Floats = np.einsum("ni,ni->n", a, b)
    return product


def _pedestal(at: Site, n: int) -> tuple[Floats, Floats]:
    foot = min(at.floor_mm, 0.0) * at.up
    return np.zeros((n, 3)), np.broadcast_to(foot, (n, 3))
