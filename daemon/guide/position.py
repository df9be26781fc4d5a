"""Positions of boom and station for a guide: joints compared with a pose, last fixes with control points."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.rig.description import Rig
from calibration.rig.limits import on_one_turn
from daemon.acquisition.joiner import MachineState, ObservationJoiner
from daemon.guide.job import Pose
from daemon.sessions.station_setups import CONTROL_POINT_RADIUS_MM, Place
from daemon.store.queries.guides import Standstill
from drivers.clock import NS_PER_S, Clock
from drivers.readings import Fix, Record
from drivers.stations.survey import position_mm

TOLERANCE = 0.03  # of a joint's range: a pose this close gives nearly as much information as the planned one
FRESH_S = 1.0  # readings older than this are not shown as live
_RECOGNISED = 3  # fixes by which a control point is recognised
_TOGETHER_MM = 20.0  # greatest distance between them for a standing target
_MOVING_S = 0.2


@dataclass(frozen=True)
class BoomPosition:
    """The present joint readings.

    Attributes:
        values: joint -> reading, deg or mm; empty until all joints were read.
        age_s: age of these readings; None if there are none.
        stands_s: for how long the boom has stood; None while it moves.
        is_fresh: whether the readings are live.
        missing: why there are no live readings, a clause; "" if there are or if they are still expected.
    """

    values: Mapping[str, float]
    age_s: float | None
    stands_s: float | None
    is_fresh: bool
    missing: str = ""


class PositionWatch:
    """Keeps the newest joints and fixes. `on_records` runs in the writer's thread, the other methods in any thread.

    Args:
        rig: the machine.
        joiner: source of joint readings.
        clock: clock for the age of readings.
    """

    def __init__(self, rig: Rig, joiner: ObservationJoiner, clock: Clock) -> None:
        self._rig, self._joiner, self._clock = rig, joiner, clock
        self._fixes: deque[tuple[int, Place]] = deque(maxlen=_RECOGNISED)
        self.begin()

    def begin(self) -> None:
        """Start again; earlier readings and fixes no longer count."""
        self._state: MachineState | str | None = None
        self._began_ns = self._clock.now().monotonic_ns
        self._fixes.clear()

    def on_records(self, records: Sequence[Record]) -> None:
        """Process records that the joiner has already processed."""
        for record in records:
            if isinstance(record, Fix) and (place := position_mm(record)) is not None:
                self._fixes.append((record.stamp.monotonic_ns, place))
        self._state = self._joiner.latest()

    def boom(self) -> BoomPosition:
        """Return the present joint readings."""
        state, now = self._state, self._clock.now()
        if state is None:  # nothing was read since `begin`; readings arrive within FRESH_S if at all
            waits = self._clock.real_seconds((now.monotonic_ns - self._began_ns) / NS_PER_S) <= FRESH_S
            return BoomPosition({}, None, None, False, "" if waits else "no joint has been read yet")
        if isinstance(state, str):
            return BoomPosition({}, None, None, False, state)
        read = {joint.name: np.array([state.values[joint.column]]) for joint in self._rig.joints}
        values = {name: float(value[0]) for name, value in on_one_turn(self._rig, read).items()}
        if now.boot_id != state.boot_id:
            return BoomPosition(values, None, None, False, "the joints were last read before the computer restarted")
        age_s = max(0.0, (now.monotonic_ns - state.monotonic_ns) / NS_PER_S)
        is_fresh = self._clock.real_seconds(age_s) <= FRESH_S
        stands_s = state.stands_s if state.stands_s is not None and state.stands_s >= _MOVING_S else None
        missing = "" if is_fresh else f"the joints were last read {age_s:.0f} s ago; is {state.oldest} silent?"
        return BoomPosition(values, age_s, stands_s if is_fresh else None, is_fresh, missing)

    def forget_fixes(self) -> None:
        """Discard the fixes, because the station is turned to a different target."""
        self._fixes.clear()

    def is_at(self, place_mm: Place | None) -> bool:
        """Return True if the station's last fixes are of a standing target near a place; False for None."""
        fixes = [*self._fixes]
        if place_mm is None or len(fixes) < _RECOGNISED:
            return False
        old_ns = self._clock.now().monotonic_ns - fixes[0][0]
        if not 0 <= self._clock.real_seconds(old_ns / NS_PER_S) <= 10.0 * FRESH_S:
            return False
        near = all(math.dist(place, place_mm) < CONTROL_POINT_RADIUS_MM for _, place in fixes)
        return near and all(math.dist(place, fixes[0][1]) < _TOGETHER_MM for _, place in fixes)


def tolerance(low: float, high: float) -> float:
    """Return how far from its target a joint still counts as there, given the limits of its range."""
    return TOLERANCE * (high - low)


def is_there(rig: Rig, values: Mapping[str, float], pose: Pose) -> bool:
    """Return True if every joint is within its tolerance of a pose."""
    return all(abs(pose[j.name] - values[j.name]) <= tolerance(*j.limits) for j in rig.joints)


def joints_of(rig: Rig, standstill: Standstill) -> dict[str, float]:
    """Return the joints of a standstill, deg or mm."""
    return {joint.name: float(standstill.values[joint.column]) for joint in rig.joints}


def joint_rows(rig: Rig, boom: BoomPosition, pose: Pose | None) -> list[dict[str, Any]]:
    """Return reading and target of every joint as JSON objects.

    Args:
        rig: the machine.
        boom: present joint readings.
        pose: target; None if there is none.
    """
    rows = []
    for joint in rig.joints:
        now, target = boom.values.get(joint.name), None if pose is None else pose[joint.name]
        difference = None if now is None or target is None else target - now
        within = tolerance(*joint.limits)
        rows.append(
            {
                "name": joint.name,
                "label": joint.name,
                "unit": joint.unit,
                "low": joint.limits[0],
                "high": joint.limits[1],
                "now": now,
                "age_s": boom.age_s,
                "is_fresh": boom.is_fresh,
                "target": target,
                "difference": difference,
                "tolerance": within,
                "is_there": None if difference is None else abs(difference) <= within,
            }
        )
    return rows
