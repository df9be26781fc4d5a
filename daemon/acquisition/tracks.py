"""Joints and signals over the last seconds, and the motion of the boom.

Motion is distinguished from noise by a reference that follows a resting joint slowly. A joint moves when it is further
than `motion_threshold` from its reference, which is then set to the joint's value. A joint that creeps more slowly than
the threshold per `REST_NS` therefore counts as standing.

Before a joint's first sample, and between good samples too far apart, it may have moved and returned unseen. After that
its last direction, and the time since the last motion of the boom, are unknown until the next motion.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from typing import Generic, TypeVar

from drivers.clock import NS_PER_S
from drivers.readings import Reading, Status

T = TypeVar("T")

HISTORY_NS = 30 * NS_PER_S  # how long samples are kept for late fixes
RATE_WINDOW_NS = NS_PER_S // 10  # on either side of the instant
STILL_AFTER_NS = NS_PER_S // 2  # a fix this long before motion shows may have been measured during the motion
REST_NS = NS_PER_S // 2  # time constant with which a reference follows a resting joint
MOTION_STEP_NS = NS_PER_S // 100  # resolution with which motion is noted
MAX_GAP_S = 0.25  # largest distance of the samples around a fix
STANDING_GAP_NS = NS_PER_S  # the same for two samples that show no motion
TURN_DEG = 360.0


@dataclass(frozen=True)
class JointInput:
    """A joint to be joined with fixes.

    Attributes:
        name: name of its channel.
        unit: `deg` or `mm`; degrees are interpolated the shorter way round.
        motion_threshold: a change of at least this is motion, not noise, deg or mm.
        max_gap_s: largest distance of the samples around a fix; STANDING_GAP_NS if they show no motion.
    """

    name: str
    unit: str
    motion_threshold: float
    max_gap_s: float = MAX_GAP_S


@dataclass(frozen=True)
class SignalInput:
    """A signal to be joined with fixes.

    Attributes:
        name: name of its channel.
        column: its column in an observations CSV (`boom_valve_mA`).
        max_age_s: an older value is not used.
    """

    name: str
    column: str
    max_age_s: float


@dataclass(frozen=True, slots=True)
class State:
    """A joint at one instant: value (deg or mm), last direction of motion (-1, 1), rate (per second); None: unknown."""

    value: float
    direction: int | None
    rate: float | None


class History(Generic[T]):
    """Recent history of a quantity: increasing instants, and the item at each."""

    def __init__(self) -> None:
        self.times_ns: list[int] = []
        self.items: list[T] = []

    def add(self, at_ns: int, item: T) -> None:
        """Append an item, and discard old items except one, which gives the value until the next."""
        times_ns = self.times_ns
        times_ns.append(at_ns)
        self.items.append(item)
        if at_ns - times_ns[0] > 2 * HISTORY_NS:  # seldom, because deleting from the front of a list moves the rest
            old = max(bisect_left(times_ns, at_ns - HISTORY_NS) - 1, 0)
            del times_ns[:old], self.items[:old]

    def insert(self, index: int, at_ns: int, item: T) -> None:
        """Insert an item that has arrived late at its place in the order of time."""
        self.times_ns.insert(index, at_ns)
        self.items.insert(index, item)

    def newer(self, at_ns: int) -> bool:
        """Return True if `at_ns` is later than all items."""
        return not self.times_ns or at_ns > self.times_ns[-1]

    def latest(self, at_ns: int) -> int:
        """Return the index of the last item at or before `at_ns`; -1 if there is none."""
        return bisect_right(self.times_ns, at_ns) - 1

    def clear(self) -> None:
        self.times_ns.clear()
        self.items.clear()


class Motion:
    """Motions of the boom, and the number of each standstill between them."""

    def __init__(self, settle_ns: int) -> None:
        self._settle_ns = settle_ns
        self._ended = 0  # number of standstills that have ended
        self._moves: History[int] = History()  # this number at each motion
        self._unseen: History[None] = History()  # ends of times in which joints may have moved unseen

    def note(self, at_ns: int) -> None:
        """Note a motion of any joint, or that a joint is first read."""
        if self._moves.times_ns:
            quiet_ns = at_ns - self._moves.times_ns[-1]
            if quiet_ns < 0:
                self._note_late(at_ns)
                return
            if quiet_ns < MOTION_STEP_NS:
                return
            self._ended += quiet_ns >= self._settle_ns
        self._moves.add(at_ns, self._ended)

    def _note_late(self, at_ns: int) -> None:
        """Note a motion before the newest one, of a joint whose link is read later than those of others."""
        times_ns, ended = self._moves.times_ns, self._moves.items
        after = self._moves.latest(at_ns) + 1
        since_ns = at_ns - times_ns[after - 1] if after else MOTION_STEP_NS
        if since_ns < MOTION_STEP_NS or times_ns[after] - at_ns < MOTION_STEP_NS:
            return
        number = ended[after - 1] + (since_ns >= self._settle_ns) if after else ended[0]
        if times_ns[after] - at_ns >= self._settle_ns and ended[after] == number:  # it divides a standstill into two
            ended[after:] = [later + 1 for later in ended[after:]]
            self._ended += 1
        self._moves.insert(after, at_ns, number)

    def note_unseen(self, at_ns: int) -> None:
        """Note that a joint may have moved unseen until then, even if it is where it was."""
        if self._unseen.newer(at_ns):
            self._unseen.add(at_ns, None)
        else:
            self._unseen.insert(self._unseen.latest(at_ns) + 1, at_ns, None)

    def restart(self) -> None:
        """Begin a new standstill, because joints may have moved unnoticed."""
        self._ended += bool(self._moves.times_ns)
        self._moves.clear()
        self._unseen.clear()

    def stands_s(self, at_ns: int) -> float | None:
        """Return the time since a motion was last seen, or since the joints' first readings; None before these."""
        last = self._moves.latest(at_ns)
        return None if last < 0 else (at_ns - self._moves.times_ns[last]) / NS_PER_S

    def at(self, at_ns: int) -> tuple[float | None, int | None]:
        """Return the dwell in seconds and the number of the standstill, as in JoinedFix."""
        last = self._moves.latest(at_ns)
        if last < 0:
            return None, None
        times_ns = self._moves.times_ns
        dwell_ns = at_ns - times_ns[last]
        leaving = last + 1 < len(times_ns) and times_ns[last + 1] - at_ns < STILL_AFTER_NS
        standing = dwell_ns >= self._settle_ns and not leaving
        unseen = self._unseen.latest(at_ns)
        seen = unseen < 0 or self._unseen.times_ns[unseen] < times_ns[last]
        return dwell_ns / NS_PER_S if seen else None, self._moves.items[last] + 1 if standing else None


