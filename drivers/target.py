"""What a station and its target do, judged from its fixes: silence, lock lost and found, jumps to another prism."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from drivers.clock import NS_PER_S, Stamp
from drivers.readings import DeviceEvent, EventKind, Fix, Gap, GapReason, LockState, Record, Status
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


@dataclass(frozen=True, slots=True)
class MotionLimit:
    """What motion can do to a prism.

    Attributes:
        max_speed_m_s: faster than this no prism moves. The default is the bound of a field-proven program, 1 m
            between polls 0.2 s apart.
        slack_m: added to every distance, for noise and for jitter of the fixes' instants.
        new_target_after_s: a target followed for this long, without a break, is accepted as the one that is meant.
    """

    max_speed_m_s: float = 5.0
    slack_m: float = 0.1
    new_target_after_s: float = 30.0

    def reach_m(self, earlier: Stamp, later: Stamp) -> float:
        """How far apart two fixes of one prism may be."""
        return self.slack_m + self.max_speed_m_s * max(0, later.since(earlier)) / NS_PER_S


@dataclass(frozen=True, slots=True)
class _Seen:
    point: Point
    stamp: Stamp
    has_circles: bool


@dataclass(frozen=True, slots=True)
class _Jump:
    """Since a jump: where the target stood before, where it went, how far that was."""

    good: _Seen
    onto: _Seen
    distance_m: float


class JumpGuard:
    """Refuses the fixes of a prism that the station has jumped to.

    Two successive usable fixes that lie further apart than motion can explain are a jump: the second, and every fix
    that follows it without a break, is refused (OUT_OF_RANGE, with the reason). Fixes count again when

    - the target jumps back: a second break, that ends within reach of the last good fix and nearer to it than half
      the jump, so that the time passed does not make every place reachable;
    - the station lost lock and found its target again: the operator, or the search, has aimed anew;
    - the same target was followed for `new_target_after_s`: it is taken for an intended change.

    The last two are told to the operator, who alone knows which prism is meant. A pause makes more distance
    reachable: single shots tens of seconds apart are not judged in effect, and the first fix of all is believed.
    Positions by circles and by the instrument's own coordinates have different origins and are never compared.
    """

    def __init__(self, station: str, limit: MotionLimit) -> None:
        self._station = station
        self._limit = limit
        self._last: _Seen | None = None
        self._jump: _Jump | None = None
        self._lock_lost = False

    def see(self, fix: Fix) -> tuple[Fix, DeviceEvent | None]:
        """The fix, refused if it belongs to another prism, and what there is to tell."""
        if fix.lock not in (LockState.UNKNOWN, LockState.LOCKED):
            self._lock_lost = True
        point = position_mm(fix)
        if point is None:
            return fix, None
        seen = _Seen(point, fix.stamp, fix.slope_distance_m is not None)
        relocked, self._lock_lost = self._lock_lost, False
        last, self._last = self._last, seen
        if last is None or last.has_circles != seen.has_circles or last.stamp.boot_id != seen.stamp.boot_id:
            self._jump = None
            return fix, None
        if self._jump is None:
            return self._judge(fix, last, seen)
        return self._judge_after(self._jump, fix, last, seen, relocked)

    def _judge(self, fix: Fix, last: _Seen, seen: _Seen) -> tuple[Fix, DeviceEvent | None]:
        moved_m = _distance_m(last.point, seen.point)
        if moved_m <= self._limit.reach_m(last.stamp, seen.stamp):
            return fix, None
        self._jump = _Jump(last, seen, moved_m)
        seconds = seen.stamp.since(last.stamp) / NS_PER_S
        text = f"target moved {moved_m:.2f} m in {seconds:.2f} s: another prism; its fixes are refused"
        return self._refused(fix), DeviceEvent(self._station, fix.stamp, EventKind.PRISM_JUMP, text)

    def _judge_after(
        self, jump: _Jump, fix: Fix, last: _Seen, seen: _Seen, relocked: bool
    ) -> tuple[Fix, DeviceEvent | None]:
        back_m = _distance_m(jump.good.point, seen.point)
        breaks = relocked or _distance_m(last.point, seen.point) > self._limit.reach_m(last.stamp, seen.stamp)
        if breaks and back_m <= min(self._limit.reach_m(jump.good.stamp, seen.stamp), jump.distance_m / 2):
            return self._accepted(fix, "target is the earlier prism again; its fixes count")
        if relocked:
            return self._accepted(
                fix,
                f"target is {back_m:.2f} m from the earlier one after a new lock; its fixes count from now on: "
                "make sure that it is the prism that is meant",
            )
        if breaks:
            self._jump = replace(jump, onto=seen)
            text = f"target jumped again, {back_m:.2f} m from the earlier prism; its fixes are refused"
            return self._refused(fix), DeviceEvent(self._station, fix.stamp, EventKind.PRISM_JUMP, text)
        followed_ns = seen.stamp.since(jump.onto.stamp)
        if followed_ns >= self._limit.new_target_after_s * NS_PER_S:
            return self._accepted(
                fix,
                f"target {back_m:.2f} m from the earlier one was followed for {followed_ns / NS_PER_S:.0f} s; its "
                "fixes count from now on: make sure that it is the prism that is meant",
            )
        return self._refused(fix), None

    def _accepted(self, fix: Fix, text: str) -> tuple[Fix, DeviceEvent]:
        self._jump = None
        return fix, DeviceEvent(self._station, fix.stamp, EventKind.LOCK_ACQUIRED, text)

    @staticmethod
    def _refused(fix: Fix) -> Fix:
        return replace(fix, status=Status.OUT_OF_RANGE, reason="the station jumped to another prism")


def _distance_m(one: Point, other: Point) -> float:
    return math.dist(one, other) / 1000
