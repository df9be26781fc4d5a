"""Vector's binary CAN log (`.blf`): a header and objects, most of them in compressed containers.

This module has its own reader because python-can's trusts the size that an object declares: it reads a size of 0
forever, and unpacks a container to any size. Here an object is never larger than OBJECT_MAX, and an invalid size is an
error.

    file      = header ("LOGG", ...), objects
    object    = "LOBJ", header size u16, header version u16, object size u32, type u32, [flags, time, ...], body
    container = object of type 10: method u16 (0 plain, 2 zlib), ..., bytes of further objects, which may continue in
                the next container
"""

from __future__ import annotations

import datetime
import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import can
from can.util import dlc2len

OBJECT_MAX = 4 << 20  # bytes of an object; Vector's containers hold 128 KiB
UNPACKED_MAX = 500  # largest ratio of unpacked to packed size; for frames with their times the ratio is about 10

_FILE_HEADER = struct.Struct("<4sL8xQQLL8H8H")
_OBJECT = struct.Struct("<4sHHLL")
_CONTAINER = struct.Struct("<H6xL4x")
# Flags and time of an object, by the version of its header
_STAMPED = {1: struct.Struct("<L4xQ"), 2: struct.Struct("<L4xQ8x")}
_CLASSIC = struct.Struct("<HBBL8s")
_ERROR = struct.Struct("<HHLBBBxLLH2x8s")
_FD = struct.Struct("<HBBLLBBB5x")
_FD_64 = struct.Struct("<BBBBLLLLLLLHBBL")

_SIGNATURE = b"LOBJ"
_PLAIN, _ZLIB = 0, 2
_TEN_MICROSECONDS = 1
_CONTAINER_TYPE = 10
_EXTENDED, _IDENTIFIER = 0x80000000, 0x1FFFFFFF


class BlfReader:
    """Reader of a log; iterate over it to get the frames as python-can messages.

    Objects that are not frames, and error frames of other types than CAN_ERROR_EXT, are skipped.

    Args:
        file: file opened for reading, positioned at its beginning.

    Attributes:
        file_size, object_count: values from the file's header; 0 if the file was not closed.

    Raises:
        ValueError: the file does not begin like a BLF log.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        data = file.read(_FILE_HEADER.size)
        if len(data) < _FILE_HEADER.size or data[:4] != b"LOGG":
            raise ValueError("it does not begin with a BLF header")
        _, header_size, self.file_size, _, self.object_count, _, *times = _FILE_HEADER.unpack(data)
        self._start_s = _seconds(times[:8])
        if not _FILE_HEADER.size <= header_size <= OBJECT_MAX:
            raise ValueError(f"its header has an invalid size: {header_size} bytes")
        self._at = header_size
        file.seek(header_size)

    def __iter__(self) -> Iterator[can.Message]:
        """Yield the frames in order; raise ValueError, with the position, at the first invalid object."""
        packed = _Packed()
        while head := self._file.read(_OBJECT.size):
            where = f"object at byte {self._at}"
            size, kind = _size_and_kind(head, where)
            body = self._file.read(size - _OBJECT.size)
            if len(body) < size - _OBJECT.size:
                raise ValueError(f"{where} has {size} bytes, but the file ends before that")
            self._file.read(size % 4)  # padding
            self._at += size + size % 4
            if kind == _CONTAINER_TYPE:
                packed.add(_unpacked(body, where))
                yield from self._frames(packed, where)
            else:
                frame = self._frame(head + body, where)
                if frame is not None:
                    yield frame

    def _frames(self, packed: _Packed, where: str) -> Iterator[can.Message]:
        while (data := packed.take(where)) is not None:
            frame = self._frame(data, where)
            if frame is not None:
                yield frame

    def _frame(self, data: bytes, where: str) -> can.Message | None:
        _, _, version, _, kind = _OBJECT.unpack_from(data)
        if kind not in _BODIES:
            return None
        if self._start_s is None:
            raise ValueError("its header has no valid date, so the times of its frames are unknown")
        stamped = _STAMPED.get(version)
        if stamped is None:
            raise ValueError(f"{where}: a frame has a header of unknown version {version}")
        try:
            flags, ticks = stamped.unpack_from(data, _OBJECT.size)
            parts = _BODIES[kind](data, _OBJECT.size + stamped.size)
        except struct.error as error:
            raise ValueError(f"{where}: a frame is truncated: {error}") from error
        seconds = ticks * (1e-5 if flags == _TEN_MICROSECONDS else 1e-9)
        return can.Message(
            timestamp=seconds + self._start_s,
            arbitration_id=parts.identifier & _IDENTIFIER,
            is_extended_id=bool(parts.identifier & _EXTENDED),
            is_remote_frame=parts.is_remote,
            is_error_frame=parts.is_error,
            is_rx=not parts.is_transmitted,
            is_fd=parts.is_fd,
            dlc=parts.length,
            data=parts.data,
            channel=parts.channel - 1,
        )


class _Packed:
    """Contents of the containers, joined and split into objects; an object may begin in one and end in the next."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._at = 0

    def add(self, data: bytes) -> None:
        del self._buffer[: self._at]
        self._at = 0
        self._buffer += data

    def take(self, where: str) -> bytes | None:
        """Return the next object; None if it is not complete yet."""
        buffer, at = self._buffer, self._at
        if len(buffer) - at < 8:
            return None
        at = buffer.find(_SIGNATURE, at, at + 8)  # after up to four bytes of padding
        if at < 0:
            raise ValueError(f"{where}: no object found where one should begin")
        if len(buffer) - at < _OBJECT.size:
            return None
        size, _ = _size_and_kind(bytes(buffer[at : at + _OBJECT.size]), where)
        if len(buffer) - at < size:
            return None
        self._at = at + size
        return bytes(buffer[at : at + size])


