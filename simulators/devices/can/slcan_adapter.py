"""A Lawicel (slcan) adapter: the serial end of a CAN bus, for python-can's `slcan` interface and slcand.

Commands end with CR. The answer CR means "done", BEL means "refused". O opens the channel, L opens it listen-only
(nothing may be sent), C closes it, Sn sets the bit rate, sxxyy the bit timing registers, t/T/r/R send, F reads the
status, V and N identify. The adapter reports errors on the bus without being asked: sxRRRTTT for the controller's state
x (active, warning, passive, bus-off) with its counters, eNccc for N errors. It does no I/O. (CAN232 manual, Lawicel AB;
error lines: Linux, drivers/net/can/slcan)
"""

from __future__ import annotations

from enum import Enum

from simulators.devices.can.bus import Frame

OK = b"\r"
REFUSED = b"\a"
BIT_RATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000, 83_300)
_LONGEST_COMMAND = 64
# SocketCAN error frames (linux/can/error.h): class bits and data[1] -> the adapter's line
_ERROR_LINES = {
    (0x004, 0x04): b"sw000000\r",
    (0x004, 0x10): b"sp000000\r",
    (0x004, 0x40): b"sa000000\r",
    (0x040, 0x00): b"sb000000\r",
    (0x020, 0x00): b"e1a\r",
}


class Channel(Enum):
    """State of the adapter's channel."""

    CLOSED = "closed"
    OPEN = "open"
    LISTEN_ONLY = "listen only"


class SlcanAdapter:
    """State of the adapter.

    Attributes:
        channel: state of the channel.
        refused: number of frames that the adapter refused to send.

    Args:
        bit_rate: bit rate of the bus; if the adapter is set to a different rate, it receives nothing. None accepts any
            rate.
    """

    def __init__(self, bit_rate: int | None = None) -> None:
        self.channel = Channel.CLOSED
        self.refused = 0
        self._bus_bit_rate = bit_rate
        self._bit_rate = bit_rate
        self._buffer = bytearray()

    def feed(self, data: bytes) -> tuple[bytes, list[Frame]]:
        """Process bytes from the host.

        Returns:
            The adapter's answers, and the frames to put on the bus.
        """
        answers, frames = b"", []
        for byte in data:
            if byte not in b"\r\n":
                self._buffer.append(byte)
                del self._buffer[:-_LONGEST_COMMAND]
                continue
            command = self._buffer.decode("latin-1")
            self._buffer.clear()
            if byte == 0x0A and not command:
                continue
            answer, frame = self._obey(command)
            answers += answer
            if frame is not None:
                frames.append(frame)
        return answers, frames

    def encode(self, frame: Frame) -> bytes:
        """Encode a frame on the bus for the host; empty if the channel is closed or the bit rate is wrong."""
        if self.channel is Channel.CLOSED or self._bit_rate != self._bus_bit_rate:
            return b""
        if frame.is_error:
            return _ERROR_LINES.get((frame.arbitration_id, frame.data[1]), b"")
        head = f"{frame.arbitration_id:08X}" if frame.is_extended else f"{frame.arbitration_id:03X}"
        if frame.is_remote:
            return f"{'R' if frame.is_extended else 'r'}{head}{len(frame.data)}\r".encode("ascii")
        letter = "T" if frame.is_extended else "t"
        return f"{letter}{head}{len(frame.data)}{frame.data.hex().upper()}\r".encode("ascii")

    def _obey(self, command: str) -> tuple[bytes, Frame | None]:
        letter, rest = command[:1], command[1:]
        if letter in ("t", "T", "r", "R"):
            frame = _parse_frame(letter, rest)
            if frame is None or self.channel is not Channel.OPEN or self._bit_rate != self._bus_bit_rate:
                self.refused += 1
                return REFUSED, None
            return ("z" if letter in "tr" else "Z").encode() + OK, frame
        return self._control(letter, rest), None

    def _control(self, letter: str, rest: str) -> bytes:
        closed = self.channel is Channel.CLOSED
        if letter in ("O", "L") and not rest:
            if closed:
                self.channel = Channel.OPEN if letter == "O" else Channel.LISTEN_ONLY
            return OK if closed else REFUSED
        if letter == "C" and not rest:
            self.channel = Channel.CLOSED
            return REFUSED if closed else OK
        if letter == "S" and rest.isdigit() and len(rest) == 1 and closed:
            if self._bus_bit_rate is not None:
                self._bit_rate = BIT_RATES[int(rest)]
            return OK
        if letter == "s" and len(rest) == 4 and closed:
            return OK
        # Z0: no timestamps, the only mode of this adapter. Hosts send an empty command to clear their line.
        answers = {"V": b"V1013" + OK, "N": b"NSIM1" + OK, "F": b"F00" + OK, "Z0": OK, "": OK}
        return answers.get(letter + rest, REFUSED)


def _parse_frame(letter: str, rest: str) -> Frame | None:
    width, limit = (8, 0x1FFFFFFF) if letter in "TR" else (3, 0x7FF)
    try:
        identifier, length = int(rest[:width], 16), int(rest[width : width + 1])
        data = bytes.fromhex(rest[width + 1 :]) if letter in "tT" else bytes(length)
    except ValueError:
        return None
    if len(rest[:width]) != width or identifier > limit or length > 8 or len(data) != length:
        return None
    return Frame(identifier, data, is_extended=letter in "TR", is_remote=letter in "rR")
