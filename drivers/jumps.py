"""Detection of jumps: steps of a joint's position between good samples that are too large to be motion."""

from __future__ import annotations

from dataclasses import replace

from drivers.clock import NS_PER_S, Stamp
from drivers.readings import DeviceEvent, EventKind, Reading, Record, Status
from drivers.stall_detector import LATE_S

_MARGIN_NS = int(LATE_S * NS_PER_S)  # samples may be read this late without being marked as doubtful
_BACKLOG_NS = 5 * NS_PER_S  # a backlog is read within this time, however long reading was interrupted


class JumpWatch:
    """Compares each good sample of a joint with the previous good one, regardless of bad samples in between.

    A sample that is invalid because of an alarm, an emergency or its own range is not a position, but the position
    before it is kept: a device that comes back at a different position after an alarm or a restart has lost its
    reference.

    A stamp is the time at which a sample was read. Samples that arrive while nobody reads (because the computer is busy
    or the program is stopped) wait, and are stamped when they are finally read. A sample that ends a silence, and the
    samples after it until the backlog is certainly read, may therefore have been taken at any time since the silence
    began. They are recognized by their stamps alone, so that a log is judged like live data. Bad samples do not count
    as silence, because they show that the port was read. Samples of doubtful time are not good samples but mark a
    backlog, which is read from the first of them on.

    Args:
        max_rate_per_s: fastest motion of the joint, in the unit of the positions passed to `jumped_from`.
        slack: largest step that is never a jump.
        modulus: value at which positions wrap; None if they do not.
    """

    def __init__(self, max_rate_per_s: float, slack: float, modulus: float | None = None) -> None:
        self._rate_per_ns = max_rate_per_s / NS_PER_S
        self._slack = slack
        self._modulus = modulus
        self._good: float | None = None
        self._good_from_ns = 0  # earliest instant at which `_good` may have been taken
        self._read_ns: int | None = None
        self._from_ns = self._late_until_ns = 0

    def bad(self, stamp: Stamp) -> None:
        """Process a sample without a usable position."""
        self._read(stamp.monotonic_ns)

    def jumped_from(self, stamp: Stamp, position: float) -> float | None:
        """Process a good sample; return the previous position if the joint cannot have moved that far, else None."""
        now_ns = stamp.monotonic_ns
        self._read(now_ns)
        if stamp.is_doubtful:
            return None
        before, before_from_ns = self._good, self._good_from_ns
        self._good, self._good_from_ns = position, self._from_ns
        if before is None:
            return None
        moved = position - before
        if self._modulus is not None:
            half = self._modulus / 2
            moved = (moved + half) % self._modulus - half
        within_ns = max(now_ns - before_from_ns, 0) + _MARGIN_NS
        return before if abs(moved) > self._rate_per_ns * within_ns + self._slack else None

    def _read(self, now_ns: int) -> None:
        """Update the earliest instant at which a sample read at `now_ns` may have been taken."""
        before_ns, self._read_ns = self._read_ns, now_ns
        if before_ns is None:  # no backlog: opening a port discards waiting data
            self._from_ns = self._late_until_ns = now_ns
            return
        silence_ns = now_ns - before_ns
        is_late = silence_ns > _MARGIN_NS
        if now_ns >= self._late_until_ns:
            self._from_ns = before_ns if is_late else now_ns
        if is_late:
            self._late_until_ns = max(self._late_until_ns, now_ns + min(silence_ns // 2, _BACKLOG_NS))


def joint_watch(max_rate_per_s: float | None, step: float, unit: str) -> JumpWatch | None:
    """Return the watch for a joint whose values are compared directly; None if its fastest motion is unknown.

    Args:
        max_rate_per_s: fastest motion in `unit` per second, or None.
        step: resolution of its device, in `unit`.
        unit: unit of the values; "deg" wraps at a full turn.
    """
    if max_rate_per_s is None:
        return None
    return JumpWatch(max_rate_per_s, 2 * abs(step), 360.0 if unit == "deg" else None)


def checked_reading(watch: JumpWatch, reading: Reading) -> list[Record]:
    """Return the reading; if it is a jump, return the event that reports the jump and the reading without a value."""
    if reading.value is None:
        watch.bad(reading.stamp)
        return [reading]
    before = watch.jumped_from(reading.stamp, reading.value)
    if before is None:
        return [reading]
    void = replace(reading, value=None, status=Status.OUT_OF_RANGE)
    return [jump_event(reading, before), void]


def jump_event(after: Reading, before: float) -> DeviceEvent:
    """Return the event that reports a jump from the value `before` to the reading `after`."""
    text = (
        f"position jumped from {before:.4f} to {after.value:.4f} {after.unit}, farther than the joint can move: "
        "a preset was written, or the encoder lost its position; check the joint's zero"
    )
    return DeviceEvent(after.channel, after.stamp, EventKind.PRESET_JUMP, text, after.raw_counts)
