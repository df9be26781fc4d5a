"""Detection of jumps: steps of a joint's position, between good samples, that no motion explains."""

from __future__ import annotations

from dataclasses import replace

from drivers.clock import NS_PER_S, Stamp
from drivers.readings import DeviceEvent, EventKind, Reading, Record, Status
from drivers.stall_detector import LATE_S

_MARGIN_NS = int(LATE_S * NS_PER_S)  # what samples may be read late by before they are marked
_BACKLOG_NS = 5 * NS_PER_S  # what has queued is read within this time, however long nobody read


class JumpWatch:
    """Compares each good sample of a joint with the good one before it, whatever bad ones lie in between.

    A sample that an alarm, an emergency or its own range voids is no position, but the one before it stays known: a
    device that comes back elsewhere after an alarm or a restart has lost its place.

    A stamp says when a sample was read. What arrives while nobody reads (a busy computer, a program that is stopped)
    waits, and is stamped when it is read at last. So a sample that ends a silence, and those after it until the backlog
    is surely read, may have been taken at any time since the silence began. They are told from others by their stamps
    alone: a log is judged as what came live. Bad samples are no silence: somebody read them. Samples of doubtful time
    are no good ones, and those of a backlog: it is read from the first of them on.

    Args:
        max_rate_per_s: fastest motion of the joint, in the unit of the positions given to `jumped_from`.
        slack: steps up to this are never a jump.
        modulus: where positions wrap; None where they do not.
    """

    def __init__(self, max_rate_per_s: float, slack: float, modulus: float | None = None) -> None:
        self._rate_per_ns = max_rate_per_s / NS_PER_S
        self._slack = slack
        self._modulus = modulus
        self._good: float | None = None
        self._good_from_ns = 0  # the earliest instant at which it may have been taken
        self._read_ns: int | None = None
        self._from_ns = self._late_until_ns = 0

    def bad(self, stamp: Stamp) -> None:
        """Take a sample that carries no usable position."""
        self._read(stamp.monotonic_ns)

    def jumped_from(self, stamp: Stamp, position: float) -> float | None:
        """Take a good sample; return the position before it if the joint cannot have moved so far since, else None."""
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
        """Note the earliest instant at which a sample that was read now may have been taken."""
        before_ns, self._read_ns = self._read_ns, now_ns
        if before_ns is None:  # what waited at a port is discarded when it is opened
            self._from_ns = self._late_until_ns = now_ns
            return
        silence_ns = now_ns - before_ns
        is_late = silence_ns > _MARGIN_NS
        if now_ns >= self._late_until_ns:
            self._from_ns = before_ns if is_late else now_ns
        if is_late:
            self._late_until_ns = max(self._late_until_ns, now_ns + min(silence_ns // 2, _BACKLOG_NS))


def joint_watch(max_rate_per_s: float | None, step: float, unit: str) -> JumpWatch | None:
    """Make the watch of a joint whose values are compared as they are; None where no fastest motion is known.

    Args:
        max_rate_per_s: fastest motion, units per second.
        step: the smallest change that its device can show.
        unit: degrees wrap at a full turn.
    """
    if max_rate_per_s is None:
        return None
    return JumpWatch(max_rate_per_s, 2 * abs(step), 360.0 if unit == "deg" else None)


def checked_reading(watch: JumpWatch, reading: Reading) -> list[Record]:
    """Return the reading; one that no motion explains loses its value and follows the event that says so."""
    if reading.value is None:
        watch.bad(reading.stamp)
        return [reading]
    before = watch.jumped_from(reading.stamp, reading.value)
    if before is None:
        return [reading]
    void = replace(reading, value=None, status=Status.OUT_OF_RANGE)
    return [jump_event(reading, before), void]


def jump_event(after: Reading, before: float) -> DeviceEvent:
    """Return the event of a reading whose position jumped there from another value."""
    text = (
        f"position jumped from {before:.4f} to {after.value:.4f} {after.unit}, more than the joint can move: "
        "a preset was written, or the encoder lost its place; check the joint's zero"
    )
    return DeviceEvent(after.channel, after.stamp, EventKind.PRESET_JUMP, text, after.raw_counts)
