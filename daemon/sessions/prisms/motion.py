"""Motion of a target between fixes, compared with the motion of the joints.

Two prisms 1.5 m apart are nearer to each other than a fast prism moves from one fix to the next, so distance alone does
not show that a station has changed from one to the other. The joints do, because they give how far the prism has moved.
The distance between two places depends neither on the place nor on the orientation of the station.
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

LATE_S = 0.25  # largest difference between the instants of a fix and of its joints while the boom moves
USUALLY_LATE = 0.2  # usual part of this difference: a target further off, where another prism would be, is that prism
SLACK_MM = 100.0  # droop, sway and noise between two fixes
NEAR_MM = 500.0  # the joints do not distinguish targets nearer to each other than this; within a standstill places do
OF_WAY = 0.05  # part of the way by which the machine as built may differ from its nominal kinematics


@dataclass(frozen=True)
class _NominalFix:
    """A fix of a station, with the nominal places of all prisms.

    Attributes:
        since: the station's last turn before the fix.
        place_mm: place of the target in the station's frame.
        nominal_mm: (prisms, 3) place of each prism computed from the joints, in the base's frame.
        slack_mm: (prisms,) largest error of each place caused by the motion of the boom.
    """

    since: Stamp
    place_mm: Place
    nominal_mm: Floats
    slack_mm: Floats


class TargetMotion:
    """Compares each fix of a station with the previous one, and with the first since its last turn.

    Where the boom moves slowly, the difference between a target's motion and the joints' is small from one fix to the
    next; it adds up from the first fix on.

    Args:
        rig: the machine; its nominal kinematics are used.
    """

    def __init__(self, rig: Rig) -> None:
        self._joints = rig.joints
        self._prisms = rig.prism_names
        self._chain = Chain(rig, {"": Placement.identity()})
        self._x = np.zeros(len(self._chain))
        self._first: dict[str, _NominalFix] = {}
        self._latest: dict[str, _NominalFix] = {}

    def jump_m(self, joined: JoinedFix, place_mm: Place, prism: str, since: Stamp, *, is_sure: bool) -> float | None:
        """Add a fix, and return how far its target jumped since the previous fix, m; None if the joints explain it.

        Args:
            joined: the fix with its joints; a fix with a missing joint is skipped.
            place_mm: place of its target in the station's frame.
            prism: the session's prism.
            since: the station's last turn: only fixes since then are compared.
            is_sure: the previous target was that prism as far as is known; otherwise it may have been any prism or a
                stationary reflector.
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
        """Return how far a station's target has strayed since its last turn, m; None if the joints explain it.

        Applies to the newest fix, if that is not a jump. A target that strays was another target from the turn on.
        """
        seen = self._latest[station]
        return self._between(self._first[station], seen, prism, is_sure=True)

    def _between(self, before: _NominalFix, seen: _NominalFix, prism: str, *, is_sure: bool) -> float | None:
        """Return how far the target jumped between two fixes, m; None if the joints explain its place."""
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
        # From where this prism was to where each prism is now
        changed_mm = np.linalg.norm(seen.nominal_mm - before.nominal_mm[number], axis=1)
        is_as_if = np.abs(way_mm - changed_mm) <= _limit_mm(changed_mm, USUALLY_LATE * slack_mm)
        if is_as_if[number] or (explained[number] and not is_as_if.any()):
            return None
        return float(unexplained_mm[number]) / 1000

    def _seen(self, joined: JoinedFix, place_mm: Place, since: Stamp) -> _NominalFix:
        values, joints, prisms = joined.values, self._joints, len(self._prisms)
        now = np.array([values[joint.column] for joint in joints])
        change = np.array([values.get(f"{joint.name}_rate", 0.0) for joint in joints]) * LATE_S
        readings = np.repeat([now, now + change], prisms, axis=0)
        prism = np.tile(np.arange(prisms), 2)
        data = ChainData(readings, prism, np.zeros(2 * prisms, dtype=np.intp))
        nominal_mm, later_mm = np.split(self._chain.positions_mm(self._x, data), 2)
        return _NominalFix(since, place_mm, nominal_mm, np.linalg.norm(later_mm - nominal_mm, axis=1))


def _limit_mm(way_mm: Floats, slack_mm: Floats) -> Floats:
    """Return the largest difference (prisms,) between measured and nominal ways, mm."""
    limit_mm: Floats = SLACK_MM + OF_WAY * way_mm + slack_mm
    return limit_mm
