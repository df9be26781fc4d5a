"""UTC without the steps of a computer's clock: within a boot, time passes as the monotonic clock says."""

from __future__ import annotations

from dataclasses import replace

from drivers.clock import Stamp


class SteadyTime:
    """Puts instants on one axis: UTC as it was at the first instant of each boot, and no boot before the one before."""

    def __init__(self) -> None:
        self._offsets_ns: dict[str, int] = {}
        self._latest_ns = -(2**63)

    def of(self, stamp: Stamp) -> Stamp:
        """The same instant, with steady UTC in place of that of the computer."""
        if stamp.boot_id not in self._offsets_ns:
            self._offsets_ns[stamp.boot_id] = max(stamp.utc_ns, self._latest_ns) - stamp.monotonic_ns
        utc_ns = stamp.monotonic_ns + self._offsets_ns[stamp.boot_id]
        self._latest_ns = max(self._latest_ns, utc_ns)
        return replace(stamp, utc_ns=utc_ns)
