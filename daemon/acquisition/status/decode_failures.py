"""Share of captures that cannot be decoded, and the most frequent reason."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from dataclasses import dataclass
from functools import lru_cache

from daemon.acquisition.status.recent_counts import RecentCounts

KINDS_MAX = 50  # most kinds of reasons counted per device, so that noise cannot fill the memory
OTHER = "various reasons"

_PARTICULARS = re.compile(r"'[^']*'|\"[^\"]*\"|b'[^']*'|[0-9A-F]*\d[0-9A-Fa-f.]*")


@dataclass(frozen=True)
class DecodeStatus:
    """Failed decodes of one device.

    Attributes:
        device: channel, station or link.
        count: failed captures since the start.
        reason: the most frequent reason, as it was last given.
        reason_count: number of failures for this reason.
        lately: number of failures in the last 30 to 60 s.
        lately_share: their share of the device's captures in that time, 0 to 1.
    """

    device: str
    count: int
    reason: str
    reason_count: int
    lately: int
    lately_share: float


class FailureCounter:
    """Counts failures by device and kind of reason. For one thread, or under its owner's lock.

    Attributes:
        decoded: number of records lately decoded of each device; the caller adds to it.
    """

    def __init__(self) -> None:
        self._counts: dict[str, Counter[str]] = defaultdict(Counter)
        self._examples: dict[tuple[str, str], str] = {}
        self._failed, self.decoded = RecentCounts(), RecentCounts()

    def tell_time(self, now_ns: int) -> None:
        """Discard what is not recent any more."""
        self._failed.tell_time(now_ns)
        self.decoded.tell_time(now_ns)

    def add(self, device: str, reason: str) -> None:
        """Count a capture of a device that could not be decoded."""
        kinds = self._counts[device]
        kind = kind_of(reason)
        if kind not in kinds and len(kinds) >= KINDS_MAX:
            kind = reason = OTHER
        kinds[kind] += 1
        self._examples[device, kind] = reason
        self._failed.add(device)

    def totals(self) -> dict[str, int]:
        """Return device -> number of failures since the start."""
        return {device: kinds.total() for device, kinds in self._counts.items()}

    def status(self) -> list[DecodeStatus]:
        """Return the status of every device with failures."""
        return [self._status(device, kinds) for device, kinds in self._counts.items()]

    def _status(self, device: str, kinds: Counter[str]) -> DecodeStatus:
        ((kind, count),) = kinds.most_common(1)
        failed = self._failed[device]
        heard = failed + self.decoded[device]
        return DecodeStatus(
            device=device,
            count=kinds.total(),
            reason=self._examples[device, kind],
            reason_count=count,
            lately=failed,
            lately_share=failed / heard if heard else 0.0,
        )


@lru_cache(maxsize=1024)
def kind_of(reason: str) -> str:
    """Return a reason without the parts that differ between captures: numbers and quoted bytes."""
    return _PARTICULARS.sub("…", reason)
