"""Byte strings as what arrives over time: pieces of a serial line, frames of a bus."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator

from drivers.clock import Stamp
from drivers.readings import CanCapture

START = Stamp(1_700_000_000_000_000_000, 1_000_000_000, "boot")
_PAUSES_NS = (0, 20_000_000, 1_500_000_000, 40_000_000_000)
_FRAME = struct.Struct("<BIB8s")
_EXTENDED, _REMOTE, _ERROR, _TRANSMITTED = 1, 2, 4, 8


def pieces(data: bytes) -> Iterator[tuple[int, bool, bytes]]:
    """(pause before it in ns, whether it was sent, bytes): each behind a byte with pause, direction and length."""
    at = 0
    while at < len(data):
        head, length = data[at], data[at] & 0x1F
        yield _PAUSES_NS[head >> 6], bool(head & 0x20), data[at + 1 : at + 1 + length]
        at += 1 + length


def pack_pieces(found: Iterable[tuple[int, bool, bytes]]) -> bytes:
    """Inverse of `pieces`; pauses become the nearest there is, long pieces several."""
    out = bytearray()
    for pause_ns, is_sent, data in found:
        pause = min(range(len(_PAUSES_NS)), key=lambda k: abs(_PAUSES_NS[k] - pause_ns))
        for start in range(0, max(1, len(data)), 0x1F):
            part = data[start : start + 0x1F]
            out += bytes([(0 if start else pause << 6) | is_sent << 5 | len(part)]) + part
    return bytes(out)


def frames(data: bytes) -> Iterator[CanCapture]:
    """Captures of 14 bytes each."""
    stamp = START
    for flags, identifier, length, content in _FRAME.iter_unpack(data[: len(data) // _FRAME.size * _FRAME.size]):
        stamp = stamp.shifted(_PAUSES_NS[flags >> 6])
        is_extended, is_error = bool(flags & _EXTENDED), bool(flags & _ERROR)
        most = 0x1FFFFFFF if is_extended or is_error else 0x7FF
        yield CanCapture(
            "boom",
            stamp,
            identifier & most,
            content[: min(length, 8)],
            is_extended and not is_error,
            bool(flags & _REMOTE),
            is_error,
            is_transmitted=bool(flags & _TRANSMITTED),
        )


def pack_frames(captures: Iterable[CanCapture]) -> bytes:
    """Inverse of `frames`, with pauses as they are nearest."""
    out = bytearray()
    for capture in captures:
        flags = 1 << 6 | capture.is_extended * _EXTENDED | capture.is_remote * _REMOTE
        flags |= capture.is_error * _ERROR | capture.is_transmitted * _TRANSMITTED
        out += _FRAME.pack(flags, capture.arbitration_id, len(capture.data), capture.data)
    return bytes(out)
