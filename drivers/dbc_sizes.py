"""What a DBC file asks of cantools' time and memory, told from its text before cantools reads it.

cantools lists a message's bits for each of its signals, and every number in a multiplexer's range: a few digits in a
file of a kilobyte can take minutes and gigabytes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from drivers.errors import DescriptionError

_MESSAGE_MAX_BYTES = 1785  # of J1939's transport protocol
# cantools takes a second or two for each of these
_WORDS_MAX = 600_000
_MESSAGES_MAX = 20_000
_NODES_MAX = 10_000
_BIT_CHECKS_MAX = 500_000_000
_BRANCH_CHECKS_MAX = 5_000_000

_STRING = re.compile(r'"(?:[^"\\]|\\.)*"', re.DOTALL)
_WORD = re.compile(r"\w+|[^\s\w]")
_NODES = re.compile(r"\bBU_\s*:((?:\s+(?!BU_\s*:)\w+)*)")
_BEYOND = re.compile(r"(?<![\w.])[\d.]+[eE][+-]?\d{4,}")
_MESSAGE = r"\bBO_\s+(?P<id>\d+)\s+(?P<message>\w+)\s*:\s*(?P<bytes>\w+)"
_SIGNAL = r"\bSG_\s+(?P<signal>\w+)(?:\s+(?P<mux>\w+))?\s*:\s*(?P<start>\d+)\s*\|\s*(?P<bits>\d+)"
_RANGES = re.compile(r"\bSG_MUL_VAL_\s+(?P<of>\d+)\s+(?P<multiplexed>\w+)\s+\w+(?P<ranges>[\s\d,-]*)")
_VALUES = re.compile(r"\bVAL_\s+(?P<of>\d+)\s+\w+(?P<named>[^;]*)")
_SIZES = re.compile(f"{_MESSAGE}|{_SIGNAL}")
_RANGE = re.compile(r"(\d+)\s*-\s*(\d+)")
_NESTED = re.compile(r"m\d+M")


@dataclass
class _Size:
    """What cantools has to look at to check one message.

    Attributes:
        length_bytes: as the file says.
        signals: how many it has.
        values: how many values its multiplexers may have.
        nested: multiplexers behind multiplexers.
        repeats: how often these are looked at, for the values of those before them.
    """

    length_bytes: int = 0
    signals: int = 0
    values: int = 1
    nested: set[str] = field(default_factory=set)
    repeats: int = 1

    @property
    def bit_checks(self) -> int:
        """Bits that are written down: the square of the length for each signal."""
        return self.signals * self.length_bytes**2

    @property
    def branch_checks(self) -> int:
        """Signals and bytes that are looked at, over all ways through the multiplexers."""
        return self.values * self.repeats * (self.signals + self.length_bytes) if self.values > 1 else 0


def check_sizes(text: str, where: str) -> None:
    """Refuse a file that cantools would need too much time or memory for.

    Args:
        text: the file's.
        where: its name, for messages.

    Raises:
        DescriptionError: it would; the message names the message or signal where it is one.
    """
    text = _STRING.sub('""', text)
    beyond = _BEYOND.search(text)
    if beyond is not None:
        raise DescriptionError(where, f"{beyond[0][:40]} is beyond what a number can be")
    sizes: dict[str, _Size] = {}
    size = _Size()
    for found in _SIZES.finditer(text):
        if found["message"]:
            size = sizes.setdefault(found["id"], _Size())
            size.length_bytes = max(size.length_bytes, _message_bytes(found, where))
        elif found["signal"]:
            _add_signal(size, found, where)
    for found in _VALUES.finditer(text):
        sizes.setdefault(found["of"], _Size()).values += found["named"].count('""')
    for found in _RANGES.finditer(text):
        _add_ranges(sizes.setdefault(found["of"], _Size()), found, where)
    words = sum(1 for _ in _WORD.finditer(text))
    nodes = sum(len(found[1].split()) for found in _NODES.finditer(text))
    bit_checks = sum(each.bit_checks for each in sizes.values())
    branch_checks = sum(each.branch_checks for each in sizes.values())
    if (
        words > _WORDS_MAX
        or len(sizes) > _MESSAGES_MAX
        or nodes > _NODES_MAX
        or bit_checks > _BIT_CHECKS_MAX
        or branch_checks > _BRANCH_CHECKS_MAX
    ):
        raise DescriptionError(
            where,
            "it describes too much to be read in time; keep the messages that the rig needs in a file of their own",
        )


def _message_bytes(found: re.Match[str], where: str) -> int:
    length = found["bytes"]
    if not (length.isdecimal() and len(length) < 6 and int(length) <= _MESSAGE_MAX_BYTES):
        raise DescriptionError(
            where,
            f"message {found['message']!r} has {length[:20]} bytes; the longest has {_MESSAGE_MAX_BYTES}",
        )
    return int(length)


def _add_signal(size: _Size, found: re.Match[str], where: str) -> None:
    if max(len(found["start"]), len(found["bits"])) > 5:
        raise DescriptionError(where, f"signal {found['signal']!r} does not fit in its message")
    size.signals += 1
    if found["mux"]:
        size.values += 1
        if _NESTED.fullmatch(found["mux"]):
            size.nested.add(found["signal"])


def _add_ranges(size: _Size, found: re.Match[str], where: str) -> None:
    ranges = _RANGE.findall(found["ranges"])
    count = sum(max(0, int(high[:20]) - int(low[:20]) + 1) for low, high in ranges)
    size.values += count
    if found["multiplexed"] in size.nested:
        size.repeats *= max(1, count)
    if size.branch_checks > _BRANCH_CHECKS_MAX:
        raise DescriptionError(
            where, f"signal {found['multiplexed']!r}: its multiplexers (SG_MUL_VAL_) have too many values"
        )
