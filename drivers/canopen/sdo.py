"""SDO, CANopen's access to the objects of a node (CiA 301): codec, and client state machine for one transfer.

Uploads (reads) are expedited or segmented. Downloads (writes) are expedited only, as no object that rigcal writes has
more than 4 bytes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from drivers.errors import DeviceError

UPLOAD_MAX_BYTES = 4096  # far more than any object read here has; limits memory if a node never ends

NO_SUCH_OBJECT = 0x06020000
NO_SUCH_SUBINDEX = 0x06090011
MISSING = NO_SUCH_OBJECT, NO_SUCH_SUBINDEX

ABORT_TEXTS = {
    0x05030000: "toggle bit not alternated",
    0x05040000: "SDO protocol timed out",
    0x05040001: "command specifier not valid or unknown",
    0x05040002: "invalid block size",
    0x05040003: "invalid sequence number",
    0x05040004: "CRC error",
    0x05040005: "out of memory",
    0x06010000: "unsupported access to an object",
    0x06010001: "read of a write-only object",
    0x06010002: "write of a read-only object",
    NO_SUCH_OBJECT: "object does not exist",
    0x06040041: "object cannot be mapped to the PDO",
    0x06040042: "mapped objects would exceed the PDO length",
    0x06040043: "general parameter incompatibility",
    0x06040047: "general internal incompatibility in the device",
    0x06060000: "access failed because of a hardware error",
    0x06070010: "data type or length does not match",
    0x06070012: "data too long",
    0x06070013: "data too short",
    NO_SUCH_SUBINDEX: "sub-index does not exist",
    0x06090030: "value out of range",
    0x06090031: "value too high",
    0x06090032: "value too low",
    0x06090036: "maximum is less than minimum",
    0x060A0023: "resource not available",
    0x08000000: "general error",
    0x08000020: "data cannot be transferred or stored",
    0x08000021: "data cannot be transferred or stored because of local control",
    0x08000022: "data cannot be transferred or stored in the present device state",
    0x08000023: "object dictionary not present",
    0x08000024: "no data available",
}


@dataclass(frozen=True, slots=True)
class Upload:
    """Read an object."""

    index: int
    subindex: int

    def __str__(self) -> str:
        return f"reading {self.index:04X}h.{self.subindex}"


@dataclass(frozen=True, slots=True)
class Download:
    """Write 1 to 4 bytes to an object."""

    index: int
    subindex: int
    data: bytes

    def __str__(self) -> str:
        return f"writing {self.data.hex(' ').upper()} to {self.index:04X}h.{self.subindex}"


Transfer = Upload | Download


class SdoAbortError(DeviceError):
    """The node refused a transfer.

    Attributes:
        code: abort code.
    """

    def __init__(self, where: str, transfer: Transfer, code: int) -> None:
        text = ABORT_TEXTS.get(code, "unknown abort code")
        super().__init__(where, f"{transfer} was aborted by the node: {code:08X}h, {text}")
        self.code = code


@dataclass(frozen=True, slots=True)
class UploadResponse:
    """Answer to an upload request: the data if the upload is expedited, else None (segments follow)."""

    index: int
    subindex: int
    data: bytes | None


@dataclass(frozen=True, slots=True)
class SegmentResponse:
    """One segment of an upload."""

    toggle: int
    data: bytes
    is_last: bool


@dataclass(frozen=True, slots=True)
class DownloadResponse:
    """A download was accepted."""

    index: int
    subindex: int


@dataclass(frozen=True, slots=True)
class AbortResponse:
    """A transfer was refused."""

    index: int
    subindex: int
    code: int


Response = UploadResponse | SegmentResponse | DownloadResponse | AbortResponse


def encode_upload(index: int, subindex: int) -> bytes:
    """Encode the request to read an object."""
    return struct.pack("<BHB4x", 0x40, index, subindex)


def encode_upload_segment(toggle: int) -> bytes:
    """Encode the request for the next segment of an upload."""
    return bytes((0x60 | toggle << 4,)) + bytes(7)


def encode_download(index: int, subindex: int, data: bytes) -> bytes:
    """Encode the request to write 1 to 4 bytes, expedited and with the size indicated.

    Raises:
        ValueError: `data` is empty or has more than 4 bytes.
    """
    if not 1 <= len(data) <= 4:
        raise ValueError(f"an expedited download has 1 to 4 bytes, not {len(data)}")
    return struct.pack("<BHB", 0x23 | (4 - len(data)) << 2, index, subindex) + data.ljust(4, b"\0")


def decode_response(data: bytes) -> Response:
    """Decode a server's message.

    Raises:
        ValueError: not 8 bytes, or a command specifier that does not belong to the transfers of this module.
    """
    if len(data) != 8:
        raise ValueError(f"an SDO message has 8 bytes, this one has {len(data)}")
    command, index, subindex = struct.unpack_from("<BHB", data)
    specifier = command >> 5
    if specifier == 0:
        return SegmentResponse(command >> 4 & 1, data[1 : 8 - (command >> 1 & 7)], bool(command & 1))
    if specifier == 2:
        if not command & 2:
            return UploadResponse(index, subindex, None)
        unused = command >> 2 & 3 if command & 1 else 0  # 42h: no size indicated, all four bytes are data
        return UploadResponse(index, subindex, data[4 : 8 - unused])
    if specifier == 3:
        return DownloadResponse(index, subindex)
    if specifier == 4:
        return AbortResponse(index, subindex, int.from_bytes(data[4:], "little"))
    raise ValueError(f"SDO command {command:02X}h is not an answer to an upload or an expedited download")


class SdoExchange:
    """The client side of one transfer: send `request` to the node and `feed` its answers until `result` is set.

    Args:
        where: name of the node, for error messages.
        transfer: the object to read or write.

    Attributes:
        request: data of the frame to send next, or again after a timeout, with the node's SDO request COB-ID.
        result: bytes read (empty for a download) once the transfer is complete, else None.
    """

    def __init__(self, where: str, transfer: Transfer) -> None:
        self._where = where
        self.transfer = transfer
        self.result: bytes | None = None
        self._segments: bytearray | None = None
        self._toggle = 0
        if isinstance(transfer, Upload):
            self.request = encode_upload(transfer.index, transfer.subindex)
        else:
            self.request = encode_download(transfer.index, transfer.subindex, transfer.data)

    def feed(self, data: bytes) -> bool:
        """Process a message from the node; return True if there is a new `request` to send.

        Messages that do not belong to this transfer (another client's transfer, a late repetition) are ignored.

        Raises:
            SdoAbortError: the node refused the transfer.
            DeviceError: the node sends more than UPLOAD_MAX_BYTES.
        """
        try:
            response = decode_response(data)
        except ValueError:
            return False
        if isinstance(response, SegmentResponse):
            return self._take_segment(response)
        if (response.index, response.subindex) != (self.transfer.index, self.transfer.subindex):
            return False
        if isinstance(response, AbortResponse):
            raise SdoAbortError(self._where, self.transfer, response.code)
        if isinstance(self.transfer, Upload):
            return isinstance(response, UploadResponse) and self._take_upload(response)
        if isinstance(response, DownloadResponse):
            self.result = b""
        return False

    def _take_upload(self, response: UploadResponse) -> bool:
        if response.data is not None:
            self.result = response.data
            return False
        if self._segments is not None:
            return False  # answer to a repeated request; the segments are already being read
        self._segments = bytearray()
        self.request = encode_upload_segment(0)
        return True

    def _take_segment(self, segment: SegmentResponse) -> bool:
        if self._segments is None or segment.toggle != self._toggle:
            return False
        self._segments += segment.data
        if len(self._segments) > UPLOAD_MAX_BYTES:
            raise DeviceError(self._where, f"{self.transfer}: cancelled after more than {UPLOAD_MAX_BYTES} bytes")
        if segment.is_last:
            self.result = bytes(self._segments)
            return False
        self._toggle ^= 1
        self.request = encode_upload_segment(self._toggle)
        return True
