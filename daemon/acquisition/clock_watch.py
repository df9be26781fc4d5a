"""Detection of steps of the computer's clock, by comparing UTC with the monotonic clock, which cannot be set."""

from __future__ import annotations

from drivers.clock import NS_PER_S, Stamp
from drivers.readings import DeviceEvent, EventKind

CLOCK = "clock"  # device name of its events
TOLERANCE_NS = NS_PER_S // 20
"""Smaller changes are not taken for a step. Time services never step by less (ntpd by at least 128 ms), and slewing
changes both clocks alike. Successive reads of the two clocks lie so far apart only when a busy computer delays one of
them, and hardly ever twice by the same time."""


class ClockWatch:
    """Compares UTC with the monotonic clock at every check; a step is reported once two checks agree on it.

    Args:
        previous: an instant of an earlier run of the daemon; a step since then is reported if it was in the same boot.
    """

    def __init__(self, previous: Stamp | None = None) -> None:
        self._last = previous
        self._is_earlier_run = previous is not None
        self._doubted: Stamp | None = None

    def look(self, now: Stamp) -> DeviceEvent | None:
        """Return the event of a step that has happened, if any; to be called several times a second."""
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
    """Return by how much more UTC has advanced than the monotonic clock."""
    return (now.utc_ns - before.utc_ns) - (now.monotonic_ns - before.monotonic_ns)


def _event(step_ns: int, stamp: Stamp, *, is_earlier_run: bool) -> DeviceEvent:
    step_s = step_ns / NS_PER_S
    text = f"the computer's clock was set {'forward' if step_s > 0 else 'back'} by {abs(step_s):.1f} s"
    if is_earlier_run:
        text += " while rigcal was not running"
    if step_s > 0:
        text += ", or the computer was suspended for that time"
    return DeviceEvent(CLOCK, stamp, EventKind.CLOCK_STEP, text, step_ns // 1_000_000)
