"""Captured frames and bytes as compact binary chunks: every field of every capture, exactly.

A chunk holds captures of one link and one boot. Layout, little endian:

    magic "RCAP", version u8 = 1 or 2, kind u8 (1 CAN, 2 serial), packing u8 (0 plain, 1 zlib), u8 = 0,
    count u32, body length u32 (before packing), link length u16, boot length u16, link UTF-8, boot UTF-8,
    body (packed), CRC-32 of all that precedes u32

The body is columns, not rows, and each column of integers is stored byte plane by byte plane, first all lowest bytes:
neighbours resemble each other, which is what makes a fast compressor effective. Columns: differences of monotonic_ns
i64 (the first from zero), differences of utc_ns - monotonic_ns i64 (the first from zero), CAN only: arbitration_id
u32; flags u8; data length u32; then the data of all captures. Version 2 is that of chunks in which a capture has the
flag 16, its time is doubtful: a program that does not know the flag must not take the time for known.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np
from numpy.typing import NDArray

from daemon.store.errors import StoreError
from drivers.clock import Stamp
from drivers.readings import CanCapture, Capture, SerialCapture

_MAGIC = b"RCAP"
_VERSION, _VERSION_WITH_DOUBTS = 1, 2
_CAN, _SERIAL = 1, 2
_PLAIN, _ZLIB = 0, 1
_HEADER = struct.Struct("<4sBBBxIIHH")
_CRC = struct.Struct("<I")
_EXTENDED, _REMOTE, _ERROR, _TRANSMITTED, _TIME_DOUBTFUL = 1, 2, 4, 8, 16
_FASTEST = 1  # zlib level: three quarters of what level 6 gains, in a fifth of its time


@dataclass(frozen=True, slots=True)
class Chunk:
    """An encoded run of captures.

    Attributes:
        link: the link they crossed.
        kind: `can` or `serial`.
        first, last: stamps of the first and the last capture.
        captures: how many.
        payload_bytes: sum of their data.
        blob: the chunk itself.
    """

    link: str
    kind: str
    first: Stamp
    last: Stamp
    captures: int
    payload_bytes: int
    blob: bytes


def encode_captures(captures: Sequence[Capture]) -> list[Chunk]:
    """Chunks of `captures` (any links, any order): one per link and boot, each in order; links as they first appear.

    Raises:
        StoreError: a field does not fit its column (an arbitration id beyond 32 bits).
    """
    links: dict[str, list[Capture]] = {}
    for capture in captures:
        try:
            links[capture.link].append(capture)
        except KeyError:
            links[capture.link] = [capture]
    return [
        _encode(link, list(run))
        for link, of_link in links.items()
        for _, run in groupby(of_link, key=lambda c: (c.stamp.boot_id, type(c)))
    ]


def _encode(link: str, captures: list[Capture]) -> Chunk:
    first, last = captures[0].stamp, captures[-1].stamp
    stamps = [c.stamp for c in captures]
    data = [c.data for c in captures]
    is_can = isinstance(captures[0], CanCapture)
    try:
        monotonic = np.array([s.monotonic_ns for s in stamps], dtype=np.int64)
        utc = np.array([s.utc_ns for s in stamps], dtype=np.int64)
        columns = [np.diff(monotonic, prepend=np.int64(0)), np.diff(utc - monotonic, prepend=np.int64(0))]
        if is_can:
            columns.append(np.array([c.arbitration_id for c in captures if isinstance(c, CanCapture)], dtype="<u4"))
        columns.append(np.fromiter(map(_flags, captures), dtype=np.uint8, count=len(captures)))
        columns.append(np.fromiter(map(len, data), dtype="<u4", count=len(data)))
    except OverflowError as error:
        raise StoreError(f"link {link!r}: a captured frame cannot be stored: {error}") from error
    payload = b"".join(data)
    body = b"".join(map(_planes, columns)) + payload
    packing, packed = _ZLIB, zlib.compress(body, _FASTEST)
    if len(packed) >= len(body):
        packing, packed = _PLAIN, body
    names = link.encode(), first.boot_id.encode()
    kind = _CAN if is_can else _SERIAL
    version = _VERSION_WITH_DOUBTS if any(s.is_doubtful for s in stamps) else _VERSION
    head = _HEADER.pack(_MAGIC, version, kind, packing, len(captures), len(body), *map(len, names)) + b"".join(names)
    blob = head + packed
    blob += _CRC.pack(zlib.crc32(blob))
    return Chunk(link, "can" if is_can else "serial", first, last, len(captures), len(payload), blob)


def _flags(capture: Capture) -> int:
    flags = _TRANSMITTED if capture.is_transmitted else 0
    if capture.stamp.is_doubtful:
        flags |= _TIME_DOUBTFUL
    if isinstance(capture, CanCapture):
        if capture.is_extended:
            flags |= _EXTENDED
        if capture.is_remote:
            flags |= _REMOTE
        if capture.is_error:
            flags |= _ERROR
    return flags


def _planes(column: NDArray[np.generic]) -> bytes:
    size = column.dtype.itemsize
    little = column.astype(column.dtype.newbyteorder("<"), copy=False)
    return np.ascontiguousarray(little.view(np.uint8).reshape(-1, size).T).tobytes()


def decode_captures(blob: bytes) -> list[Capture]:
    """The captures of a chunk, equal to those that were encoded.

    Raises:
        StoreError: the chunk is truncated, damaged, or of a version that this program does not know.
    """
    if len(blob) < _HEADER.size + _CRC.size or blob[:4] != _MAGIC:
        raise StoreError(f"not a chunk of captures ({len(blob)} bytes)")
    if blob[4] not in (_VERSION, _VERSION_WITH_DOUBTS):
        known = f"{_VERSION} and {_VERSION_WITH_DOUBTS}"
        raise StoreError(f"chunk of captures has version {blob[4]}, this program reads {known}; use a newer one")
    if _CRC.unpack_from(blob, len(blob) - _CRC.size)[0] != zlib.crc32(blob[: -_CRC.size]):
        raise StoreError("chunk of captures is damaged (its CRC-32 does not match); restore the store from a backup")
    try:
        return _decode(blob)
    except (ArithmeticError, LookupError, TypeError, ValueError, zlib.error) as error:
        # Its CRC-32 is right, so it was written so: not by this program, or on a broken computer.
        raise StoreError(f"chunk of captures makes no sense ({error}); restore the store from a backup") from error


def _decode(blob: bytes) -> list[Capture]:
    _, _, kind, packing, count, body_length, link_length, boot_length = _HEADER.unpack_from(blob)
    link_end = _HEADER.size + link_length
    boot_end = link_end + boot_length
    link = blob[_HEADER.size : link_end].decode()
    boot_id = blob[link_end:boot_end].decode()
    body = blob[boot_end : -_CRC.size]
    if packing == _ZLIB:
        body = zlib.decompressobj().decompress(body, body_length + 1)
    if len(body) != body_length:
        raise ValueError(f"{len(body)} bytes or more where its header says {body_length}")
    columns = _Columns(body, count)
    monotonic = np.cumsum(columns.take("<i8"))
    utc = np.cumsum(columns.take("<i8")) + monotonic
    identifiers = columns.take("<u4").tolist() if kind == _CAN else []
    flags = columns.take("u1").tolist()
    stamps = [
        Stamp(u, m, boot_id, bool(f & _TIME_DOUBTFUL))
        for u, m, f in zip(utc.tolist(), monotonic.tolist(), flags, strict=True)
    ]
    data = list(columns.slices(columns.take("<u4")))
    if kind == _CAN:
        return [
            CanCapture(link, s, i, d, bool(f & _EXTENDED), bool(f & _REMOTE), bool(f & _ERROR), bool(f & _TRANSMITTED))
            for s, i, d, f in zip(stamps, identifiers, data, flags, strict=True)
        ]
    return [SerialCapture(link, s, d, bool(f & _TRANSMITTED)) for s, d, f in zip(stamps, data, flags, strict=True)]


class _Columns:
    """Reads a body column by column."""

    def __init__(self, body: bytes, count: int) -> None:
        self._body, self._count, self._at = body, count, 0

    def take(self, dtype: str) -> NDArray[np.generic]:
        size = np.dtype(dtype).itemsize
        planes = np.frombuffer(self._body, dtype=np.uint8, count=size * self._count, offset=self._at)
        self._at += size * self._count
        return np.ascontiguousarray(planes.reshape(size, -1).T).view(dtype)[:, 0]

    def slices(self, lengths: NDArray[np.generic]) -> Iterator[bytes]:
        ends = [self._at, *(np.cumsum(lengths.astype(np.int64)) + self._at).tolist()]
        return (self._body[start:end] for start, end in pairwise(ends))
