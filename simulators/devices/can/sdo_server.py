"""The server side of SDO (CiA 301, 7.2.4): expedited upload and download, segmented upload, aborts."""

from __future__ import annotations

from dataclasses import dataclass

from simulators.devices.can.object_dictionary import Abort, AbortError, ObjectDictionary


@dataclass
class _Upload:
    index: int
    sub: int
    rest: bytes
    toggle: int = 0


class SdoServer:
    """SDO server with one transfer at a time.

    Args:
        dictionary: the objects to read and write.
    """

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self._dictionary = dictionary
        self._upload: _Upload | None = None

    def reset(self) -> None:
        """Discard an unfinished transfer."""
        self._upload = None

    def respond(self, request: bytes) -> bytes | None:
        """Answer a request with eight bytes; None for aborts and malformed frames, which get no answer."""
        if len(request) != 8:
            return None
        command, index, sub = request[0], int.from_bytes(request[1:3], "little"), request[3]
        try:
            return self._dispatch(command, index, sub, request)
        except AbortError as refused:
            self._upload = None
            return _abort(index, sub, refused.code)

    def _dispatch(self, command: int, index: int, sub: int, request: bytes) -> bytes | None:
        specifier = command >> 5
        if specifier == 4:  # the client aborts
            self._upload = None
            return None
        if specifier == 2:
            return self._begin_upload(index, sub)
        if specifier == 3:
            return self._next_segment(command)
        if specifier == 1 and command & 0x02:
            self._upload = None
            size_given = bool(command & 0x01)
            unused = (command >> 2) & 0x03 if size_given else 0
            self._dictionary.download(index, sub, request[4 : 8 - unused], size_given=size_given)
            return bytes([0x60, *request[1:4], 0, 0, 0, 0])
        raise AbortError(Abort.COMMAND)

    def _begin_upload(self, index: int, sub: int) -> bytes:
        self._upload = None
        data = self._dictionary.read(index, sub)
        head = index.to_bytes(2, "little") + bytes([sub])
        if 1 <= len(data) <= 4:
            return bytes([0x43 | (4 - len(data)) << 2]) + head + data.ljust(4, b"\0")
        self._upload = _Upload(index, sub, data)
        return bytes([0x41]) + head + len(data).to_bytes(4, "little")

    def _next_segment(self, command: int) -> bytes:
        upload = self._upload
        if upload is None:
            raise AbortError(Abort.COMMAND)
        if (command >> 4) & 1 != upload.toggle:
            self._upload = None
            return _abort(upload.index, upload.sub, Abort.TOGGLE)
        piece, upload.rest = upload.rest[:7], upload.rest[7:]
        last = not upload.rest
        answer = bytes([upload.toggle << 4 | (7 - len(piece)) << 1 | last]) + piece.ljust(7, b"\0")
        upload.toggle ^= 1
        if last:
            self._upload = None
        return answer


def _abort(index: int, sub: int, code: Abort) -> bytes:
    return bytes([0x80]) + index.to_bytes(2, "little") + bytes([sub]) + code.to_bytes(4, "little")
