"""Guard of the session's prism: a pure state machine over one station's fixes in a session.

A total station follows any reflector that it finds, and fixes of a wrong one look as good as before. Only an operator
knows which prism the station is on: the operator who starts a session names the prism, and the station is assumed to be
on it at that time.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import median_high

from drivers.clock import NS_PER_S, Order, Stamp, lies_within
from drivers.readings import DeviceEvent, EventKind, Fix, LockState, Status
from drivers.stations.config import StationConfig
from drivers.stations.survey import position_mm

CONFIRM = "`rigcal session confirm-prism`"
UNTIL = f"until the station is back on the session's prism, or until an operator confirms the prism with {CONFIRM}"
USUAL_OF = 5  # number of intervals; their median is not changed by a single late fix or pause
USUAL_NS = NS_PER_S  # largest usual interval, and the one assumed while fewer than three are known
PAUSE_NS = 2 * NS_PER_S  # during a pause of this length a station aimed by hand may have been aimed at another target
TURN_NS = 10 * NS_PER_S  # a jump this long after the station was told to turn is not the turn
SUSPECTED = "perhaps another prism: "  # prefix of the reasons; stored reasons are read, so it must not change
_METRES = re.compile(r"(\d+\.\d+) m\b")  # the distance in a reason

_Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class MotionLimit:
    """Limits of the motion of a prism, and how a station follows it.

    Attributes:
        max_speed_m_s: highest speed of a prism. The default is the bound of a field-proven program, 1 m between polls
            0.2 s apart.
        slack_m: added to every distance, for noise and for jitter of the fixes' instants.
        relock_within_m: a new lock further than this from where the prism was lost may be on another prism.
        tracks: the station follows a prism by itself although its records do not show it.
    """

    max_speed_m_s: float = 5.0
    slack_m: float = 0.1
    relock_within_m: float = 2.0
    tracks: bool = False

    @classmethod
    def of_station(cls, config: StationConfig) -> MotionLimit:
        """Return the limits given by a station's configuration."""
        return cls(config.max_speed_m_s, config.jump_slack_m, config.relock_within_m, config.tracks_silently)

    def reach_m(self, within_ns: float) -> float:
        """Return the largest distance between two fixes of one prism measured `within_ns` of each other."""
        return self.slack_m + self.max_speed_m_s * max(0.0, within_ns) / NS_PER_S


@dataclass(frozen=True, slots=True)
class OperatorConfirmation:
    """Confirmation by an operator or a program that a station is on the session's prism; fixes alone cannot show it.

    Attributes:
        at: instant from which the station is on the session's prism.
        is_turning: the station was told to turn to the prism, and may still measure its earlier target.
    """

    at: Stamp
    is_turning: bool = False


@dataclass(frozen=True, slots=True)
class Suspicion:
    """A stretch of fixes that may be of another prism.

    Attributes:
        station: station that measured the fixes.
        since: instant of the first of them.
        distance_m: distance of the station's target from the place of the session's prism at the target's last jump.
        until: instant from which fixes are used again; None while the suspicion lasts.
        evidence: why it may be another prism, a clause; a jump by default.
    """

    station: str
    since: Stamp
    distance_m: float
    until: Stamp | None = None
    evidence: str = ""

    @property
    def reason(self) -> str:
        """Reason why calibration must not use its fixes."""
        evidence = self.evidence or f"the station's target jumped by {self.distance_m:.2f} m"
        return f"{SUSPECTED}{evidence}"

    @property
    def remedy(self) -> str:
        """Instruction to the operator."""
        zeros = "check that no joint's zero has changed, and " if self.evidence else ""
        if_already = f"if it is already on that prism, {zeros}confirm it with {CONFIRM}"
        return f"aim {self.station} at the session's prism; {if_already}"


@dataclass(frozen=True, slots=True)
class Turn:
    """An instant from which the station may have a new target.

    Attributes:
        at: instant of the first fix since then.
        is_believed: an operator confirmed just before it that the station is on the session's prism.
    """

    at: Stamp
    is_believed: bool = False


