"""Motion of a target from one fix to the next, held against what the joints did meanwhile.

Two prisms that stand 1.5 m from each other are nearer than a fast prism moves from one fix to the next, so distance
alone does not tell that a station has changed from one to the other. The joints do: they say how far the prism has
moved. A distance between two places needs neither the place of the station nor the direction in which it looks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calibration.kinematics.chain import Chain, ChainData, Placement
from calibration.observations import Floats
from calibration.rig.description import Rig
from daemon.acquisition.joiner import JoinedFix
from daemon.sessions.station_setups import Place
from drivers.clock import Stamp

LATE_S = 0.25  # by so much the instants of fixes and of joints may differ while the boom moves
USUALLY_LATE = 0.2  # of it: beyond that, a place that another prism would have is taken for another prism
SLACK_MM = 100.0  # droop, sway and noise, between two fixes
NEAR_MM = 500.0  # targets nearer to each other than this the joints do not tell apart; within a standstill places do
OF_WAY = 0.05  # of the way between them, for what the build may differ by


@dataclass(frozen=True)
class _Seen:
    """A fix of a station.

    Attributes:
        since: the station's last turn before it.
        place_mm: in the station's frame.
        nominal_mm: (prisms, 3) where each prism is by the joints, in the base's frame.
        slack_mm: (prisms,) how far each may be from there, as the boom moves.
    """

    since: Stamp
    place_mm: Place
    nominal_mm: Floats
    slack_mm: Floats


class TargetMotion:
    """Compares each fix of a station with the one before, and with the first since its last turn.

    What a target moves otherwise than the joints say is little from one fix to the next where the boom moves slowly; it
    adds up from the first on.

    Args:
        rig: the machine; its nominal kinematics are used.
    """

    def __init__(self, rig: Rig) -> None:
        self._joints = rig.joints
        self._prisms = rig.prism_names
        self._chain = Chain(rig, {"": Placement.identity()})
        self._x = np.zeros(len(self._chain))
        self._first: dict[str, _Seen] = {}
        self._latest: dict[str, _Seen] = {}

    def jump_m(self, joined: JoinedFix, place_mm: Place, prism: str, since: Stamp, *, is_sure: bool) -> float | None:
        """Take a fix: how far the target jumped since fixes before, m; None where the joints explain where it is.

        Args:
            joined: with all joints.
            place_mm: of its target.
            prism: that is meant.
            since: the station's last turn: only a fix since then is compared.
            is_sure: the target before was that prism as far as is known; else it may have been any, or stood still.
        """
        if not all(joint.column in joined.values for joint in self._joints):
            return None
        seen, station = self._seen(joined, place_mm, since), joined.fix.station
        before, self._latest[station] = self._latest.get(station), seen
        if before is None or before.since != since:
            self._first[station] = seen
            return None
        return self._between(before, seen, prism, is_sure=is_sure)

    def stray_m(self, station: str, prism: str) -> float | None:
        """Return how far a station's target has strayed since its last turn, m; None where the joints explain it.

        Of the fix that was taken last, where it is no jump. A target that strays was another one from the turn on.
        """
        seen = self._latest[station]
        return self._between(self._first[station], seen, prism, is_sure=True)

    def _between(self, before: _Seen, seen: _Seen, prism: str, *, is_sure: bool) -> float | None:
        """Return how far the target jumped between two fixes, m; None where the joints explain where it is."""
        way_mm = math.dist(before.place_mm, seen.place_mm)
        expected_mm = np.linalg.norm(seen.nominal_mm - before.nominal_mm, axis=1)
        unexplained_mm = np.abs(way_mm - expected_mm)
        slack_mm = before.slack_mm + seen.slack_mm
        explained = unexplained_mm <= _limit_mm(expected_mm, slack_mm)
        number = self._prisms.index(prism)
        if unexplained_mm[number] <= NEAR_MM:
            return None
        if not is_sure:
            return None if explained.any() or way_mm <= SLACK_MM else float(unexplained_mm[number]) / 1000
        # From where this prism was to where each of them is now
        changed_mm = np.linalg.norm(seen.nominal_mm - before.nominal_mm[number], axis=1)
        is_as_if = np.abs(way_mm - changed_mm) <= _limit_mm(changed_mm, USUALLY_LATE * slack_mm)
        if is_as_if[number] or (explained[number] and not is_as_if.any()):
            return None
        return float(unexplained_mm[number]) / 1000

    def _seen(self, joined: JoinedFix, place_mm: Place, since: Stamp) -> _Seen:
        values, joints, prisms = joined.values, self._joints, len(self._prisms)
        now = np.array([values[joint.column] for joint in joints])
        change = np.array([values.get(f"{joint.name}_rate", 0.0) for joint in joints]) * LATE_S
        readings = np.repeat([now, now + change], prisms, axis=0)
        prism = np.tile(np.arange(prisms), 2)
        data = ChainData(readings, prism, np.zeros(2 * prisms, dtype=np.intp))
        nominal_mm, later_mm = np.split(self._chain.positions_mm(self._x, data), 2)
        return _Seen(since, place_mm, nominal_mm, np.linalg.norm(later_mm - nominal_mm, axis=1))


def _limit_mm(way_mm: Floats, slack_mm: Floats) -> Floats:
    """Return by how much (prisms,) ways may differ from what the joints say, mm."""
    limit_mm: Floats = SLACK_MM + OF_WAY * way_mm + slack_mm
    return limit_mm