class _Body(NamedTuple):
    """Fields of a frame object."""

    channel: int
    identifier: int
    length: int
    data: bytes
    is_remote: bool = False
    is_error: bool = False
    is_transmitted: bool = False
    is_fd: bool = False


def _classic(data: bytes, at: int) -> _Body:
    channel, flags, length, identifier, content = _CLASSIC.unpack_from(data, at)
    return _Body(channel, identifier, length, content[:length], bool(flags & 0x80), is_transmitted=bool(flags & 1))


def _error(data: bytes, at: int) -> _Body:
    channel, _, _, _, _, length, _, identifier, _, content = _ERROR.unpack_from(data, at)
    return _Body(channel, identifier, length, content[:length], is_error=True)


def _fd(data: bytes, at: int) -> _Body:
    channel, flags, code, identifier, _, _, fd_flags, count = _FD.unpack_from(data, at)
    content = data[at + _FD.size :][:count]
    return _Body(
        channel,
        identifier,
        dlc2len(code),
        content,
        bool(flags & 0x80),
        is_transmitted=bool(flags & 1),
        is_fd=bool(fd_flags & 1),
    )


def _fd_64(data: bytes, at: int) -> _Body:
    channel, code, count, _, identifier, _, flags, *_, direction, further, _ = _FD_64.unpack_from(data, at)
    # Bytes missing before the extra data count as zeros, as in Vector's own reader
    content = data[at + _FD_64.size : further or None][:count].ljust(count, b"\0")
    return _Body(
        channel,
        identifier,
        dlc2len(code),
        content,
        bool(flags & 0x0010),
        is_transmitted=bool(direction),
        is_fd=bool(flags & 0x1000),
    )


# CAN_MESSAGE, CAN_ERROR_EXT, CAN_MESSAGE2, CAN_FD_MESSAGE (classic frames too), CAN_FD_MESSAGE_64
_BODIES = {1: _classic, 73: _error, 86: _classic, 100: _fd, 101: _fd_64}


def _size_and_kind(head: bytes, where: str) -> tuple[int, int]:
    if len(head) < _OBJECT.size or head[:4] != _SIGNATURE:
        raise ValueError(f"{where}: no object found where one should begin")
    _, _, _, size, kind = _OBJECT.unpack(head)
    if not _OBJECT.size <= size <= OBJECT_MAX:
        raise ValueError(f"{where}: an object has {size} bytes; allowed are {_OBJECT.size} to {OBJECT_MAX}")
    return size, kind


def _unpacked(body: bytes, where: str) -> bytes:
    if len(body) < _CONTAINER.size:
        raise ValueError(f"{where}: a container has no header")
    method, _ = _CONTAINER.unpack_from(body)
    packed = body[_CONTAINER.size :]
    if method == _PLAIN:
        return packed
    if method != _ZLIB:
        raise ValueError(f"{where}: unknown compression method {method}; supported are 0 and 2")
    most = min(OBJECT_MAX, UNPACKED_MAX * len(packed))
    inflater = zlib.decompressobj()
    data = inflater.decompress(packed, most)
    if inflater.unconsumed_tail and inflater.decompress(inflater.unconsumed_tail, 1):
        raise ValueError(f"{where}: {len(packed)} bytes unpack to more than {most}")
    if not inflater.eof:
        raise ValueError(f"{where}: its compressed data is truncated")
    return data


def _seconds(time: list[int]) -> float | None:
    """Return UTC of a SYSTEMTIME (year, month, weekday, day, hour, minute, second, ms); None if it is invalid."""
    year, month, _, day, hour, minute, second, millisecond = time
    try:
        stamp = datetime.datetime(year, month, day, hour, minute, second, millisecond * 1000, tzinfo=datetime.UTC)
    except ValueError:
        return None
    return stamp.timestamp()