class JointTrack:
    """Recent samples of one joint, and how it moves.

    Args:
        joint: the joint.
        motion: told when the joint moves, and when it may have moved unseen.
    """

    def __init__(self, joint: JointInput, motion: Motion) -> None:
        self.name, self.unit = joint.name, joint.unit
        self._joint, self._motion = joint, motion
        self._max_gap_ns = round(joint.max_gap_s * NS_PER_S)
        self._standing_gap_ns = max(STANDING_GAP_NS, self._max_gap_ns)
        self._samples: History[tuple[float | Status, int | None]] = History()  # value or bad status, last direction
        self._jumps: History[None] = History()
        self._reference: float | None = None
        self._good_ns = 0  # of the last good sample, once there is a reference
        self._direction: int | None = None

    @property
    def newest_ns(self) -> int:
        """Instant of the last sample; far in the past if there is none."""
        return self._samples.times_ns[-1] if self._samples.times_ns else -(2**63)

    def add(self, at_ns: int, reading: Reading) -> None:
        """Add a sample; one that is older than the last is left out."""
        if not self._samples.newer(at_ns):
            return
        value = reading.value
        if reading.status is not Status.OK or value is None or not math.isfinite(value):
            bad = Status.MALFORMED if reading.status is Status.OK else reading.status
            self._samples.add(at_ns, (bad, self._direction))
            return
        since_ns = at_ns - self._good_ns
        change = 0.0 if self._reference is None else self._difference(value, self._reference)
        is_seen = self._reference is not None and since_ns <= self._standing_gap_ns
        if not is_seen:
            self._direction = None
            self._motion.note_unseen(at_ns)
        if self._reference is None or abs(change) >= self._joint.motion_threshold:
            self._reference = value
            self._motion.note(at_ns)
            if is_seen:
                self._direction = 1 if change > 0 else -1
        else:
            self._reference += change * min(1.0, since_ns / REST_NS)
        self._good_ns = at_ns
        self._samples.add(at_ns, (value, self._direction))

    def jumped(self, at_ns: int) -> None:
        """Note a preset of the encoder: values before and after it cannot be compared."""
        if self._jumps.newer(at_ns):
            self._jumps.add(at_ns, None)
        self._reference = None

    def clear(self) -> None:
        self._samples.clear()
        self._jumps.clear()
        self._reference = None

    def at(self, at_ns: int, of: str = "the fix") -> State | str:
        """Return the joint's state at an instant, or why it is not known.

        Args:
            at_ns: the instant, monotonic.
            of: name of the instant for the reason.
        """
        times_ns, items = self._samples.times_ns, self._samples.items
        before = self._samples.latest(at_ns)
        if before < 0:
            return f"no sample before {of}"
        after = before if times_ns[before] == at_ns else before + 1
        if after == len(times_ns):
            return f"no sample after {of}"
        start, direction = items[before]
        end, _ = items[after]
        if isinstance(start, Status) or isinstance(end, Status):
            return f"its reading at {of} is {start if isinstance(start, Status) else end}"
        span_ns = times_ns[after] - times_ns[before]
        stood = abs(self._difference(end, start)) <= self._joint.motion_threshold
        if span_ns > (self._standing_gap_ns if stood else self._max_gap_ns):
            return f"its samples around {of} are more than {self._joint.max_gap_s:g} s apart"
        if self._jumps.latest(times_ns[after]) != self._jumps.latest(times_ns[before]):
            return f"its encoder was preset at {of}"
        fraction = (at_ns - times_ns[before]) / span_ns if span_ns else 0.0
        value = start + fraction * self._difference(end, start)
        if self.unit == "deg" and fraction >= 0.5:
            value += TURN_DEG * round((end - value) / TURN_DEG)  # beyond a wrap: use the turn of the nearer sample
        return State(value, direction, self._rate(at_ns))

    def _rate(self, at_ns: int) -> float | None:
        """Return the least-squares slope of the samples around an instant, per second; None for a single sample."""
        times_ns, items = self._samples.times_ns, self._samples.items
        # Includes the next samples beyond the window: two samples close together would give a poor slope.
        first = max(bisect_right(times_ns, at_ns - RATE_WINDOW_NS) - 1, 0)
        last = bisect_left(times_ns, at_ns + RATE_WINDOW_NS) + 1
        jump = self._jumps.latest(at_ns)
        points = [
            (times_ns[i] - at_ns, value)
            for i in range(first, min(last, len(times_ns)))
            if not isinstance(value := items[i][0], Status)
            and self._jumps.latest(times_ns[i]) == jump
            and abs(times_ns[i] - at_ns) <= STANDING_GAP_NS
        ]
        if len(points) < 2:
            return None
        origin = points[0][1]
        offsets = [self._difference(value, origin) for _, value in points]
        mean_ns = sum(t for t, _ in points) / len(points)
        mean = sum(offsets) / len(points)
        spread = sum((t - mean_ns) ** 2 for t, _ in points)
        slope = sum((t - mean_ns) * (o - mean) for (t, _), o in zip(points, offsets, strict=True)) / spread
        return slope * NS_PER_S

    def _difference(self, to: float, since: float) -> float:
        """Return the change from `since` to `to`; for an angle, the shorter way round."""
        change = to - since
        if self.unit == "deg" and not -TURN_DEG / 2 <= change < TURN_DEG / 2:
            change = (change + TURN_DEG / 2) % TURN_DEG - TURN_DEG / 2
        return change


class SignalTrack:
    """Recent values of one signal."""

    def __init__(self, signal: SignalInput) -> None:
        self.column = signal.column
        self._max_age_ns = round(signal.max_age_s * NS_PER_S)
        self._values: History[float | None] = History()

    def add(self, at_ns: int, value: float | None) -> None:
        """Add a value; None if the reading has no value."""
        if self._values.newer(at_ns):
            self._values.add(at_ns, value)

    def clear(self) -> None:
        self._values.clear()

    def at(self, at_ns: int) -> float | None:
        """Return the value at an instant; None if it is bad, too old or missing."""
        last = self._values.latest(at_ns)
        if last < 0 or at_ns - self._values.times_ns[last] > self._max_age_ns:
            return None
        return self._values.items[last]
