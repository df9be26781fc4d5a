"""Decoder of a total station: captures to fixes, events and gaps; silence and loss of lock are derived from fixes."""

from __future__ import annotations

import math
from dataclasses import replace

from drivers.clock import NS_PER_S, Stamp
from drivers.readings import (
    Capture,
    DeviceEvent,
    EventKind,
    Fix,
    Gap,
    GapReason,
    LockState,
    Record,
    SerialCapture,
    Status,
)
from drivers.stall_detector import NOT_READ_IN_TIME
from drivers.stations.config import StationConfig
from drivers.stations.replies import Reply
from drivers.stations.survey import position_mm, range_checked

_UNFINISHED_NS = 2 * NS_PER_S  # an unfinished record is discarded after this, even if no more bytes arrive

Point = tuple[float, float, float]


class StationDecoder:
    """Decodes captures of a station's link into fixes, events, gaps and failures (`drivers.readings.Decoder`).

    A fix is stamped with the arrival of its first byte; if that time is doubtful, the fix may not be used. Transmitted
    captures give no records. Records caused by the passing of time are stamped with the instant at which they were due,
    so they do not depend on how often `tick` is called.

    Args:
        config: configuration of the station, the same as its link's.
    """

    def __init__(self, config: StationConfig) -> None:
        self._reader = config.reply_reader()
        self._lock = LockWatch(config.name)
        self._max_range_m = config.max_range_m
        self._silence = SilenceWatch(config.name, config.silence_timeout_s)
        self._last_byte: Stamp | None = None

    def feed(self, capture: Capture) -> list[Record]:
        if not isinstance(capture, SerialCapture):
            return []
        records = self.tick(capture.stamp)
        if not capture.is_transmitted:
            self._last_byte = capture.stamp
        for reply in self._reader.feed(capture):
            records += self._records(reply)
        return records

    def tick(self, now: Stamp) -> list[Record]:
        records: list[Record] = []
        if self._last_byte is not None and now.since(self._last_byte) > _UNFINISHED_NS:
            # In the order of their deadlines, so that the result does not depend on how often `tick` is called
            records += self._silence.tick(self._last_byte.shifted(_UNFINISHED_NS))
            for reply in self._reader.flush("incomplete record"):
                records += reply.records
            self._last_byte = None
        return records + self._silence.tick(now)

    def _records(self, reply: Reply) -> list[Record]:
        records: list[Record] = []
        for record in reply.records:
            if isinstance(record, Fix):
                fix = _without_time(record) if record.stamp.is_doubtful else record
                fix = range_checked(fix, self._max_range_m)
                records += [*self._silence.heard(fix), *self._lock.see(fix), fix]
            else:
                records.append(record)
        return records


def _without_time(fix: Fix) -> Fix:
    """Return a fix that was read late as unusable, because the time of its measurement is unknown."""
    if fix.status is not Status.OK:
        return fix
    return replace(fix, status=Status.TIME_DOUBTFUL, reason=f"its time is doubtful: {NOT_READ_IN_TIME}")


class SilenceWatch:
    """Reports a station that sends no more records.

    Args:
        station: name of the station.
        timeout_s: no record for longer than this is silence; 0 to disable.
    """

    def __init__(self, station: str, timeout_s: float) -> None:
        self._station = station
        self._timeout_s = timeout_s
        self._heard: Stamp | None = None
        self._silent = False

    def tick(self, now: Stamp) -> list[Record]:
        """Return the event and the open gap once when a silence has begun."""
        if self._heard is None or (not self._silent and self._heard.boot_id != now.boot_id):
            self._heard = now
        if self._silent or not self._timeout_s or now.since(self._heard) <= self._timeout_s * NS_PER_S:
            return []
        self._silent = True
        due = self._heard.shifted(round(self._timeout_s * NS_PER_S))
        text = f"no record for {self._timeout_s:g} s; check the station, its power and its cable"
        return [
            DeviceEvent(self._station, due, EventKind.STATION_SILENT, text),
            Gap(self._station, GapReason.SILENT, self._heard),
        ]

    def heard(self, fix: Fix) -> list[Record]:
        """Return the closed gap if this record ends a silence."""
        was_silent, since = self._silent, self._heard
        self._silent, self._heard = False, fix.last_byte
        return [Gap(self._station, GapReason.SILENT, since, fix.stamp)] if was_silent and since is not None else []


class LockWatch:
    """Turns the lock states of a tracking station's fixes into events and gaps.

    A station holds its target if its tracking flag is "locked" and there is a distance. Fixes of stations without such
    a flag (`LockState.UNKNOWN`) are ignored.
    """

    def __init__(self, station: str) -> None:
        self._station = station
        self._last_held: Stamp | None = None
        self._last_point: Point | None = None
        self._lost_since: Stamp | None = None

    def see(self, fix: Fix) -> list[DeviceEvent | Gap]:
        """Return the events and gaps caused by this fix."""
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
            text += f" again, {math.dist(point, self._last_point) / 1000:.2f} m from where it was lost"
        found: list[DeviceEvent | Gap] = [DeviceEvent(self._station, fix.stamp, EventKind.LOCK_ACQUIRED, text)]
        if self._lost_since is not None:
            found.append(Gap(self._station, GapReason.LOCK_LOST, self._lost_since, fix.stamp))
        return found
