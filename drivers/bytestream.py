"""A serial line's bytes as a stream: where a framer found what, and when each byte arrived."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from drivers.clock import NS_PER_S, Stamp


@dataclass(frozen=True, slots=True)
class Frame:
    """A complete frame whose checksum, if its protocol has one, is right.

    Attributes:
        data: what the frame carries, without checksum and terminator.
        start, end: offsets in the stream of its first and its last byte.
    """

    data: bytes
    start: int
    end: int


@dataclass(frozen=True, slots=True)
class Garbage:
    """Bytes that are no frame.

    Attributes:
        raw: the bytes.
        reason: what was expected and what was found.
        start, end: offsets in the stream of its first and its last byte.
    """

    raw: bytes
    reason: str
    start: int
    end: int


class Framer(Protocol):
    """Cuts a stream into frames. Holds a bounded number of bytes; never raises; loses no byte but line ends."""

    def feed(self, data: bytes) -> Sequence[Frame | Garbage]:
        """What these bytes complete, in order."""

    def flush(self, reason: str) -> Sequence[Garbage]:
        """Give up what has been collected of an unfinished frame."""

    @property
    def pending(self) -> int:
        """How many bytes of an unfinished frame have been collected."""


class ByteTimes:
    """When each of the last bytes of a stream arrived, on a line that sends a record's characters back to back.

    A read returns several bytes at once and is stamped when the last had arrived. Byte k of n arrived n - 1 - k
    characters earlier (10 bits each at 8N1 and 7E1), but not before the capture that came before it on the line.

    Args:
        character_s: how long one character takes, with start, parity and stop bits.
        keep: how many of the last bytes can be asked for, at least.
    """

    def __init__(self, character_s: float, keep: int = 1024) -> None:
        self._byte_ns = character_s * NS_PER_S
        self._keep = keep
        self._chunks: deque[tuple[int, int, Stamp, Stamp | None]] = deque()  # start, count, stamp, not before
        self._count = 0
        self._previous: Stamp | None = None

    def received(self, count: int, stamp: Stamp) -> None:
        """`count` more bytes; the last had arrived at `stamp`."""
        self._chunks.append((self._count, count, stamp, self._previous))
        self._count += count
        self._previous = stamp
        while len(self._chunks) > 1 and self._chunks[1][0] <= self._count - self._keep:
            self._chunks.popleft()

    def sent(self, stamp: Stamp) -> None:
        """Something was sent at `stamp`; what is received next arrives later."""
        self._previous = stamp

    def at(self, offset: int) -> Stamp:
        """When the byte at `offset` of the received stream arrived (the oldest kept, for one that is older)."""
        chunk = next((c for c in reversed(self._chunks) if c[0] <= offset), self._chunks[0])
        start, count, stamp, not_before = chunk
        shift = -round((count - 1 - max(0, offset - start)) * self._byte_ns)
        if not_before is not None and not_before.boot_id == stamp.boot_id:
            shift = max(shift, min(0, not_before.monotonic_ns - stamp.monotonic_ns))
        return stamp.shifted(shift)
