"""Classic CAN frames, and how SocketCAN, python-can's `udp_multicast` and slcan adapters encode them."""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

import msgpack

STANDARD_ID_MAX = 0x7FF
EXTENDED_ID_MAX = 0x1FFFFFFF
DATA_MAX = 8


class Frame(NamedTuple):
    """One classic CAN frame, without a timestamp.

    Attributes:
        arbitration_id: 11-bit, or 29-bit if `is_extended`; the error class bits of SocketCAN if `is_error`.
        data: 0 to 8 bytes.
        is_extended, is_remote, is_error: the frame's flags.
    """

    arbitration_id: int
    data: bytes
    is_extended: bool = False
    is_remote: bool = False
    is_error: bool = False

    @property
    def is_plain(self) -> bool:
        """True for a data frame with an 11-bit identifier; all CANopen frames are of this kind."""
        return not (self.is_extended or self.is_remote or self.is_error)

    def __str__(self) -> str:
        digits = 8 if self.is_extended else 3
        return f"{self.arbitration_id:0{digits}X} [{len(self.data)}] {self.data.hex(' ').upper()}".rstrip()


_CAN_FRAME = struct.Struct("=IB3x8s")  # struct can_frame, linux/can.h
_EFF_FLAG, _RTR_FLAG, _ERR_FLAG = 0x80000000, 0x40000000, 0x20000000


def parse_can_frame(datagram: bytes) -> Frame | None:
    """Parse a `struct can_frame`; None if the datagram is not one (CAN FD, for example)."""
    if len(datagram) != _CAN_FRAME.size:
        return None
    identifier, length, data = _CAN_FRAME.unpack(datagram)
    if length > DATA_MAX:
        return None
    is_extended = identifier & _EFF_FLAG != 0
    is_remote = identifier & _RTR_FLAG != 0
    if identifier & _ERR_FLAG:
        return Frame(identifier & EXTENDED_ID_MAX, data[:length], is_error=True)
    return Frame(
        identifier & (EXTENDED_ID_MAX if is_extended else STANDARD_ID_MAX),
        b"" if is_remote else data[:length],
        is_extended,
        is_remote,
    )


def parse_multicast(datagram: bytes) -> tuple[Frame, float] | None:
    """Parse a message of `udp_multicast` (a msgpack map) and its timestamp; None if it is not a classic CAN frame."""
    try:
        fields = msgpack.unpackb(datagram)
        identifier, data, timestamp = fields["arbitration_id"], fields["data"], float(fields["timestamp"])
        is_extended, is_remote = fields["is_extended_id"], fields["is_remote_frame"]
        is_error, is_fd = fields["is_error_frame"], fields["is_fd"]
    except (ValueError, TypeError, KeyError, msgpack.UnpackException):
        return None
    if not isinstance(identifier, int) or not isinstance(data, bytes) or is_fd or len(data) > DATA_MAX:
        return None
    if not 0 <= identifier <= (EXTENDED_ID_MAX if is_extended or is_error else STANDARD_ID_MAX):
        return None
    return Frame(identifier, data, bool(is_extended and not is_error), bool(is_remote), bool(is_error)), timestamp


# Lines in which slcan adapters report errors (Linux, drivers/net/can/slcan) -> the same content in SocketCAN's error
# frames (linux/can/error.h). Controller state -> class bits and data[1]; error -> class bits, index into data, bits.
_SLCAN_STATES = {b"a": (0x004, 0x40), b"w": (0x004, 0x0C), b"p": (0x004, 0x30), b"b": (0x040, 0x00)}
_SLCAN_ERRORS = {
    b"a": (0x020, 0, 0x00),
    b"b": (0x088, 2, 0x08),
    b"B": (0x088, 2, 0x10),
    b"c": (0x088, 3, 0x08),
    b"f": (0x088, 2, 0x02),
    b"s": (0x088, 2, 0x04),
    b"o": (0x004, 1, 0x01),
    b"O": (0x004, 1, 0x02),
}


def slcan_line(frame: Frame) -> bytes:
    """Return the line that makes an slcan adapter send a frame."""
    letter, data = ("r", "") if frame.is_remote else ("t", frame.data.hex().upper())
    identifier = (
        f"{letter.upper()}{frame.arbitration_id:08X}" if frame.is_extended else f"{letter}{frame.arbitration_id:03X}"
    )
    return f"{identifier}{len(frame.data)}{data}\r".encode("ascii")


