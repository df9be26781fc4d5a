"""The body of a large chunk: redundancy between neighbouring captures is removed before compression.

A *stream* is the set of captures with one identifier, one set of flags and one length: one kind of message. The body
is, little endian, each column of integers byte plane by byte plane:

    streams: count u32, identifier u32 each, flags u8 each, length u32 each (serial: 0, any length)
    order: code u32 per capture: 0 for the stream that last followed the previous capture's stream, otherwise 1 + number
        of the stream
    times, stream by stream: u64, zigzag of the difference of monotonic_ns from the previous capture, minus the usual
        difference of the stream (u64 zigzag per stream, stored before them)
    clock: u64 per capture, zigzag of the change of utc_ns - monotonic_ns since the previous capture
    serial only: length u32 per capture
    data, stream by stream: form u8 per stream, then its bytes in that form

Each stream has its data in the form of least entropy: 0, the bytes of each position; 1, their changes; 2 and 4, the
changes of little-endian words of 2 or 4 bytes, zigzag, and the changes of remaining bytes. Serial data are stored as
bytes, one capture after the other.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

_COUNT = struct.Struct("<I")
_WORDS = (2, 4)
_BYTES, _CHANGES = 0, 1
_VALUES = 256

Integers = NDArray[np.integer]


@dataclass(frozen=True)
class CaptureColumns:
    """Captures of one link and one boot as columns.

    Attributes:
        monotonic_ns, utc_ns: (n,) int64.
        identifier: (n,) uint32; zeros for a serial link.
        flags: (n,) uint8.
        length: (n,) uint32, of each capture's data.
        payload: (m,) uint8, the data of all captures, one after the other.
    """

    monotonic_ns: NDArray[np.int64]
    utc_ns: NDArray[np.int64]
    identifier: NDArray[np.uint32]
    flags: NDArray[np.uint8]
    length: NDArray[np.uint32]
    payload: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.flags)

    def equals(self, other: CaptureColumns) -> bool:
        """Return True if all values are the same."""
        return all(np.array_equal(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))


def joined(parts: Sequence[CaptureColumns]) -> CaptureColumns:
    """Return the captures of all parts, one part after the other."""
    return CaptureColumns(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(CaptureColumns)))


def packed(columns: CaptureColumns, *, is_serial: bool) -> bytes:
    """Return the body for captures.

    Args:
        columns: the captures, at least one.
        is_serial: whether their link is serial.
    """
    own_length = np.zeros_like(columns.length) if is_serial else columns.length
    key = np.stack([columns.identifier.astype(np.int64), columns.flags, own_length], axis=1)
    streams, number = np.unique(key, axis=0, return_inverse=True)
    number = number.reshape(-1)
    by_stream = np.argsort(number, kind="stable")
    starts = np.searchsorted(number[by_stream], np.arange(len(streams) + 1))
    step = np.diff(columns.monotonic_ns, prepend=np.int64(0))
    usual = np.array([_middle(step[by_stream[first:last]]) for first, last in pairwise(starts)], dtype=np.int64)
    offset = np.diff(columns.utc_ns - columns.monotonic_ns, prepend=np.int64(0))
    parts = [
        _COUNT.pack(len(streams)),
        planes(streams[:, 0].astype(np.uint32)),
        planes(streams[:, 1].astype(np.uint8)),
        planes(streams[:, 2].astype(np.uint32)),
        planes(_order_codes(number).astype(np.uint32)),
        planes(_zigzag(usual)),
        planes(_zigzag(step[by_stream] - usual[number[by_stream]])),
        planes(_zigzag(offset)),
    ]
    if is_serial:
        return b"".join([*parts, planes(columns.length), columns.payload.tobytes()])
    begins = _begins(columns.length)
    forms, bodies = [], []
    for stream, (first, last) in enumerate(pairwise(starts)):
        places = begins[by_stream[first:last], None] + np.arange(streams[stream, 2])
        form, body = _least(columns.payload[places])
        forms.append(form)
        bodies.append(body)
    return b"".join([*parts, bytes(forms), *bodies])


def unpacked(body: bytes, count: int, *, is_serial: bool) -> CaptureColumns:
    """Return the captures of a body.

    Args:
        body: the body.
        count: number of captures in it.
        is_serial: whether their link is serial.

    Raises:
        ValueError, IndexError: the body is invalid.
    """
    source = Planes(body)
    (streams,) = _COUNT.unpack(source.take(_COUNT.size))
    if not 0 < streams <= count:
        raise ValueError(f"{streams} streams in {count} captures")
    identifier = source.column("<u4", streams).astype(np.uint32)
    flags = source.column("u1", streams).astype(np.uint8)
    width = source.column("<u4", streams).astype(np.uint32)
    number = _stream_numbers(source.column("<u4", count), streams)
    by_stream = np.argsort(number, kind="stable")
    usual = _signed(source.column("<u8", streams))
    step = np.empty(count, dtype=np.int64)
    step[by_stream] = _signed(source.column("<u8", count)) + usual[number[by_stream]]
    monotonic = np.cumsum(step)
    utc = np.cumsum(_signed(source.column("<u8", count))) + monotonic
    length = source.column("<u4", count).astype(np.uint32) if is_serial else width[number]
    if int(length.sum(dtype=np.int64)) > len(body):
        raise ValueError("it ends too early")
    if is_serial:
        payload = np.frombuffer(source.take(int(length.sum(dtype=np.int64))), dtype=np.uint8)
    else:
        payload = np.empty(int(length.sum(dtype=np.int64)), dtype=np.uint8)
        forms, begins = source.take(streams), _begins(length)
        starts = np.searchsorted(number[by_stream], np.arange(streams + 1))
        for stream, (first, last) in enumerate(pairwise(starts)):
            rows, size = int(last - first), int(width[stream])
            places = begins[by_stream[first:last], None] + np.arange(size)
            payload[places] = _restored(source.take(rows * size), forms[stream], rows, size)
    source.end()
    return CaptureColumns(monotonic, utc, identifier[number], flags[number], length, payload)


def _begins(length: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Return the position in the payload at which each capture's data begin."""
    ends = np.cumsum(length, dtype=np.int64)
    begins: NDArray[np.int64] = ends - length
    return begins


