"""Captured frames and bytes as compact binary chunks: every field of every capture, exactly.

A chunk holds captures of one link and one boot. Layout, little endian:

    magic "RCAP", version u8 = 1 to 3, kind u8 (1 CAN, 2 serial), packing u8 (0 plain, 1 zlib, 2 LZMA2), u8 = 0,
    count u32, body length u32 (before packing), link length u16, boot length u16, link UTF-8, boot UTF-8,
    body (packed), CRC-32 of all preceding bytes u32

The body consists of columns, not rows. Each column of integers is stored byte plane by byte plane, lowest bytes first,
because neighbouring bytes are then similar and a fast compressor is effective. Columns: differences of monotonic_ns i64
(the first from zero), differences of utc_ns - monotonic_ns i64 (the first from zero), CAN only: arbitration_id u32;
flags u8; data length u32; then the data of all captures. Version 2 marks chunks in which a capture has flag 16 (its
time is doubtful), so that a program that does not know the flag cannot treat the time as known. Version 3 marks large
chunks, which were merged from many small ones; packed_captures.py describes their body.
"""

from __future__ import annotations

import lzma
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np

from daemon.store.errors import DamagedChunkError, StoreError
from daemon.store.packed_captures import CaptureColumns, Planes, packed, planes, unpacked
from drivers.clock import Stamp
from drivers.readings import CanCapture, Capture, SerialCapture

_MAGIC = b"RCAP"
_VERSION, _VERSION_WITH_DOUBTS, _VERSION_LARGE = 1, 2, 3
_CAN, _SERIAL = 1, 2
_PLAIN, _ZLIB, _LZMA2 = 0, 1, 2
_HEADER = struct.Struct("<4sBBBxIIHH")
_CRC = struct.Struct("<I")
_EXTENDED, _REMOTE, _ERROR, _TRANSMITTED, _TIME_DOUBTFUL = 1, 2, 4, 8, 16
_FASTEST = 1  # zlib level: saves three quarters of what level 6 saves, in a fifth of its time
_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 6}]


@dataclass(frozen=True, slots=True)
class Chunk:
    """An encoded run of captures.

    Attributes:
        link: link of the captures.
        kind: `can` or `serial`.
        first, last: stamps of the first and the last capture.
        captures: number of captures.
        payload_bytes: total size of their data.
        blob: the chunk itself.
    """

    link: str
    kind: str
    first: Stamp
    last: Stamp
    captures: int
    payload_bytes: int
    blob: bytes


@dataclass(frozen=True)
class CaptureRun:
    """Captures of one link and one boot.

    Attributes:
        link: link of the captures.
        boot_id: boot of their stamps.
        is_serial: whether the link is serial; otherwise it is a CAN bus.
        columns: the captures.
    """

    link: str
    boot_id: str
    is_serial: bool
    columns: CaptureColumns


