"""Candidate poses: drawn inside the joint limits, reachable and in view of the station, each with its conditions."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from calibration.design.conditions import Conditions, drawn, under
from calibration.design.exchange import Integers
from calibration.design.knowledge import Knowledge
from calibration.design.visibility import Bodies, Flags, Site, in_view, is_reachable, limits
from calibration.errors import UnsafeError
from calibration.observations import Floats

CANDIDATES = 10_000
_BATCHES = 10
_MARGIN = 0.01  # distance kept from a joint's limits, as a share of its range
_NEAR = 100  # neighbours drawn for each pose
_WIDTHS = 0.02, 0.2  # smallest and largest 1 sigma step of a neighbour, as a share of a joint's range
_TRIED = 64  # poses used to find which conditions matter


@dataclass(frozen=True)
class Candidates:
    """Poses that the rig can take.

    Attributes:
        readings: (n, joints) deg or mm.
        conditions: the conditions under which each pose is to be measured.
        seen: (n, prisms) mask of the prisms in view.
    """

    readings: Floats
    conditions: Conditions
    seen: Flags

    def __len__(self) -> int:
        return len(self.readings)

    @property
    def fixes(self) -> Floats:
        """(n,) number of fixes of each prism in view."""
        return self.conditions.get("fixes", np.ones(len(self)))

    @property
    def fixes_in_all(self) -> int:
        """Number of fixes of all prisms in all poses."""
        return int(self.fixes @ self.seen.sum(axis=1))

    def few(self) -> Candidates:
        """Return a subset large enough to find which conditions matter."""
        return self.select(np.arange(min(_TRIED, len(self))))

    def select(self, which: Integers) -> Candidates:
        """Select poses by index."""
        conditions = {name: values[which] for name, values in self.conditions.items()}
        return Candidates(self.readings[which], conditions, self.seen[which])

    def under(self, names: Collection[str]) -> Candidates:
        """Keep only the named conditions."""
        return replace(self, conditions=under(self.conditions, names))


def draw(
    knowledge: Knowledge,
    at: Site,
    rng: np.random.Generator,
    count: int = CANDIDATES,
    *,
    begin_s: float = 0.0,
    payload_kg: float = 0.0,
) -> Candidates:
    """Draw poses that the rig can take and in which the station sees at least one prism.

    Half of them are uniform between the joint limits. The other half follows the arcsine distribution, which favours
    poses near the limits, where errors are largest.

    Args:
        knowledge: knowledge of the rig.
        at: station and floor.
        rng: random generator.
        count: number of poses.
        begin_s: earliest `time_s` at which the poses can be measured.
        payload_kg: as for `conditions.drawn`.

    Raises:
        UnsafeError: no such pose was found.
    """
    chain = knowledge.chain
    low, high = limits(chain.rig)
    margin = _MARGIN * (high - low)
    readings, seen = np.empty((0, len(low))), np.empty((0, len(chain.rig.prisms)), dtype=bool)
    for _ in range(_BATCHES):
        share = rng.random((count, len(low)))
        share[::2] = np.sin(0.5 * np.pi * share[::2]) ** 2
        tried = low + margin + (high - low - 2.0 * margin) * share
        bodies = Bodies.of(chain, knowledge.x, tried)
        view = in_view(bodies, at)
        good = is_reachable(bodies, at) & view.any(axis=1)
        readings, seen = np.concatenate([readings, tried[good]]), np.concatenate([seen, view[good]])
        if len(readings) >= count:
            break
    if len(readings) == 0:
        raise UnsafeError(
            f"of {_BATCHES * count} poses inside the joint limits of rig {chain.rig.name!r} none is reachable with a "
            f"prism in view of the station at {', '.join(f'{c:.0f}' for c in at.station_mm)} mm in the base frame; "
            f"check the station's place and the floor"
        )
    readings, seen = readings[:count], seen[:count]
    conditions = drawn(chain.rig, len(readings), rng, begin_s=begin_s, payload_kg=payload_kg)
    return Candidates(readings, conditions, seen)


def near(knowledge: Knowledge, at: Site, rng: np.random.Generator, poses: Candidates) -> tuple[Candidates, Integers]:
    """Draw neighbours of given poses: some joints differ a little, the conditions are the same.

    Args:
        knowledge: knowledge of the rig.
        at: station and floor.
        rng: random generator.
        poses: the given poses.

    Returns:
        The given poses and their neighbours that the rig can take and in which at least the same prisms are in view;
        and for each the index of its given pose, (n,). Each given pose comes before its neighbours.
    """
    low, high = limits(knowledge.chain.rig)
    margin = _MARGIN * (high - low)
    number = np.repeat(np.arange(len(poses)), _NEAR)
    about = poses.select(number)
    width = np.tile(np.geomspace(*_WIDTHS, _NEAR), len(poses))[:, None]
    moved = width * rng.standard_normal(about.readings.shape) * (rng.random(about.readings.shape) < 0.5)
    moved[::_NEAR] = 0.0
    tried = np.clip(about.readings + (high - low) * moved, low + margin, high - margin)
    bodies = Bodies.of(knowledge.chain, knowledge.x, tried)
    good = np.flatnonzero(is_reachable(bodies, at) & (in_view(bodies, at) >= about.seen).all(axis=1))
    return replace(about, readings=tried).select(good), number[good]


def work_volume(knowledge: Knowledge, at: Site, rng: np.random.Generator, count: int) -> Floats:
    """Draw poses uniformly among those that the rig can take, whether in view of the station or not.

    Args:
        knowledge: knowledge of the rig.
        at: station and floor.
        rng: random generator.
        count: number of poses.

    Returns:
        (m, joints) poses, deg or mm; m < count where most draws are unreachable.

    Raises:
        UnsafeError: no such pose was found.
    """
    low, high = limits(knowledge.chain.rig)
    found = np.empty((0, len(low)))
    for _ in range(_BATCHES):
        drawn = rng.uniform(low, high, (count, len(low)))
        found = np.concatenate([found, drawn[is_reachable(Bodies.of(knowledge.chain, knowledge.x, drawn), at)]])
        if len(found) >= count:
            return found[:count]
    if len(found) == 0:
        raise UnsafeError(
            f"rig {knowledge.chain.rig.name!r} can take none of {_BATCHES * count} poses inside its joint limits "
            f"without touching itself or the floor at {at.floor_mm:.0f} mm; check the floor"
        )
    return found
