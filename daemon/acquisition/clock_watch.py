"""Notices that the computer's clock was set: UTC against the monotonic clock, which nobody can set."""

from __future__ import annotations

from drivers.clock import NS_PER_S, Stamp
from drivers.readings import DeviceEvent, EventKind

CLOCK = "clock"  # the device of its events
TOLERANCE_NS = NS_PER_S // 20
"""Smaller changes are no step. Time services never step by less (ntpd by 128 ms at least), and what they slew changes
both clocks alike; two reads of the clocks, one after the other, lie so far apart only where a busy computer comes in
between, and hardly twice by the same time."""


class ClockWatch:
    """Compares UTC with the monotonic clock at every look; a step is told once two looks agree on it.

    Args:
        previous: an instant of an earlier run of the daemon; a step since then is told if it was in the same boot.
    """

    def __init__(self, previous: Stamp | None = None) -> None:
        self._last = previous
        self._is_earlier_run = previous is not None
        self._doubted: Stamp | None = None

    def look(self, now: Stamp) -> DeviceEvent | None:
        """The step that has happened, if any; to be asked several times a second."""
        last, doubted = self._last, self._doubted
        if last is None or last.boot_id != now.boot_id:
            self._last, self._doubted, self._is_earlier_run = now, None, False
            return None
        if abs(_ahead_ns(now, last)) <= TOLERANCE_NS:
            self._last, self._doubted, self._is_earlier_run = now, None, False
            return None
        if doubted is None or abs(_ahead_ns(now, doubted)) > TOLERANCE_NS:
            self._doubted = now
            return None
        event = _event(_ahead_ns(now, last), doubted, is_earlier_run=self._is_earlier_run)
        self._last, self._doubted, self._is_earlier_run = now, None, False
        return event


def _ahead_ns(now: Stamp, before: Stamp) -> int:
    """By how much more UTC has gone on than the monotonic clock."""
    return (now.utc_ns - before.utc_ns) - (now.monotonic_ns - before.monotonic_ns)


def _event(step_ns: int, stamp: Stamp, *, is_earlier_run: bool) -> DeviceEvent:
    step_s = step_ns / NS_PER_S
    text = f"the computer's clock was set {'forward' if step_s > 0 else 'back'} by {abs(step_s):.1f} s"
    if is_earlier_run:
        text += " while rigcal did not run"
    if step_s > 0:
        text += ", or the computer was suspended for so long"
    return DeviceEvent(CLOCK, stamp, EventKind.CLOCK_STEP, text, step_ns // 1_000_000)
