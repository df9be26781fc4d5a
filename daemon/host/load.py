"""How busy the computer is: what looks like a cable's fault may be a processor that does not get round to things."""

from __future__ import annotations

import os

_BUSY = 1.5  # processes that want to run, for each processor, over the last minute


def overload() -> str | None:
    """Return a clause on a computer that has more to run than its processors can; None where they can."""
    processors = len(os.sched_getaffinity(0))
    wanting = os.getloadavg()[0]
    if wanting <= _BUSY * processors:
        return None
    return f"{wanting:.0f} processes want to run on {processors} processor{'s' if processors != 1 else ''}"
