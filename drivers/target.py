"""What a station and its target do, judged from its fixes: silence, lock lost and found."""

from __future__ import annotations

import math

from drivers.clock import NS_PER_S, Stamp
from drivers.readings import DeviceEvent, EventKind, Fix, Gap, GapReason, LockState, Record
from drivers.survey import position_mm

Point = tuple[float, float, float]


class SilenceWatch:
    """Notices that a station gives no more records.

    Args:
        station: its name.
        timeout_s: no record for longer than this is silence; 0: never.
    """

    def __init__(self, station: str, timeout_s: float) -> None:
        self._station = station
        self._timeout_s = timeout_s
        self._heard: Stamp | None = None
        self._silent = False

    def tick(self, now: Stamp) -> list[Record]:
        """The event and the open gap, once, when silence has begun."""
        if self._heard is None or (not self._silent and self._heard.boot_id != now.boot_id):
            self._heard = now
        if self._silent or not self._timeout_s or now.since(self._heard) <= self._timeout_s * NS_PER_S:
            return []
        self._silent = True
        due = self._heard.shifted(round(self._timeout_s * NS_PER_S))
        text = f"no record for {self._timeout_s:g} s"
        return [
            DeviceEvent(self._station, due, EventKind.STATION_SILENT, text),
            Gap(self._station, GapReason.SILENT, self._heard),
        ]

    def heard(self, fix: Fix) -> list[Record]:
        """The closed gap, when this record ends a silence."""
        was_silent, since = self._silent, self._heard
        self._silent, self._heard = False, fix.last_byte
        return [Gap(self._station, GapReason.SILENT, since, fix.stamp)] if was_silent and since is not None else []


class LockWatch:
    """Turns the lock states of a tracking station's fixes into events and gaps.

    A station holds its target when its tracking flag says locked and there is a distance. Fixes of stations that do
    not say (`LockState.UNKNOWN`) pass unseen.
    """

    def __init__(self, station: str) -> None:
        self._station = station
        self._last_held: Stamp | None = None
        self._last_point: Point | None = None
        self._lost_since: Stamp | None = None

    def see(self, fix: Fix) -> list[DeviceEvent | Gap]:
        """Events and gaps that this fix brings."""
        if fix.lock is LockState.UNKNOWN:
            return []
        held = fix.lock is LockState.LOCKED and fix.slope_distance_m is not None
        if held:
            found = self._found(fix) if self._lost_since is not None or self._last_held is None else []
            self._last_held, self._lost_since = fix.stamp, None
            self._last_point = position_mm(fix) or self._last_point
            return found
        if self._lost_since is not None:
            return []
        self._lost_since = self._last_held or fix.stamp
        return [
            DeviceEvent(self._station, fix.stamp, EventKind.LOCK_LOST, f"prism not tracked: {fix.reason}"),
            Gap(self._station, GapReason.LOCK_LOST, self._lost_since),
        ]

    def _found(self, fix: Fix) -> list[DeviceEvent | Gap]:
        text, point = "prism tracked", position_mm(fix)
        if point is not None and self._last_point is not None:
            text += f" again, {_distance_m(point, self._last_point):.2f} m from where it was lost"
        found: list[DeviceEvent | Gap] = [DeviceEvent(self._station, fix.stamp, EventKind.LOCK_ACQUIRED, text)]
        if self._lost_since is not None:
            found.append(Gap(self._station, GapReason.LOCK_LOST, self._lost_since, fix.stamp))
        return found


def _distance_m(one: Point, other: Point) -> float:
    return math.dist(one, other) / 1000