@dataclass(frozen=True, slots=True)
class _FixPlace:
    """Where and when a fix was measured, and whether by circles or by the instrument's own coordinates."""

    point: _Point
    stamp: Stamp
    has_circles: bool

    def distance_m(self, other: _FixPlace) -> float:
        return math.dist(self.point, other.point) / 1000


@dataclass
class PrismGuard:
    """Suspects fixes that may be of a prism other than the session's.

    A suspicion begins with two successive fixes that lie further apart than motion can explain, or with a new lock far
    from where the prism was lost, because a search finds any prism. However long the new target is followed, it ends
    only

    - by a confirmation: an operator confirms that the station is on the session's prism, or it was told to turn to it;
    - by new evidence: the target jumps again, or is locked again, near the last place of the prism.

    A station that is aimed by hand (single shots, tens of seconds apart) is aimed again for every pose. Between such
    shots a prism can move far, and only faster motion is suspected. Positions from circles and from the instrument's
    own coordinates have different origins and are never compared. The first fix after a confirmation is believed.

    Fixes are stamped with when they were measured: when they were read, less the link delay. After a fix that was read
    late, the next one appears too soon. Therefore two successive fixes are assumed to be at least the usual interval
    apart.

    Attributes:
        station: name of the station.
        limit: limits of the prism's motion.
        confirmations: confirmations in the session, oldest first; the list grows during the session.
        order: order of instants.
        suspicions: all suspicions so far; only the last one can still last.
        turns: all turns so far, in order; between two turns the station follows one target.
    """

    station: str
    limit: MotionLimit
    confirmations: Sequence[OperatorConfirmation]
    order: Order
    suspicions: list[Suspicion] = field(default_factory=list)
    turns: list[Turn] = field(default_factory=list)
    _is_believed: bool = False
    _heeded: int = 0  # number of confirmations applied
    _good: _FixPlace | None = None  # the last fix that was surely of the prism
    _near_m: float = 0.0  # a target that jumps to within this distance of `_good` is the prism again
    _last: _FixPlace | None = None
    _intervals_ns: deque[int] = field(default_factory=partial(deque, maxlen=USUAL_OF))  # between the last fixes
    _is_new_lock: bool = False
    _is_turning: bool = False
    _turning_until: Stamp | None = None
    _before_turn: _FixPlace | None = None  # the last fix before the station was told to turn

    @property
    def suspicion(self) -> Suspicion | None:
        """The suspicion that lasts; None without one, or where the newest confirmation has ended it."""
        lasting = self._lasting()
        return lasting if lasting is not None and len(self.confirmations) == self._heeded else None

    def doubt(self, stamp: Stamp) -> Suspicion | None:
        """Return the suspicion that applies to a fix of that instant; None if there is none."""
        return next((s for s in self.suspicions if lies_within(self.order, stamp, s.since, s.until)), None)

    def turn(self, stamp: Stamp) -> Turn | None:
        """Return the last turn before a fix of that instant; None if there is none."""
        number = bisect_right(self.turns, self.order(stamp), key=lambda turn: self.order(turn.at))
        return self.turns[number - 1] if number else None

    def suspect(self, turn: Turn, distance_m: float, evidence: str) -> Suspicion:
        """Suspect the fixes from a turn to the next turn; without a next turn the suspicion lasts.

        Args:
            turn: the turn.
            distance_m: distance of the target from the place of the session's prism.
            evidence: why it may be another prism, a clause.
        """
        self.clear(turn)
        until = self._next(turn)
        made = Suspicion(self.station, turn.at, distance_m, until, evidence)
        self.suspicions.append(made)
        self.suspicions.sort(key=lambda suspicion: self.order(suspicion.since))
        if until is None:
            self._good = None  # the place of the prism is unknown
        return made

    def suspect_again(self, stamp: Stamp, reason: str) -> None:
        """Restore a suspicion of an earlier run of the daemon, which may have had more evidence than the fixes.

        Args:
            stamp: instant of a fix given to `see`.
            reason: why the earlier run excluded its observation; other reasons are ignored.
        """
        if reason.startswith(SUSPECTED) and self.doubt(stamp) is None:
            metres = _METRES.search(reason)
            self.suspect(Turn(stamp), float(metres[1]) if metres else 0.0, reason.removeprefix(SUSPECTED))

    def clear(self, turn: Turn) -> None:
        """Remove suspicions of the fixes from a turn to the next turn: they are of the session's prism."""
        begin, until = turn.at, self._next(turn)
        left: list[Suspicion] = []
        for suspicion in self.suspicions:
            if not lies_within(self.order, suspicion.since, begin, None):
                left.append(replace(suspicion, until=self._earlier(suspicion.until, begin)))
            if until is not None and (suspicion.until is None or self.order(suspicion.until) > self.order(until)):
                since = max(suspicion.since, until, key=self.order)
                left.append(replace(suspicion, since=since))
        if until is None and self._lasting() is not None:
            self._good = self._last
        self.suspicions[:] = left

    def _earlier(self, until: Stamp | None, other: Stamp) -> Stamp:
        return other if until is None else min(until, other, key=self.order)

    def _next(self, turn: Turn) -> Stamp | None:
        """Return when the station next turned; None if it has not."""
        number = bisect_right(self.turns, self.order(turn.at), key=lambda one: self.order(one.at))
        return self.turns[number].at if number < len(self.turns) else None

    def may_turn(self, at: Stamp) -> bool:
        """Return True if the station was told to turn shortly before that instant, and no fix shows that it has."""
        last = next((one for one in reversed(self.confirmations) if self.order(one.at) <= self.order(at)), None)
        if last is None or not last.is_turning or not lies_within(self.order, at, None, last.at.shifted(TURN_NS)):
            return False
        return sum(lies_within(self.order, turn.at, last.at, at) for turn in self.turns) <= 1

    def part(self, at: Stamp) -> Turn:
        """Add a turn that the fixes alone did not show; its evidence is known only after the fixes."""
        made = Turn(at)
        self.turns.append(made)
        self.turns.sort(key=lambda turn: self.order(turn.at))
        return made

    def look_away(self) -> None:
        """Note that the station was deliberately on another target: its next fix is compared as after a new lock."""
        self._is_new_lock = True

    def see(self, fix: Fix) -> DeviceEvent | None:
        """Add a fix, in order, stamped with when it was measured; return an event for the operator if there is one."""
        while self._heeded < len(self.confirmations) and self.order(fix.stamp) >= self.order(
            self.confirmations[self._heeded].at
        ):
            self._heed(self.confirmations[self._heeded])
        if fix.status is Status.NOT_AVAILABLE and (fix.lock is not LockState.UNKNOWN or self.limit.tracks):
            self._is_new_lock = True
        point = position_mm(fix)
        if point is None or fix.status is Status.TIME_DOUBTFUL:  # its speed is not known
            return None
        seen = _FixPlace(point, fix.stamp, fix.slope_distance_m is not None)
        is_new_lock, self._is_new_lock = self._is_new_lock, False
        last, self._last = self._last, seen
        if last is not None and last.stamp.boot_id == seen.stamp.boot_id:
            self._intervals_ns.append(seen.stamp.since(last.stamp))
        if self._turning_until is not None and lies_within(self.order, seen.stamp, self._turning_until, None):
            self._is_turning = False
        before, self._before_turn = self._before_turn, None
        if before is not None and self._has_jumped(before, seen):
            self._is_turning = False  # it had already turned: a later loss of lock is not the turn
        if is_new_lock or last is None or self._has_turned(last, seen):
            self.turns.append(Turn(seen.stamp, self._is_believed))
            self._is_believed = False
        suspicion = self._lasting()
        if suspicion is not None:
            return self._judge_suspected(suspicion, seen, last, is_new_lock)
        good, self._good = self._good, seen
        if self._is_turning and is_new_lock:
            self._is_turning = False  # that was the turn
            return None
        if good is None or good.has_circles != seen.has_circles:
            return None
        return self._judge(seen, good, is_new_lock)

    def _heed(self, confirmation: OperatorConfirmation) -> None:
        self._heeded += 1
        self._end_suspicion(confirmation.at)
        self._before_turn = self._last if confirmation.is_turning else None
        self._good = self._last = None
        if not confirmation.is_turning:  # a station that turns continues to measure as before
            self._intervals_ns.clear()
        self._is_new_lock, self._is_turning = False, confirmation.is_turning
        self._turning_until = confirmation.at.shifted(TURN_NS)
        self._is_believed = not confirmation.is_turning

    def _judge(self, seen: _FixPlace, good: _FixPlace, is_new_lock: bool) -> DeviceEvent | None:
        moved_m = good.distance_m(seen)
        explained_m = self._reach_m(good, seen)
        if is_new_lock:
            is_one_boot = good.stamp.boot_id == seen.stamp.boot_id
            explained_m = min(explained_m, self.limit.relock_within_m) if is_one_boot else self.limit.relock_within_m
        if moved_m <= explained_m:
            return None
        if self._is_turning:
            self._is_turning = False  # that was the turn, although no record showed it
            return None
        self._good = good
        # At most half of the jump, so that of two prisms near each other only one is taken for the earlier target
        self._near_m = min(self.limit.relock_within_m, moved_m / 2)
        self.suspicions.append(Suspicion(self.station, seen.stamp, moved_m))
        seconds = seen.stamp.since(good.stamp) / NS_PER_S
        how = "locked again" if is_new_lock else "the target moved"
        return self._event(
            seen,
            EventKind.PRISM_JUMP,
            f"{how} {moved_m:.2f} m away after {seconds:.2f} s: perhaps another prism; its fixes are not used {UNTIL}",
        )

    def _judge_suspected(
        self, suspicion: Suspicion, seen: _FixPlace, last: _FixPlace | None, is_new_lock: bool
    ) -> DeviceEvent | None:
        good = self._good
        if good is None or last is None or good.has_circles != seen.has_circles:
            return None
        is_aimed_anew = is_new_lock or (seen.stamp.since(last.stamp) > PAUSE_NS)
        has_jumped = self._has_jumped(last, seen)
        if not (is_aimed_anew or has_jumped):
            return None
        back_m = good.distance_m(seen)
        if back_m <= self._near_m:
            self._end_suspicion(seen.stamp)
            self._good = seen
            text = "the target is the earlier prism again; its fixes are used again"
            return self._event(seen, EventKind.LOCK_ACQUIRED, text)
        self.suspicions[-1] = replace(suspicion, distance_m=back_m)
        if not (is_new_lock or has_jumped):
            return None
        how = "locked again" if is_new_lock else "the target jumped again"
        text = f"{how} {back_m:.2f} m from the prism: perhaps another prism; its fixes are still not used"
        return self._event(seen, EventKind.PRISM_JUMP, text)

    def _has_turned(self, last: _FixPlace, seen: _FixPlace) -> bool:
        """Return True if a fix may be of another target than the previous fix although no lock was lost."""
        has_paused = last.has_circles != seen.has_circles or seen.stamp.since(last.stamp) > PAUSE_NS
        return has_paused or self._has_jumped(last, seen)

    def _has_jumped(self, last: _FixPlace, seen: _FixPlace) -> bool:
        """Return True if a fix is further from the previous fix than motion can explain."""
        return last.has_circles == seen.has_circles and last.distance_m(seen) > self._reach_m(last, seen)

    def _reach_m(self, earlier: _FixPlace, later: _FixPlace) -> float:
        usual_ns = min(USUAL_NS, median_high(self._intervals_ns)) if len(self._intervals_ns) > 2 else USUAL_NS
        return self.limit.reach_m(max(usual_ns, later.stamp.since(earlier.stamp)))

    def _lasting(self) -> Suspicion | None:
        return self.suspicions[-1] if self.suspicions and self.suspicions[-1].until is None else None

    def _end_suspicion(self, at: Stamp) -> None:
        suspicion = self._lasting()
        if suspicion is not None:
            self.suspicions[-1] = replace(suspicion, until=at)

    def _event(self, seen: _FixPlace, kind: EventKind, text: str) -> DeviceEvent:
        return DeviceEvent(self.station, seen.stamp, kind, text)