class SlcanLines:
    """Splits an adapter's bytes into lines and parses these into frames. Pure.

    An adapter's timestamps are either on or off. A line with a timestamp among lines without, or the reverse, has lost
    or gained characters that may be data, so it is malformed; several in a row show that the setting was changed.

    Attributes:
        malformed: number of lines that were neither a frame nor an answer to a command.
        refused: number of commands that the adapter has refused since the last one that it has carried out.
    """

    # Upper case marks extended frames (T, R), lower case standard ones. Hexadecimal digits may be in either case.
    _FRAME = re.compile(
        rb"(?:t([0-9A-Fa-f]{3})|T([0-9A-Fa-f]{8})|r([0-9A-Fa-f]{3})|R([0-9A-Fa-f]{8}))([0-8])([0-9A-Fa-f]*)"
    )
    _ANSWER = re.compile(rb"[zZ]|F[0-9A-Fa-f]{2}|[VN].*", re.DOTALL)  # sent, status flags, version or serial number
    _STATE = re.compile(rb"s([awpb])(\d{3})(\d{3})")
    _ERRORS = re.compile(rb"e(\d)([abBcfsoO]+)")
    _LINE_MAX = 64  # bytes; more without a line end is noise
    _CHANGED_AFTER = 3

    def __init__(self) -> None:
        self._rest = b""
        self._has_times: bool | None = None  # as the adapter's timestamps are set; None before the first frame
        self._otherwise = 0  # lines in a row that look as if they were set otherwise
        self.malformed = self.refused = 0

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that these bytes complete."""
        # BEL refuses a command; like CR, it ends a line
        *lines, self._rest = (self._rest + data).replace(b"\a", b"\a\r").split(b"\r")
        if len(self._rest) > self._LINE_MAX:
            self._rest = b""
            self.malformed += 1
        frames = []
        for answer in (line.strip(b"\n") for line in lines):  # some adapters end a line with CR and LF
            line = answer.removesuffix(b"\a")
            if line != answer:
                self.refused += 1
            elif line in (b"", b"z", b"Z"):
                self.refused = 0
            frame = self._frame(line)
            if frame is not None:
                frames.append(frame)
            elif line and not self._ANSWER.fullmatch(line):
                self.malformed += 1
        return frames

    def _frame(self, line: bytes) -> Frame | None:
        match = self._FRAME.fullmatch(line)
        if match is None:
            return self._error_frame(line)
        standard, extended, remote_standard, remote_extended, length, digits = match.groups()
        identifier = int(standard or extended or remote_standard or remote_extended, 16)
        is_extended = bool(extended or remote_extended)
        if identifier > (EXTENDED_ID_MAX if is_extended else STANDARD_ID_MAX):
            return None
        is_remote = bool(remote_standard or remote_extended)
        end = 0 if is_remote else 2 * int(length)
        if len(digits) not in (end, end + 4):  # four more digits if the adapter's timestamps are on
            return None
        if not self._is_as_set(has_time=len(digits) != end):
            return None
        return Frame(identifier, bytes.fromhex(digits[:end].decode("ascii")), is_extended, is_remote)

    def _is_as_set(self, *, has_time: bool) -> bool:
        """Return True if the adapter's other lines have, or lack, a timestamp like this one."""
        self._otherwise = 0 if has_time == self._has_times else self._otherwise + 1
        if self._has_times is None or self._otherwise == self._CHANGED_AFTER:
            self._has_times, self._otherwise = has_time, 0
        return has_time == self._has_times

    def _error_frame(self, line: bytes) -> Frame | None:
        """Return the error frame equivalent to an adapter's error line; None if the line is not one."""
        data = bytearray(8)
        if state := self._STATE.fullmatch(line):
            identifier, data[1] = _SLCAN_STATES[state[1]]
            data[7], data[6] = (min(int(count), 255) for count in state.groups()[1:])
            return Frame(identifier, bytes(data), is_error=True)
        errors = self._ERRORS.fullmatch(line)
        if errors is None or int(errors[1]) != len(errors[2]):
            return None
        identifier = 0
        for letter in errors[2]:
            bits, at, value = _SLCAN_ERRORS[bytes([letter])]
            identifier |= bits
            data[at] |= value
        return Frame(identifier, bytes(data), is_error=True)
