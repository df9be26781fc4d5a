"""Places of one standstill: the boom does not move, so fixes of its prism lie at one place.

A station that lost its prism may lock on to another prism or a reflection, and its fixes look as good as before. Where
the fixes of a standstill lie at several places, the place with the most fixes is taken for the prism's, and the fixes
at the others are excluded; while two places have equally many fixes, both are excluded. More fixes may change the
decision. After an operator confirms the prism, only fixes since then are counted. A restart of the daemon does not end
a standstill.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from calibration.rig.description import Rig
from daemon.sessions.station_setups import Place

# Fixes of a standing prism scatter by some mm, in tracking mode by 10 mm, and a long boom that has just stopped sways
# by some tens of mm. Two prisms, or a prism and a reflection, that are nearer to each other than this look like one.
SAME_PLACE_MM = 100.0
MOST_PLACES = 100
ELSEWHERE = "another prism or a reflection"  # the reasons for these exclusions begin with it
SETTLED_FIXES = 50_000  # hours of fixes; later fixes do not change the decision
EVERY_FIX = 64  # up to this many fixes the decision is checked with each fix, later after every total / 64 fixes

Exclusions = dict[int, str | None]
"""Instant of a fix, monotonic ns -> why calibration must not use the fix; None if it may."""


class Standstill(NamedTuple):
    """Identifier of a standstill in a session.

    Attributes:
        session: id of the session.
        run: number of the run of the daemon.
        number: number of the standstill within the run.
    """

    session: str
    run: int
    number: int

    @property
    def pose(self) -> str:
        """Its name in the table of observations."""
        return f"{self.run}.{self.number}"

    @classmethod
    def of_pose(cls, session: str, pose: str) -> Standstill:
        """Return the standstill with that name in the table of observations."""
        run, _, number = pose.partition(".")
        return cls(session, int(run), int(number))


@dataclass
class _Place:
    """A place at which fixes of one standstill lie.

    Attributes:
        first_mm: place of its first fix.
        latest_mm, joints: place of its latest fix, and the joints then; a boom that sinks slowly counts as standing.
        count: number of fixes there since an operator last confirmed the prism.
        instants_ns: instants of the fixes whose exclusion may still change.
        excluded: why these fixes must not be used.
    """

    first_mm: Place
    latest_mm: Place
    joints: Mapping[str, float]
    count: int = 0
    instants_ns: list[int] = field(default_factory=list)
    excluded: str | None = None


class StandstillPlaces:
    """The places of the present standstill.

    Args:
        rig: the machine, whose joints show how far a boom that counts as standing has moved.
    """

    def __init__(self, rig: Rig) -> None:
        self._travel_mm = travel_mm(rig)
        self._standstill: Standstill | None = None
        self._joints: Mapping[str, float] = {}  # at the latest fix
        self._places: list[_Place] = []
        self._fixes = 0
        self._decided_at = 0
        self._confirmations = 0

    def add(
        self, standstill: Standstill, at_ns: int, place_mm: Place, values: Mapping[str, float], confirmations: int = 0
    ) -> Exclusions:
        """Add a fix.

        Args:
            standstill: the fix's standstill; a new one discards all places. The first one of a new run of the daemon is
                not new if the joints are where they were.
            at_ns: when the fix was measured, monotonic within the standstill.
            place_mm: place of the fix, in the station's frame.
            values: observations CSV column -> number, with the joints at that instant.
            confirmations: how often an operator had confirmed the prism by then; fixes since the last time decide.

        Returns:
            The exclusion of this fix, and of earlier fixes of the standstill whose exclusion has changed.
        """
        joints = {column: values[column] for column in self._travel_mm if column in values}
        if not self._is_present(standstill, joints):
            self._places, self._fixes, self._decided_at, self._confirmations = [], 0, 0, confirmations
        self._standstill, self._joints = standstill, joints
        if confirmations > self._confirmations:
            self._confirmations, self._decided_at = confirmations, 0
            for place in self._places:
                place.count = 0
        place = self._place(place_mm, joints)
        place.latest_mm, place.joints = place_mm, joints
        place.count += 1
        self._fixes += 1
        changed: Exclusions = {}
        if self._fixes <= SETTLED_FIXES:
            place.instants_ns.append(at_ns)
            if self._fixes - self._decided_at > self._decided_at // EVERY_FIX:
                changed = self._decide()
        changed[at_ns] = place.excluded
        return changed

    def withdraw(self, instants_ns: Collection[int]) -> Exclusions:
        """Remove fixes that are known to be of another prism, and return the exclusions that change."""
        gone = set(instants_ns)
        for place in self._places:
            kept = [at_ns for at_ns in place.instants_ns if at_ns not in gone]
            place.count = max(0, place.count - (len(place.instants_ns) - len(kept)))
            place.instants_ns = kept
        self._places = [place for place in self._places if place.count > 0]
        self._decided_at = 0
        return self._decide() if self._places else {}

    def _is_present(self, standstill: Standstill, joints: Mapping[str, float]) -> bool:
        """Return True if a standstill is the present one, or goes on after a restart: the prism is where it was."""
        present = self._standstill
        if present is None or present.session != standstill.session or present.run == standstill.run:
            return present == standstill
        return self._moved_mm(self._joints, joints) <= SAME_PLACE_MM

    def _place(self, place_mm: Place, joints: Mapping[str, float]) -> _Place:
        """Return the nearest place that a fix may belong to, or a new place."""
        near = [place for place in self._places if self._is_near(place, place_mm, joints)]
        if near:
            return min(near, key=lambda place: math.dist(place_mm, place.latest_mm))
        if len(self._places) == MOST_PLACES:
            self._places.remove(min(self._places, key=lambda p: p.count))  # its fixes stay excluded
        made = _Place(place_mm, place_mm, joints)
        if self._places:
            made.excluded = _another(made, max(self._places, key=lambda p: p.count))
        self._places.append(made)
        return made

    def _is_near(self, place: _Place, place_mm: Place, joints: Mapping[str, float]) -> bool:
        """Return True if scatter, sway and the joints' motion explain the distance from a place's latest fix."""
        return math.dist(place_mm, place.latest_mm) <= SAME_PLACE_MM + self._moved_mm(place.joints, joints)

    def _moved_mm(self, before: Mapping[str, float], now: Mapping[str, float]) -> float:
        """Return the largest motion of any prism that the joints' changes explain."""
        changes = {column: now[column] - before[column] for column in now.keys() & before.keys()}
        return sum(change_size(column, change) * self._travel_mm[column] for column, change in changes.items())

    def _decide(self) -> Exclusions:
        """Exclude all places except the one with the most fixes, and return the exclusions that change."""
        self._decided_at = self._fixes
        most = max(place.count for place in self._places)
        first, *others = [place for place in self._places if place.count == most]
        changed: Exclusions = {}
        for place in self._places:
            excluded = None
            if place.count < most:
                excluded = _another(place, first)
            elif others:
                excluded = _undecided(place, others[0] if place is first else first)
            if excluded != place.excluded:
                place.excluded = excluded
                changed.update(dict.fromkeys(place.instants_ns, excluded))
        return changed