def _middle(values: NDArray[np.int64]) -> np.int64:
    """Return the median as one of the values, so that nothing is rounded."""
    middle: np.int64 = np.partition(values, len(values) // 2)[len(values) // 2]
    return middle


def _order_codes(number: Integers) -> Integers:
    """Return, per capture, 0 if its stream last followed the previous capture's stream, else 1 + stream number."""
    before = np.concatenate([[-1], number[:-1]])
    by_before = np.argsort(before, kind="stable")
    follows = number[by_before]
    as_last = np.zeros(len(number), dtype=bool)
    as_last[by_before[1:]] = (follows[1:] == follows[:-1]) & (before[by_before][1:] == before[by_before][:-1])
    return np.where(as_last, 0, number + 1)


def _stream_numbers(codes: Integers, streams: int) -> Integers:
    """Return the stream numbers encoded by `_order_codes`; raise ValueError for an invalid code."""
    follower: dict[int, int] = {}
    found, before = [], -1
    for code in codes.tolist():
        stream = code - 1 if code else follower.get(before, -1)
        if not 0 <= stream < streams:
            raise ValueError(f"code {code} names no stream")
        follower[before] = before = stream
        found.append(stream)
    return np.array(found, dtype=np.int64)


def _least(rows: NDArray[np.uint8]) -> tuple[int, bytes]:
    """Return the form of least entropy for a stream's data (n, width), and the data in this form."""
    width = rows.shape[1]
    forms = {_BYTES: rows, _CHANGES: _changes(rows)}
    forms |= {word: _word_changes(rows, word) for word in _WORDS if width >= word}
    form = min(forms, key=lambda own: _entropy_bits(forms[own]))
    return form, np.ascontiguousarray(forms[form].T).tobytes()


def _restored(body: bytes, form: int, count: int, width: int) -> NDArray[np.uint8]:
    """Return the data (n, width) from their form; raise ValueError for an unknown form."""
    columns = np.frombuffer(body, dtype=np.uint8).reshape(width, count).T
    if form == _BYTES:
        return np.ascontiguousarray(columns)
    if form == _CHANGES:
        return np.cumsum(columns, axis=0, dtype=np.uint8)
    if form not in _WORDS:
        raise ValueError(f"data have the unknown form {form}")
    whole = width // form * form
    unsigned = np.dtype(f"<u{form}")
    zigzag = np.ascontiguousarray(columns[:, :whole]).view(unsigned)
    change = (zigzag >> 1) ^ (np.zeros_like(zigzag) - (zigzag & 1))
    words = np.cumsum(change, axis=0, dtype=unsigned)
    rest = np.cumsum(columns[:, whole:], axis=0, dtype=np.uint8)
    return np.hstack([np.ascontiguousarray(words).view(np.uint8), rest])


def _changes(rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.diff(rows, axis=0, prepend=np.zeros((1, rows.shape[1]), dtype=np.uint8))


def _word_changes(rows: NDArray[np.uint8], word: int) -> NDArray[np.uint8]:
    whole = rows.shape[1] // word * word
    words = np.ascontiguousarray(rows[:, :whole]).view(f"<u{word}")
    change = np.diff(words, axis=0, prepend=np.zeros((1, words.shape[1]), dtype=words.dtype))
    sign = change >> (8 * word - 1)
    zigzag = (change << 1) ^ (np.zeros_like(change) - sign)
    return np.hstack([np.ascontiguousarray(zigzag).view(np.uint8), _changes(rows[:, whole:])])


def _entropy_bits(rows: NDArray[np.uint8]) -> float:
    """Return the sum over columns of the entropy of each column's bytes, in bits."""
    bits = 0.0
    for column in rows.T:
        count = np.bincount(column, minlength=_VALUES)
        some = count[count > 0]
        bits += float((some * np.log2(len(column) / some)).sum())
    return bits


def _zigzag(values: NDArray[np.int64]) -> NDArray[np.uint64]:
    return ((values << 1) ^ (values >> 63)).view(np.uint64)


def _signed(zigzag: Integers) -> NDArray[np.int64]:
    own = zigzag.astype(np.uint64)
    return ((own >> np.uint64(1)) ^ (np.uint64(0) - (own & np.uint64(1)))).view(np.int64)


def planes(column: Integers) -> bytes:
    """Return a column byte plane by byte plane, lowest bytes first, because neighbouring bytes are then similar."""
    size = column.dtype.itemsize
    little = np.ascontiguousarray(column.astype(column.dtype.newbyteorder("<"), copy=False))
    return np.ascontiguousarray(little.view(np.uint8).reshape(-1, size).T).tobytes()


class Planes:
    """Reads a body sequentially.

    Args:
        body: the body, with columns as encoded by `planes`.
    """

    def __init__(self, body: bytes) -> None:
        self._body, self._at = body, 0

    def take(self, size: int) -> bytes:
        """Return the next `size` bytes; raise ValueError if there are fewer."""
        if self._at + size > len(self._body):
            raise ValueError("it ends too early")
        self._at += size
        return self._body[self._at - size : self._at]

    def column(self, dtype: str, count: int) -> Integers:
        """Return the next column; raise ValueError if the body ends before it."""
        size = np.dtype(dtype).itemsize
        planes = np.frombuffer(self.take(size * count), dtype=np.uint8)
        column: Integers = np.ascontiguousarray(planes.reshape(size, -1).T).view(dtype)[:, 0]
        return column

    def end(self) -> None:
        """Raise ValueError if there are more bytes."""
        if self._at != len(self._body):
            raise ValueError(f"{len(self._body) - self._at} bytes too many")
