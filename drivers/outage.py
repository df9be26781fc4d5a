"""Loss of a link: pauses between attempts to reopen it, and the records of the outage."""

from __future__ import annotations

from collections.abc import Callable

from drivers.clock import Stamp
from drivers.readings import DeviceEvent, EventKind, Gap, GapReason, LinkItem

BACKOFF_FIRST_S = 0.5
BACKOFF_MAX_S = 0.7  # an slcan adapter that takes 1.2 s to open is read within 2 s, even if nothing signals its return


class Backoff:
    """Pauses between attempts: doubling from BACKOFF_FIRST_S up to BACKOFF_MAX_S, without random variation."""

    def __init__(self) -> None:
        self._next_s = BACKOFF_FIRST_S

    def next_s(self) -> float:
        """Return the pause before the next attempt in seconds."""
        wait_s, self._next_s = self._next_s, min(2 * self._next_s, BACKOFF_MAX_S)
        return wait_s

    def reset(self) -> None:
        """Start again with the shortest pause."""
        self._next_s = BACKOFF_FIRST_S


class Outage:
    """Reports once that a link is lost, again when the reason changes, and once that it is back.

    Args:
        link: name of the link.
        emit: called with each event and gap.
    """

    def __init__(self, link: str, emit: Callable[[LinkItem], None]) -> None:
        self._link = link
        self._emit = emit
        self._since: Stamp | None = None
        self._reason = ""

    def begin(self, reason: str, now: Stamp, since: Stamp) -> None:
        """Report that the link is down.

        Args:
            reason: the reason, for an operator.
            now: when the loss was noticed.
            since: start of the gap; ignored if the link was already down.
        """
        if self._since is None:
            self._since = since
            self._emit(Gap(self._link, GapReason.LINK_DOWN, since))
        if reason != self._reason:  # once per cause, not once per attempt
            self._emit(DeviceEvent(self._link, now, EventKind.LINK_LOST, reason))
            self._reason = reason

    def end(self, now: Stamp, text: str) -> None:
        """Report with `text` that the link is up, and close the gap."""
        self._emit(DeviceEvent(self._link, now, EventKind.LINK_UP, text))
        if self._since is not None:
            self._emit(Gap(self._link, GapReason.LINK_DOWN, self._since, now))
        self._since, self._reason = None, ""
