"""Share of the captures that cannot be decoded, and the commonest reason."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from dataclasses import dataclass
from functools import lru_cache

from drivers.clock import NS_PER_S

WINDOW_NS = 30 * NS_PER_S  # "lately" is the last one to two of these
KINDS_MAX = 50  # kinds of reasons that are told apart of one device; noise must fill no memory
OTHER = "various reasons"

_PARTICULARS = re.compile(r"'[^']*'|\"[^\"]*\"|b'[^']*'|[0-9A-F]*\d[0-9A-Fa-f.]*")


@dataclass(frozen=True)
class DecodeStatus:
    """Failed decodes of one device.

    Attributes:
        device: channel, station or link.
        count: captures since the start.
        reason: the commonest one, as it was given last.
        reason_count: how many of them it is.
        lately: how many in the last 30 to 60 s.
        lately_share: of what the device sent in that time, 0 to 1.
    """

    device: str
    count: int
    reason: str
    reason_count: int
    lately: int
    lately_share: float


class FailureCounter:
    """Counts failures by device and kind of reason. Belongs to one thread, or to whoever holds its owner's lock."""

    def __init__(self) -> None:
        self._counts: dict[str, Counter[str]] = defaultdict(Counter)
        self._examples: dict[tuple[str, str], str] = {}
        self._failed = Counter[str](), Counter[str]()  # in the window before, and in this one
        self._decoded = Counter[str](), Counter[str]()
        self._window_ns = 0

    def tell_time(self, now_ns: int) -> None:
        """Forget what is not of late any more."""
        if now_ns - self._window_ns < WINDOW_NS:
            return
        is_next = now_ns - self._window_ns < 2 * WINDOW_NS
        self._failed = (self._failed[1] if is_next else Counter(), Counter())
        self._decoded = (self._decoded[1] if is_next else Counter(), Counter())
        self._window_ns = now_ns

    @property
    def decoded(self) -> Counter[str]:
        """Device -> what was decoded of it in this window; to be added to."""
        return self._decoded[1]

    def add(self, device: str, reason: str) -> None:
        """A capture of a device could not be decoded."""
        kinds = self._counts[device]
        kind = kind_of(reason)
        if kind not in kinds and len(kinds) >= KINDS_MAX:
            kind = reason = OTHER
        kinds[kind] += 1
        self._examples[device, kind] = reason
        self._failed[1][device] += 1

    def totals(self) -> dict[str, int]:
        """Device -> failures since the start."""
        return {device: kinds.total() for device, kinds in self._counts.items()}

    def status(self) -> list[DecodeStatus]:
        """Every device of which something could not be decoded."""
        return [self._status(device, kinds) for device, kinds in self._counts.items()]

    def _status(self, device: str, kinds: Counter[str]) -> DecodeStatus:
        ((kind, count),) = kinds.most_common(1)
        failed = sum(window[device] for window in self._failed)
        heard = failed + sum(window[device] for window in self._decoded)
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
    """A reason without what differs from one capture to the next: numbers and quoted bytes."""
    return _PARTICULARS.sub("…", reason)