def encode_captures(captures: Sequence[Capture]) -> list[Chunk]:
    """Encode captures of any links as chunks: one per run of one link, boot and type; links as they first appear.

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
    columns = _columns_of(link, captures)
    monotonic, utc = columns.monotonic_ns, columns.utc_ns
    is_serial = isinstance(captures[0], SerialCapture)
    parts = [np.diff(monotonic, prepend=np.int64(0)), np.diff(utc - monotonic, prepend=np.int64(0))]
    parts += [columns.flags, columns.length] if is_serial else [columns.identifier, columns.flags, columns.length]
    body = b"".join([*map(planes, parts), columns.payload.tobytes()])
    packing, shorter = _ZLIB, zlib.compress(body, _FASTEST)
    if len(shorter) >= len(body):
        packing, shorter = _PLAIN, body
    version = _VERSION_WITH_DOUBTS if (columns.flags & _TIME_DOUBTFUL).any() else _VERSION
    run = CaptureRun(link, captures[0].stamp.boot_id, is_serial, columns)
    return _chunk(run, version, packing, shorter, len(body))


def encode_large(run: CaptureRun) -> Chunk:
    """Encode captures as one large chunk, which is smaller than those of `encode_captures` and slower to make."""
    body = packed(run.columns, is_serial=run.is_serial)
    shorter = lzma.compress(body, lzma.FORMAT_RAW, filters=_FILTERS)
    return _chunk(run, _VERSION_LARGE, _LZMA2, shorter, len(body))


def _columns_of(link: str, captures: Sequence[Capture]) -> CaptureColumns:
    data = [c.data for c in captures]
    try:
        return CaptureColumns(
            np.array([c.stamp.monotonic_ns for c in captures], dtype=np.int64),
            np.array([c.stamp.utc_ns for c in captures], dtype=np.int64),
            np.array([c.arbitration_id if isinstance(c, CanCapture) else 0 for c in captures], dtype=np.uint32),
            np.fromiter(map(_flags, captures), dtype=np.uint8, count=len(captures)),
            np.fromiter(map(len, data), dtype=np.uint32, count=len(data)),
            np.frombuffer(b"".join(data), dtype=np.uint8),
        )
    except OverflowError as error:
        raise StoreError(f"link {link!r}: a captured frame cannot be stored: {error}") from error


def _chunk(run: CaptureRun, version: int, packing: int, body: bytes, length: int) -> Chunk:
    columns, names = run.columns, (run.link.encode(), run.boot_id.encode())
    kind = _SERIAL if run.is_serial else _CAN
    head = _HEADER.pack(_MAGIC, version, kind, packing, len(columns), length, *map(len, names)) + b"".join(names)
    blob = head + body
    blob += _CRC.pack(zlib.crc32(blob))
    first, last = (
        Stamp(
            int(columns.utc_ns[n]), int(columns.monotonic_ns[n]), run.boot_id, bool(columns.flags[n] & _TIME_DOUBTFUL)
        )
        for n in (0, -1)
    )
    return Chunk(run.link, "serial" if run.is_serial else "can", first, last, len(columns), len(columns.payload), blob)


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


def decode_captures(blob: bytes) -> list[Capture]:
    """Return the captures of a chunk, equal to those that were encoded.

    Raises:
        StoreError: as for `decode_run`.
    """
    run = decode_run(blob)
    columns, flags = run.columns, run.columns.flags.tolist()
    stamps = [
        Stamp(u, m, run.boot_id, bool(f & _TIME_DOUBTFUL))
        for u, m, f in zip(columns.utc_ns.tolist(), columns.monotonic_ns.tolist(), flags, strict=True)
    ]
    payload, ends = columns.payload.tobytes(), np.cumsum(columns.length, dtype=np.int64).tolist()
    data = [payload[start:end] for start, end in pairwise([0, *ends])]
    if run.is_serial:
        return [
            SerialCapture(run.link, s, d, bool(f & _TRANSMITTED)) for s, d, f in zip(stamps, data, flags, strict=True)
        ]
    return [
        CanCapture(run.link, s, i, d, bool(f & _EXTENDED), bool(f & _REMOTE), bool(f & _ERROR), bool(f & _TRANSMITTED))
        for s, i, d, f in zip(stamps, columns.identifier.tolist(), data, flags, strict=True)
    ]


def require_sound(blob: bytes) -> None:
    """Check header and checksum of a chunk without decoding it, in a hundredth of the time.

    Raises:
        StoreError: the chunk is truncated, damaged, or of an unknown version.
    """
    if len(blob) < _HEADER.size + _CRC.size or blob[:4] != _MAGIC:
        raise StoreError(f"not a chunk of captures ({len(blob)} bytes)")
    if not _VERSION <= blob[4] <= _VERSION_LARGE:
        known = f"{_VERSION} to {_VERSION_LARGE}"
        raise StoreError(f"chunk of captures has version {blob[4]}, but this rigcal reads {known}; use a newer rigcal")
    if _CRC.unpack_from(blob, len(blob) - _CRC.size)[0] != zlib.crc32(blob[: -_CRC.size]):
        raise DamagedChunkError("chunk of captures is damaged (its CRC-32 does not match)")


def decode_run(blob: bytes) -> CaptureRun:
    """Return the captures of a chunk as columns.

    Raises:
        StoreError: the chunk is truncated, damaged, or of an unknown version.
    """
    require_sound(blob)
    try:
        return _decode(blob)
    except (ArithmeticError, LookupError, TypeError, ValueError, lzma.LZMAError, zlib.error) as error:
        # The CRC-32 is right, so the chunk was written wrong: by a different program, or on a faulty computer.
        raise DamagedChunkError(f"chunk of captures is invalid ({error})") from error


def _decode(blob: bytes) -> CaptureRun:
    _, version, kind, packing, count, body_length, link_length, boot_length = _HEADER.unpack_from(blob)
    link_end = _HEADER.size + link_length
    boot_end = link_end + boot_length
    link = blob[_HEADER.size : link_end].decode()
    boot_id = blob[link_end:boot_end].decode()
    body = blob[boot_end : -_CRC.size]
    if packing == _ZLIB:
        body = zlib.decompressobj().decompress(body, body_length + 1)
    elif packing == _LZMA2:
        body = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_FILTERS).decompress(body, body_length + 1)
    if len(body) != body_length:
        raise ValueError(f"{len(body)} bytes or more, but the header gives {body_length}")
    read = unpacked if version == _VERSION_LARGE else _small
    return CaptureRun(link, boot_id, kind != _CAN, read(body, count, is_serial=kind != _CAN))


def _small(body: bytes, count: int, *, is_serial: bool) -> CaptureColumns:
    """Return the columns of a small chunk's body."""
    source = Planes(body)
    monotonic = np.cumsum(source.column("<i8", count), dtype=np.int64)
    utc = np.cumsum(source.column("<i8", count), dtype=np.int64) + monotonic
    identifier = np.zeros(count, dtype=np.uint32) if is_serial else source.column("<u4", count).astype(np.uint32)
    flags = source.column("u1", count).astype(np.uint8)
    length = source.column("<u4", count).astype(np.uint32)
    payload = np.frombuffer(source.take(int(length.sum(dtype=np.int64))), dtype=np.uint8)
    source.end()
    return CaptureColumns(monotonic, utc, identifier, flags, length, payload)