def _another(place: _Place, prism: _Place) -> str:
    return f"{ELSEWHERE}: more fixes of this standstill lie {_metres(place, prism)} m away"


def _undecided(place: _Place, other: _Place) -> str:
    return f"{ELSEWHERE}: as many fixes of this standstill lie {_metres(place, other)} m away"


def _metres(place: _Place, other: _Place) -> str:
    return f"{math.dist(place.first_mm, other.first_mm) / 1000:.2f}"


def change_size(column: str, change: float) -> float:
    """Return the size of a joint's change; for an angle, of the shorter way round."""
    return abs(math.remainder(change, 360.0) if column.endswith("_deg") else change)


def travel_mm(rig: Rig) -> dict[str, float]:
    """Return, for each joint's column, the largest motion in mm of any prism for a change of 1 in the column."""
    reach_mm = sum(abs(row.a_mm) + abs(row.d_mm) + abs(row.b_mm) for row in rig.rows)
    reach_mm += sum(math.hypot(b.x_mm, b.y_mm, b.z_mm) for row in rig.rows if (b := row.before) is not None)
    reach_mm += sum(max(map(abs, joint.limits)) for joint in rig.joints if joint.kind == "prismatic")
    reach_mm += max(math.hypot(*prism.offset_mm) for prism in rig.prisms)
    driven: dict[str, float] = {}
    for _, _, name, coefficient in rig.couplings():
        driven[name] = driven.get(name, 0.0) + abs(coefficient)
    lever_mm = {"deg": math.radians(reach_mm), "mm": 1.0}
    return {joint.column: driven[joint.name] * lever_mm[joint.unit] for joint in rig.joints}
