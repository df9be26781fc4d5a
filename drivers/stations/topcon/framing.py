"""Frames of the Topcon GTS protocol: data, three decimal digits of block check, ETX.

    frame = DATA + BCC + ETX [+ CR LF]      BCC = XOR of every byte of DATA, as exactly three decimal digits

There is no start character, so a framer synchronizes on ETX, the known header characters and the BCC. It tolerates line
faults that instruments and adapters are known to produce: an acknowledgement joined to the record that follows it, its
06h lost or followed by a space, a lost ETX, CR LF or no line end, garbage before a record. Remaining bytes are returned
as garbage, and their meaning is never guessed.
"""

from __future__ import annotations

import re
from functools import reduce
from operator import xor

from drivers.stations.replies import ACK, Frame, Framer, Garbage

ETX = b"\x03"
CRLF = b"\r\n"

# ? slope distance 1 mm, ( slope distance 0.1 mm, < angles, U / coordinates, Q GTS-8 family, E instrument error.
RECORD_HEADERS = b"?(<U/QE"

LONGEST_FRAME = 128  # the longest record has 59 characters before ETX
_BUFFER_LIMIT = 2 * LONGEST_FRAME

_FRAME = re.compile(rb"(?P<data>[\x06\x15]|[ -~]+)(?P<bcc>\d{3})", re.DOTALL)
_ACK_TAIL = re.compile(rb"\x06 ?006\Z")  # some stations send a space after 06h
_BARE_ACK = re.compile(rb" ?006\Z")  # 06h was lost


def block_check(data: bytes) -> bytes:
    """Return the BCC of `data`: the XOR of its bytes as three decimal digits."""
    return b"%03d" % reduce(xor, data, 0)


def encode_frame(data: bytes, crlf: bool) -> bytes:
    """Return `data` as a frame.

    Args:
        data: command or record, ASCII.
        crlf: add CR LF after ETX.
    """
    return data + block_check(data) + ETX + (CRLF if crlf else b"")


def decode_frame(segment: bytes) -> bytes | None:
    """Return the data of `segment` (the bytes before ETX); None unless it is a frame with a correct BCC."""
    match = _FRAME.fullmatch(segment)
    return match["data"] if match is not None and block_check(match["data"]) == match["bcc"] else None


class GtsFramer(Framer):
    """Splits a station's bytes into frames. Holds at most 256 bytes."""

    def feed(self, data: bytes) -> list[Frame | Garbage]:
        found: list[Frame | Garbage] = []
        for byte in data:
            if not self._buffer and byte in CRLF:
                self._start += 1  # line end after ETX
                continue
            self._buffer.append(byte)
            if byte == ETX[0]:
                found += _resolve(bytes(self._buffer), self._start)
                self._drop(len(self._buffer))
            elif len(self._buffer) == _BUFFER_LIMIT:
                found.append(self._give_up(LONGEST_FRAME, f"no ETX within {_BUFFER_LIMIT} bytes"))
        return found


def _resolve(segment: bytes, start: int) -> list[Frame | Garbage]:
    """Return the frames and garbage of a segment that ends with ETX, searched from its end backwards."""
    found: list[Frame | Garbage] = []
    end = start + len(segment) - 1
    rest = segment[:-1]
    while split := _last_frame(rest):
        at, data = split
        found.append(Frame(data, start + at, end))
        # Bytes before the frame are a frame that lost its ETX, or garbage
        rest = rest[:at].rstrip(CRLF)
        end = start + len(rest) - 1
    if rest:
        found.append(Garbage(rest, _why_no_frame(rest), start, end))
    elif not found:
        found.append(Garbage(segment, "ETX without a frame before it", start, end))
    return found[::-1]


def _last_frame(rest: bytes) -> tuple[int, bytes] | None:
    """Return the start and the data of the frame at the end of `rest`; None if there is none."""
    if _BARE_ACK.fullmatch(rest):
        return 0, ACK
    acknowledged = _ACK_TAIL.search(rest)
    if acknowledged is not None:
        return acknowledged.start(), ACK
    # Records first, because an XOR of seven bits accepts one in 128 pieces of garbage as the beginning of a frame
    for at in [*(at for at, byte in enumerate(rest) if byte in RECORD_HEADERS), 0]:
        data = decode_frame(rest[at:])
        if data is not None:
            return at, data
    return None


def _why_no_frame(rest: bytes) -> str:
    match = _FRAME.fullmatch(rest)
    if match is None:
        return "not a frame: expected printable data and three digits of BCC before ETX"
    return f"BCC is {match['bcc'].decode()}, computed {block_check(match['data']).decode()}"
