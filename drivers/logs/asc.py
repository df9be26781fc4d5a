"""Vector's text CAN log (`.asc`): a header, then frames mixed with lines about other events.

This module has its own reader because python-can's silently skips every line that it does not know, including damaged
or truncated ones, and assumes 1970 and hexadecimal numbers if the header is missing. Here each line is a frame, a known
line of another kind, or an error.

    date Fri Nov 27 11:48:03.730 am 2026               local time of second 0
    base hex  timestamps absolute                      number base of identifiers, lengths and data
    Begin Triggerblock Fri Nov 27 11:51:33.000 2026    local time of second 0 from here on
       0.057767 1  1BC             Rx   d 2 0B 05      second, channel, identifier (with x: 29 bits), direction, data
       0.104574 2  730x            Tx   r
       2.501000 1  ErrorFrame
    End TriggerBlock
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterable, Iterator
from itertools import takewhile

import can

from drivers.can.frame import DATA_MAX

_EXAMPLE = "0.057767 1  1BC  Rx  d 2 0B 05"

_DATE = re.compile(r"date\s+(?P<date>.+)", re.IGNORECASE)
_BEGIN = re.compile(r"begin\s+triggerblock(?:\s+(?P<date>.+))?", re.IGNORECASE)
_BASE = re.compile(r"base\s+(?P<base>hex|dec)(?:\s+timestamps\s+(?P<timestamps>absolute|relative))?", re.IGNORECASE)
_INSTANT = re.compile(
    r"(?:\w+\.?\s+)?(?P<month>[^\W\d]{3})\w*\.?\s+(?P<day>\d{1,2})\s+"
    r"(?P<hour>\d{1,2}):(?P<minute>\d{1,2}):(?P<second>\d{1,2})(?:\.(?P<fraction>\d{1,6})\d*)?"
    r"(?:\s+(?P<half>am|pm))?\s+(?P<year>\d{4})",
    re.IGNORECASE,
)
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_GERMAN_MONTHS = {"mär": "mar", "mai": "may", "okt": "oct", "dez": "dec"}

_UNTIMED = re.compile(r"//.*|;.*|(?:no\s+)?internal\s+events\s+logged|end\s+triggerblock", re.IGNORECASE)
_TIMED = re.compile(r"(?P<seconds>\d{1,15}\.\d{1,15})\s+(?P<event>.+)", re.ASCII)
_FRAME = re.compile(
    r"(?P<channel>\d{1,3})\s+(?P<identifier>\w+?)(?P<extended>x?)\s+(?P<direction>Rx|Tx)\s+"
    r"(?:(?P<remote>r)(?:\s.*)?|d\s+(?P<length>\w+)(?:\s+(?P<data>.*))?)",
    re.ASCII | re.IGNORECASE,
)
_ERROR = re.compile(r"(?P<channel>\d{1,3})\s+ErrorFrame(?:\s.*)?", re.ASCII | re.IGNORECASE)
_FD = re.compile(r"CANFD\s+\d{1,3}\s+(?:Rx|Tx)\s.*", re.ASCII | re.IGNORECASE)
_EVENT = re.compile(
    r"Start of measurement|//.*|Comment:.*|log (?:trigger|direct) .*"
    r"|\d{1,3}\s+(?:Statistic:|J1939TP\s|OverloadFrame\b|\w+\s+TxRq\s).*"
    r"|CAN(?:FD)?\s+\d{1,3}\s+(?:Status:|Statistic:|OverloadFrame\b).*"
    r"|(?:Li|L\d+|LIN|Fr|ETH|AFDX|WLAN|MOST|M\d+)\s.*"  # other buses
    r"|(?:CAN|LIN|FlexRay)\s+\d{1,3}\s+\S+\s=\s.*|\S+\s:=.*|SV:.*"  # signals and variables
    r"|GPS\s.*|TFS:.*|.*\bGMGroup:.*",  # positions, test steps, markers
    re.ASCII | re.IGNORECASE,
)
_DIGITS = {16: re.compile(r"[0-9A-F]+", re.IGNORECASE), 10: re.compile(r"[0-9]+")}
_BYTES = {16: re.compile(r"[0-9A-F]{2}", re.IGNORECASE), 10: re.compile(r"[01]?[0-9]?[0-9]|2[0-4][0-9]|25[0-5]")}
_BASE_NAMES = {16: "hexadecimal", 10: "decimal"}
_LONGEST_CODE = 15  # largest length code; classic frames with codes above 8 have 8 bytes


class AscReader:
    """Reader of a log; iterate over it to get the frames as python-can messages.

    Args:
        lines: lines of the file, including line ends.

    Attributes:
        line: number of the line read last.
    """

    def __init__(self, lines: Iterable[str]) -> None:
        self.line = 0
        self._lines = lines
        self._base: int | None = None
        self._start_s: float | None = None

    def __iter__(self) -> Iterator[can.Message]:
        """Yield the frames in order; raise ValueError at the first invalid line, whose number is `line`."""
        for text in self._lines:
            self.line += 1
            line = text.strip()
            if timed := _TIMED.fullmatch(line):
                frame = self._frame(float(timed["seconds"]), timed["event"], line, is_ended=text.endswith("\n"))
                if frame is not None:
                    yield frame
            elif line and not self._is_header(line) and not _UNTIMED.fullmatch(line):
                raise _unknown(line)

    def _is_header(self, line: str) -> bool:
        """Process a header line, which applies to all lines after it; return False if it is not one."""
        if date := _DATE.fullmatch(line) or _BEGIN.fullmatch(line):
            if date["date"] is not None:
                self._start_s = _local_time_s(date["date"])
        elif base := _BASE.fullmatch(line):
            if (base["timestamps"] or "").lower() == "relative":
                raise ValueError("relative timestamps are not supported; save the log with absolute timestamps")
            self._base = 16 if base["base"].lower() == "hex" else 10
        else:
            return False
        return True

    def _frame(self, seconds: float, event: str, line: str, *, is_ended: bool) -> can.Message | None:
        if error := _ERROR.fullmatch(event):
            return can.Message(self._utc_s(seconds), is_error_frame=True, channel=int(error["channel"]) - 1)
        if _FD.fullmatch(event):
            raise ValueError(f"CAN FD frames are not supported: {line[:80]!r}")
        match = _FRAME.fullmatch(event)
        if match is None:
            if _EVENT.fullmatch(event):
                return None
            raise _unknown(line)
        base = self._base
        if base is None:
            raise ValueError(
                "there is no line 'base hex' or 'base dec' before this frame, so the base of its numbers is unknown; "
                "restore the missing beginning of the file"
            )
        if base == 10 and not is_ended:
            raise ValueError(f"the last line has no line end, so its last number may be truncated: {line[:80]!r}")
        data, length = b"", 0
        if match["remote"] is None:
            data, length = _data(match["length"], match["data"] or "", base, line)
        return can.Message(
            timestamp=self._utc_s(seconds),
            arbitration_id=_number(match["identifier"], "identifier", base, line),
            is_extended_id=bool(match["extended"]),
            is_remote_frame=match["remote"] is not None,
            is_rx=match["direction"].lower() == "rx",
            dlc=length,
            data=data,
            channel=int(match["channel"]) - 1,
        )

    def _utc_s(self, seconds: float) -> float:
        if self._start_s is None:
            raise ValueError(
                "there is no line 'date ...' or 'Begin Triggerblock ...' before this frame, so its time is unknown; "
                "restore the missing beginning of the file"
            )
        return self._start_s + seconds


def _data(code: str, text: str, base: int, line: str) -> tuple[bytes, int]:
    """Return a frame's bytes and the length from its length code; other words may follow the bytes."""
    length = _number(code, "length", base, line)
    if length > _LONGEST_CODE:
        raise ValueError(f"{code} is not a valid frame length: {line[:80]!r}")
    length = min(length, DATA_MAX)
    numbers = [int(word, base) for word in takewhile(_BYTES[base].fullmatch, text.split())]
    if len(numbers) != length:
        raise ValueError(f"the frame has {len(numbers)} bytes, but its length is given as {length}: {line[:80]!r}")
    return bytes(numbers), length


