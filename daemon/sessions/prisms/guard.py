"""Guard of the prism that is meant: a pure state machine over one station's fixes in a session.

A total station follows whatever reflector it finds, and its fixes look as good as before. Which prism is meant only an
operator knows: who starts a session names it, and the station is believed to be on it then.
"""

from __future__ import annotations

import math
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

CONFIRM = "`rigcal session confirm-prism` says that it is the prism that is meant"
USUAL_OF = 5  # intervals, whose median no single late fix and no pause changes
USUAL_NS = NS_PER_S  # at most, and while fewer than three are known
PAUSE_NS = 2 * NS_PER_S  # a station that is aimed by hand may have been aimed anew in so long a time without a fix
TURN_NS = 10 * NS_PER_S  # a jump so long after the station was told to turn is no turn

_Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class MotionLimit:
    """Limit of the motion of a prism, and how a station follows it.

    Attributes:
        max_speed_m_s: faster than this no prism moves. The default is the bound of a field-proven program, 1 m
            between polls 0.2 s apart.
        slack_m: added to every distance, for noise and for jitter of the fixes' instants.
        relock_within_m: a new lock further than this from where the prism was lost may be on another one.
        tracks: the station follows a prism by itself although its records do not say so.
    """

    max_speed_m_s: float = 5.0
    slack_m: float = 0.1
    relock_within_m: float = 2.0
    tracks: bool = False

    @classmethod
    def of_station(cls, config: StationConfig) -> MotionLimit:
        """The limit that a station's configuration gives."""
        return cls(config.max_speed_m_s, config.jump_slack_m, config.relock_within_m, config.tracks_silently)

    def reach_m(self, within_ns: float) -> float:
        """Return the largest distance of two fixes of one prism that were measured within so long a time."""
        return self.slack_m + self.max_speed_m_s * max(0.0, within_ns) / NS_PER_S


@dataclass(frozen=True, slots=True)
class Word:
    """The word of an operator or program that a station is on the prism, which fixes cannot tell.

    Attributes:
        at: from then on the station is on the prism that is meant.
        is_turning: it was told to turn to it, and may still measure what it was on before.
    """

    at: Stamp
    is_turning: bool = False


@dataclass(frozen=True, slots=True)
class Suspicion:
    """A stretch of fixes that may be of another prism.

    Attributes:
        station: whose fixes.
        since: the first of them.
        distance_m: how far from the place of the prism that is meant the station's target was when it last jumped.
        until: fixes from then on count again; None while it lasts.
        evidence: what tells that it may be another prism, a clause; a jump by default.
    """

    station: str
    since: Stamp
    distance_m: float
    until: Stamp | None = None
    evidence: str = ""

    @property
    def reason(self) -> str:
        """Why calibration must not use its fixes."""
        evidence = self.evidence or f"the station's target jumped by {self.distance_m:.2f} m"
        return f"perhaps another prism: {evidence}"

    @property
    def remedy(self) -> str:
        """Instruction to the operator."""
        return f"aim {self.station} at the prism again; where it is on it already, {CONFIRM}"


@dataclass(frozen=True, slots=True)
class Turn:
    """An instant from which on the station may have another target.

    Attributes:
        at: of the first fix since then.
        is_believed: an operator has said before it that the station is on the prism that is meant.
    """

    at: Stamp
    is_believed: bool = False


@dataclass(frozen=True, slots=True)
class _Seen:
    point: _Point
    stamp: Stamp
    has_circles: bool

    def distance_m(self, other: _Seen) -> float:
        return math.dist(self.point, other.point) / 1000


