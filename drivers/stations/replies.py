"""Replies of a total station: captured bytes, split into frames, timed and parsed.

`ReplyReader` decodes a station's bytes with a framer and a parser of the station's protocol. The link and the decoder
have one reader each: the link must know at once what to send next, while records are decoded only after the bytes are
stored, and can be decoded from them again at any time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import Protocol

from drivers.clock import NS_PER_S, Stamp
from drivers.readings import DecodeFailure, DeviceEvent, EventKind, Fix, SerialCapture
from drivers.stations.survey import RecordError

ACK = b"\x06"
NAK = b"\x15"


@dataclass(frozen=True, slots=True)
class Frame:
    """A complete frame whose checksum, if its protocol has one, is correct.

    Attributes:
        data: content of the frame, without checksum and terminator.
        start: offset of its first byte in the stream.
        end: offset of its last byte in the stream.
    """

    data: bytes
    start: int
    end: int


@dataclass(frozen=True, slots=True)
class Garbage:
    """Bytes that are not a frame.

    Attributes:
        raw: the bytes.
        reason: what was expected and what was found.
        start: offset of the first byte in the stream.
        end: offset of the last byte in the stream.
    """

    raw: bytes
    reason: str
    start: int
    end: int


class Framer:
    """Base of the framers, which split a stream into frames.

    A framer holds a limited number of bytes, never raises, and drops no bytes except line ends.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._start = 0  # offset of the buffer's first byte in the stream

    @property
    def pending(self) -> int:
        """Number of bytes of an unfinished frame."""
        return len(self._buffer)

    def feed(self, data: bytes) -> Sequence[Frame | Garbage]:
        """Return the frames and the garbage that `data` completes, in order."""
        raise NotImplementedError

    def flush(self, reason: str) -> Sequence[Garbage]:
        """Discard an unfinished frame and return it as garbage."""
        return [self._give_up(len(self._buffer), reason)] if self._buffer else []

    def _give_up(self, count: int, reason: str) -> Garbage:
        """Remove the first `count` bytes and return them as garbage."""
        garbage = Garbage(bytes(self._buffer[:count]), reason, self._start, self._start + count - 1)
        self._drop(count)
        return garbage

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._start += count


class ReplyKind(Enum):
    """Meaning of a reply to the poller."""

    ACK = auto()
    NAK = auto()
    RECORD = auto()
    RECORD_OFF_TARGET = auto()  # from a tracking station that is not locked on a prism
    UNUSABLE = auto()  # long enough for an answer, but not a valid record
    NOISE = auto()  # too short for an answer


@dataclass(frozen=True, slots=True)
class Reply:
    """A decoded reply.

    Attributes:
        kind: meaning of the reply for the poller.
        records: the decoded records, for all other users.
    """

    kind: ReplyKind
    records: tuple[Fix | DeviceEvent | DecodeFailure, ...] = ()


class Parser(Protocol):
    """Parses the frames of one station. Its only state is which errors and warnings it has reported."""

    def parse(self, data: bytes, first_byte: Stamp, last_byte: Stamp) -> Reply:
        """Parse the data of one frame that is neither ACK nor NAK.

        Args:
            data: data of the frame, without checksum and terminator.
            first_byte: when its first byte arrived.
            last_byte: when its last byte arrived.

        Raises:
            RecordError: the data is not a known record.
        """


def instrument_error(station: str, stamp: Stamp, text: str, code: int | None = None) -> DeviceEvent:
    """Return the event for an error that the instrument reports."""
    return DeviceEvent(station, stamp, EventKind.INSTRUMENT_ERROR, text, code)


class ByteTimes:
    """Arrival times of the last bytes of a stream, on a line that sends a record's characters without pauses.

    A read returns several bytes at once and is stamped when the last one had arrived. Byte k of n arrived n - 1 - k
    characters earlier (10 bits each at 8N1 and 7E1), but not before the previous capture on the line.

    Args:
        character_s: duration of one character in seconds, including start, parity and stop bits.
        keep: minimum number of last bytes whose times are kept.
    """

    def __init__(self, character_s: float, keep: int = 1024) -> None:
        self._byte_ns = character_s * NS_PER_S
        self._keep = keep
        self._chunks: deque[tuple[int, int, Stamp, Stamp | None]] = deque()  # start, count, stamp, not before
        self._count = 0
        self._previous: Stamp | None = None

    def received(self, count: int, stamp: Stamp) -> None:
        """Record the arrival of `count` more bytes, the last of them at `stamp`."""
        self._chunks.append((self._count, count, stamp, self._previous))
        self._count += count
        self._previous = stamp
        while len(self._chunks) > 1 and self._chunks[1][0] <= self._count - self._keep:
            self._chunks.popleft()

    def sent(self, stamp: Stamp) -> None:
        """Record that bytes were sent at `stamp`; bytes received next cannot have arrived before."""
        self._previous = stamp

    def at(self, offset: int) -> Stamp:
        """Return when the byte at `offset` in the received stream arrived (for older bytes, the oldest time kept)."""
        chunk = next((c for c in reversed(self._chunks) if c[0] <= offset), self._chunks[0])
        start, count, stamp, not_before = chunk
        shift = -round((count - 1 - max(0, offset - start)) * self._byte_ns)
        if not_before is not None and not_before.boot_id == stamp.boot_id:
            shift = max(shift, min(0, not_before.monotonic_ns - stamp.monotonic_ns))
        return stamp.shifted(shift)


class ReplyReader:
    """Decodes the captures of one station into replies.

    Args:
        station: name of the station.
        framer: a new framer.
        parser: a new parser.
        shortest_record: length in bytes; garbage of at least this length counts as a damaged answer.
        character_s: duration of one character on the line in seconds.
    """

    def __init__(self, station: str, framer: Framer, parser: Parser, shortest_record: int, character_s: float) -> None:
        self._station = station
        self._framer = framer
        self._parser = parser
        self._shortest_record = shortest_record
        self._times = ByteTimes(character_s)

    def feed(self, capture: SerialCapture) -> list[Reply]:
        """Return the replies that a capture completes, in order."""
        if capture.is_transmitted:
            self._times.sent(capture.stamp)
            return []
        self._times.received(len(capture.data), capture.stamp)
        return [self._reply(item) for item in self._framer.feed(capture.data)]

    def flush(self, reason: str) -> list[Reply]:
        """Discard an incomplete reply; `reason` goes into its DecodeFailure."""
        return [self._reply(garbage) for garbage in self._framer.flush(reason)]

    def _reply(self, item: Frame | Garbage) -> Reply:
        first = self._times.at(item.start)
        if isinstance(item, Garbage):
            kind = ReplyKind.UNUSABLE if len(item.raw) >= self._shortest_record else ReplyKind.NOISE
            return Reply(kind, (DecodeFailure(self._station, first, item.reason, item.raw),))
        if item.data == ACK:
            return Reply(ReplyKind.ACK)
        if item.data == NAK:
            return Reply(ReplyKind.NAK, (instrument_error(self._station, first, "station refused a command (NAK)"),))
        try:
            return self._parser.parse(item.data, first, self._times.at(item.end))
        except RecordError as error:
            return Reply(ReplyKind.UNUSABLE, (DecodeFailure(self._station, first, str(error), item.data),))