def _number(word: str, what: str, base: int, line: str) -> int:
    if _DIGITS[base].fullmatch(word) is None:
        raise ValueError(f"{what} {word!r} is not a {_BASE_NAMES[base]} number: {line[:80]!r}")
    return int(word, base)


def _unknown(line: str) -> ValueError:
    return ValueError(
        f"not a line of an ASC log such as {_EXAMPLE}: {line[:80]!r}; it is damaged, truncated or of an unknown kind: "
        "remove it to read the other lines"
    )


def _local_time_s(text: str) -> float:
    """Return UTC in seconds of a local time, independent of this computer's language setting."""
    match = _INSTANT.fullmatch(text.strip())
    try:
        if match is None:
            raise ValueError
        name = match["month"].lower()
        hour = int(match["hour"])
        if match["half"]:
            if not 1 <= hour <= 12:
                raise ValueError
            hour = hour % 12 + (12 if match["half"].lower() == "pm" else 0)
        return datetime.datetime(
            int(match["year"]),
            _MONTHS.index(_GERMAN_MONTHS.get(name, name)) + 1,
            int(match["day"]),
            hour,
            int(match["minute"]),
            int(match["second"]),
            int((match["fraction"] or "").ljust(6, "0")),
        ).timestamp()
    except (ValueError, OverflowError, OSError):
        raise ValueError(f"not a date such as Fri Nov 27 11:48:03.730 2026: {text[:80]!r}") from None