@dataclass
class PrismGuard:
    """Suspects the fixes of a prism that the station may have changed to.

    A suspicion begins with two successive fixes that lie further apart than motion can explain, and with a new lock
    far from where the prism was lost: a search finds any prism. However long the new target is followed, it ends only

    - by a word: an operator says that the station is on the prism that is meant, or it was told to turn to it;
    - when the evidence goes: the target jumps once more, or is locked anew, near the last place of the prism.

    A station that is aimed by hand (single shots, tens of seconds apart) is aimed anew for every pose; between such
    shots motion can come far, and only what is faster is suspected. Positions by circles and by the instrument's own
    coordinates have different origins and are never compared. The first fix after a word is believed.

    Stamps say when fixes were read: one that was read late seems to be followed too soon. So motion between two
    successive fixes has no less time than fixes usually lie apart.

    Attributes:
        station: its name.
        limit: what motion can do.
        words: of the session, oldest first; grows meanwhile.
        order: of instants.
        suspicions: all so far; only the last one can still last.
        turns: all so far, in order; between two of them the station follows one target.
    """

    station: str
    limit: MotionLimit
    words: Sequence[Word]
    order: Order
    suspicions: list[Suspicion] = field(default_factory=list)
    turns: list[Turn] = field(default_factory=list)
    _is_believed: bool = False
    _heeded: int = 0  # words
    _good: _Seen | None = None  # the last fix that was surely of the prism
    _near_m: float = 0.0  # so near to its place a target that has jumped again is the prism
    _last: _Seen | None = None
    _intervals_ns: deque[int] = field(default_factory=partial(deque, maxlen=USUAL_OF))  # between fixes, lately
    _is_new_lock: bool = False
    _is_turning: bool = False
    _turning_until: Stamp | None = None
    _before_turn: _Seen | None = None  # the last fix before the station was told to turn

    @property
    def suspicion(self) -> Suspicion | None:
        """The one that lasts; None where the newest word has ended it."""
        lasting = self._lasting()
        return lasting if lasting is not None and len(self.words) == self._heeded else None

    def doubt(self, stamp: Stamp) -> Suspicion | None:
        """The suspicion under which a fix of that instant falls."""
        return next((s for s in self.suspicions if lies_within(self.order, stamp, s.since, s.until)), None)

    def turn(self, stamp: Stamp) -> Turn | None:
        """The last turn before a fix of that instant; None where it was not seen."""
        number = bisect_right(self.turns, self.order(stamp), key=lambda turn: self.order(turn.at))
        return self.turns[number - 1] if number else None

    def suspect(self, turn: Turn, distance_m: float, evidence: str) -> Suspicion:
        """Suspect the fixes from a turn to the next one, or to the end of a suspicion that lasts."""
        self.clear(turn)
        until = self._next(turn)
        made = Suspicion(self.station, turn.at, distance_m, until, evidence)
        self.suspicions.append(made)
        self.suspicions.sort(key=lambda suspicion: self.order(suspicion.since))
        if until is None:
            self._good = None  # where the prism is nobody knows
        return made

    def clear(self, turn: Turn) -> None:
        """Suspect the fixes from a turn to the next one no more: they are of the prism that is meant."""
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
        """When the station next turned; None before it has."""
        number = bisect_right(self.turns, self.order(turn.at), key=lambda one: self.order(one.at))
        return self.turns[number].at if number < len(self.turns) else None

    def may_turn(self, at: Stamp) -> bool:
        """Return True if the station was told to turn before that instant, and nothing shows yet that it has."""
        last = next((word for word in reversed(self.words) if self.order(word.at) <= self.order(at)), None)
        if last is None or not last.is_turning or not lies_within(self.order, at, None, last.at.shifted(TURN_NS)):
            return False
        return sum(lies_within(self.order, turn.at, last.at, at) for turn in self.turns) <= 1

    def part(self, at: Stamp) -> Turn:
        """Take a turn that fixes alone did not show: what tells of it is known later than they are."""
        made = Turn(at)
        self.turns.append(made)
        self.turns.sort(key=lambda turn: self.order(turn.at))
        return made

    def look_away(self) -> None:
        """The station was on something else on purpose: its next fix is compared as after a new lock."""
        self._is_new_lock = True

    def see(self, fix: Fix) -> DeviceEvent | None:
        """Take a fix, in order; what there is to tell an operator."""
        while self._heeded < len(self.words) and self.order(fix.stamp) >= self.order(self.words[self._heeded].at):
            self._heed(self.words[self._heeded])
        if fix.status is Status.NOT_AVAILABLE and (fix.lock is not LockState.UNKNOWN or self.limit.tracks):
            self._is_new_lock = True
        point = position_mm(fix)
        if point is None or fix.status is Status.TIME_DOUBTFUL:  # how fast it came there is not known
            return None
        seen = _Seen(point, fix.stamp, fix.slope_distance_m is not None)
        is_new_lock, self._is_new_lock = self._is_new_lock, False
        last, self._last = self._last, seen
        if last is not None and last.stamp.boot_id == seen.stamp.boot_id:
            self._intervals_ns.append(seen.stamp.since(last.stamp))
        if self._turning_until is not None and lies_within(self.order, seen.stamp, self._turning_until, None):
            self._is_turning = False
        before, self._before_turn = self._before_turn, None
        if before is not None and self._has_jumped(before, seen):
            self._is_turning = False  # it had turned already: a lock that is lost from now on is no turn
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

    def _heed(self, word: Word) -> None:
        self._heeded += 1
        self._end_suspicion(word.at)
        self._before_turn = self._last if word.is_turning else None
        self._good = self._last = None
        if not word.is_turning:  # a station that turns goes on measuring as before
            self._intervals_ns.clear()
        self._is_new_lock, self._is_turning = False, word.is_turning
        self._turning_until = word.at.shifted(TURN_NS)
        self._is_believed = not word.is_turning

    def _judge(self, seen: _Seen, good: _Seen, is_new_lock: bool) -> DeviceEvent | None:
        moved_m = good.distance_m(seen)
        explained_m = self._reach_m(good, seen)
        if is_new_lock:
            is_one_boot = good.stamp.boot_id == seen.stamp.boot_id
            explained_m = min(explained_m, self.limit.relock_within_m) if is_one_boot else self.limit.relock_within_m
        if moved_m <= explained_m:
            return None
        if self._is_turning:
            self._is_turning = False  # that was the turn, of which no record told
            return None
        self._good = good
        # Half of the jump, lest two prisms that stand near each other are both the earlier one
        self._near_m = min(self.limit.relock_within_m, moved_m / 2)
        self.suspicions.append(Suspicion(self.station, seen.stamp, moved_m))
        seconds = seen.stamp.since(good.stamp) / NS_PER_S
        how = "locked again" if is_new_lock else "the target moved"
        return self._event(
            seen,
            EventKind.PRISM_JUMP,
            f"{how} {moved_m:.2f} m away after {seconds:.2f} s: perhaps another prism; its fixes do not count until "
            f"the station is back, or until {CONFIRM}",
        )

    def _judge_suspected(
        self, suspicion: Suspicion, seen: _Seen, last: _Seen | None, is_new_lock: bool
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
            return self._event(seen, EventKind.LOCK_ACQUIRED, "the target is the earlier prism again; its fixes count")
        self.suspicions[-1] = replace(suspicion, distance_m=back_m)
        if not (is_new_lock or has_jumped):
            return None
        how = "locked again" if is_new_lock else "the target jumped again"
        text = f"{how} {back_m:.2f} m from the prism: perhaps another one; its fixes still do not count"
        return self._event(seen, EventKind.PRISM_JUMP, text)

    def _has_turned(self, last: _Seen, seen: _Seen) -> bool:
        """True if a fix may be of another target than the one before although no lock was lost."""
        has_paused = last.has_circles != seen.has_circles or seen.stamp.since(last.stamp) > PAUSE_NS
        return has_paused or self._has_jumped(last, seen)

    def _has_jumped(self, last: _Seen, seen: _Seen) -> bool:
        """True if a fix is further from the one before than motion can explain."""
        return last.has_circles == seen.has_circles and last.distance_m(seen) > self._reach_m(last, seen)

    def _reach_m(self, earlier: _Seen, later: _Seen) -> float:
        usual_ns = min(USUAL_NS, median_high(self._intervals_ns)) if len(self._intervals_ns) > 2 else USUAL_NS
        return self.limit.reach_m(max(usual_ns, later.stamp.since(earlier.stamp)))

    def _lasting(self) -> Suspicion | None:
        return self.suspicions[-1] if self.suspicions and self.suspicions[-1].until is None else None

    def _end_suspicion(self, at: Stamp) -> None:
        suspicion = self._lasting()
        if suspicion is not None:
            self.suspicions[-1] = replace(suspicion, until=at)

    def _event(self, seen: _Seen, kind: EventKind, text: str) -> DeviceEvent:
        return DeviceEvent(self.station, seen.stamp, kind, text)
