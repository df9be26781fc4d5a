"""DBC files, parsed by cantools into `SignalChannel`s. See `raw_signal` for the decoding."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import re
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

import cantools.database
from cantools.database.can import Database, Message, Signal
from cantools.database.errors import Error as CantoolsError

from drivers.can.frame import DATA_MAX
from drivers.can.raw_signal import BitField, Multiplexing, SignalChannel
from drivers.errors import DescriptionError
from drivers.files import read_whole

_FILE_MAX_BYTES = 2 << 20  # cantools needs more than a second per megabyte

_COUNTER_NAME = re.compile(r"counter|alive", re.IGNORECASE)
_NO_VALUE_TEXT = re.compile(r"^(sna|(signal )?not available|invalid)$", re.IGNORECASE)

_UNIT_SHOWN, _NUMBERS_SHOWN = 20, 8  # characters; numbers

_MESSAGE_MAX_BYTES = 1785  # limit of J1939's transport protocol
# cantools needs one or two seconds at each of these limits
_WORDS_MAX = 400_000
_MESSAGES_MAX = 10_000
_NODES_MAX = 10_000
_BIT_CHECKS_MAX = 300_000_000
_BRANCH_CHECKS_MAX = 300_000

# Splits the text as cantools does, so that nothing escapes the checks: comment, string, signed number, word, mark
_TOKEN = re.compile(r'//[^\n]*|"(?:\\"|[^"])*?"|[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?|[A-Za-z0-9_]+|\S')
_WORD = re.compile(r"\w+|[^\s\w]")
_NODES = re.compile(r"\bBU_\s*:((?:\s+(?!BU_\s*:)\w+)*)")
_BEYOND = re.compile(r"(?<![\w.])[\d.]+[eE][+-]?\d{4,}")
_INTEGER = r"[-+]?\d+"
_MESSAGE = rf"\bBO_\s+(?P<id>{_INTEGER})\s+(?P<message>\w+)\s*:\s*(?P<bytes>[-+]?\w+)"
_SIGNAL = (
    r"\bSG_\s+(?P<signal>\w+)(?:\s+(?P<mux>\w+))?\s*:"
    rf"\s*(?P<start>{_INTEGER})\s*\|\s*(?P<bits>{_INTEGER})"
)
_RANGES = re.compile(rf"\bSG_MUL_VAL_\s+(?P<of>{_INTEGER})\s+(?P<multiplexed>\w+)\s+\w+(?P<ranges>[\s\d,+-]*)")
_VALUES = re.compile(rf"\bVAL_\s+(?P<of>{_INTEGER})\s+\w+(?P<named>[^;]*)")
_SIZES = re.compile(f"{_MESSAGE}|{_SIGNAL}")
_RANGE = re.compile(rf"({_INTEGER}) [-+]?(\d+)")
_NESTED = re.compile(r"m\d+M")


class DbcFile:
    """A DBC file.

    Args:
        path: the file, encoded in Windows-1252 as is usual for DBC files.

    Raises:
        DescriptionError: the file cannot be read or is malformed; the message gives line and column, or the signal.
    """

    def __init__(self, path: Path) -> None:
        self._where = str(path)
        try:
            text = read_whole(path, _FILE_MAX_BYTES).decode("cp1252", errors="replace")
            _check_sizes(text, self._where)
            database = cantools.database.load_string(text, database_format="dbc")
        except OSError as error:
            raise DescriptionError(self._where, f"cannot be read: {error.strerror}") from error
        # CantoolsError, and the exceptions that cantools lets escape when it parses numbers and names
        except (CantoolsError, ArithmeticError, LookupError, RecursionError, TypeError, ValueError) as error:
            raise DescriptionError(self._where, f"not a valid DBC file: {' '.join(str(error).split())}") from error
        assert isinstance(database, Database)  # the only type that database_format="dbc" returns
        self._database = database

    def channel(
        self,
        name: str,
        unit: str,
        message: str,
        signal: str,
        *,
        scale: float = 1.0,
        offset: float = 0.0,
        timeout_s: float = 1.0,
    ) -> SignalChannel:
        """Return the channel of a signal.

        These values mean "no value": values that the file names SNA, not available or invalid; for 29-bit identifiers
        FEh and FFh in the most significant byte (J1939-71); for 11-bit identifiers all ones in unsigned signals of 8
        bits and more. The message counter is the signal with "counter" or "alive" in its name, if there is exactly one.

        Args:
            name: name of the channel.
            unit: unit of its values.
            message: name of the message in the file.
            signal: name of the signal in the file.
            scale: factor from the file's physical value to `unit`.
            offset: added after `scale`, in `unit`.
            timeout_s: silence longer than this is a gap.

        Raises:
            DescriptionError: the message or signal does not exist, or does not fit in a classic CAN frame.
        """
        declared = self._declared(message, signal)
        return dataclasses.replace(declared, name=name, unit=unit, scale=scale, offset=offset, timeout_s=timeout_s)

    def decoding(self, message: str, signal: str) -> str:
        """Return one line that describes how a signal's bits become its value.

        The line is the same for all files that decode the same values from the same frames, whatever else they contain.
        Range and message counter are left out: they only cause gaps and do not change values.

        Args:
            message: name of the message in the file.
            signal: name of the signal in the file.

        Raises:
            DescriptionError: see `channel`.
        """
        found = self._declared(message, signal)
        frame = f"{found.arbitration_id:08X}h" if found.is_extended else f"{found.arbitration_id:03X}h"
        value = f"{found.factor!r} * {'float' if found.is_float else 'integer'} + {found.summand!r}"
        parts = [f"frame {frame}", _place(found.field), f"{value} {found.unit[:_UNIT_SHOWN]}".rstrip()]
        if found.not_available:
            parts.append(f"no value {_listed(found.not_available)}")
        if found.multiplexing is not None:
            parts.append(f"where {_place(found.multiplexing.selector)} are {_listed(found.multiplexing.values)}")
        return ", ".join(parts)

    def _declared(self, message: str, signal: str) -> SignalChannel:
        """Return the channel that the file declares; DescriptionError if its numbers are too large."""
        try:
            return self._read(message, signal)
        except (ArithmeticError, LookupError, ValueError) as error:
            raise DescriptionError(self._where, f"signal {signal!r} cannot be read: {error}") from error

    def _read(self, message: str, signal: str) -> SignalChannel:
        """Return the channel that the file declares; an arithmetic error escapes if its numbers are too large."""
        found = self._message(message)
        signals: dict[str, Signal] = {item.name: item for item in found.signals}
        if signal not in signals:
            known = ", ".join(sorted(signals)) or "none"
            raise DescriptionError(self._where, f"message {message!r} has no signal {signal!r}; signals: {known}")
        wanted = signals[signal]
        is_extended = bool(found.is_extended_frame)
        if not (math.isfinite(wanted.scale) and wanted.scale != 0 and math.isfinite(wanted.offset)):
            raise DescriptionError(
                self._where, f"signal {signal!r}: factor {wanted.scale} and offset {wanted.offset} are not usable"
            )
        return SignalChannel(
            name=signal,
            unit=wanted.unit or "",
            arbitration_id=found.frame_id,
            is_extended=is_extended,
            field=_field(wanted),
            is_float=wanted.is_float,
            factor=float(wanted.scale),
            summand=float(wanted.offset),
            minimum=None if wanted.minimum is None else float(wanted.minimum),
            maximum=None if wanted.maximum is None else float(wanted.maximum),
            not_available=frozenset(
                int(number) for number, text in (wanted.choices or {}).items() if _NO_VALUE_TEXT.match(_plain(text))
            ),
            all_ones_is_not_available=not is_extended,
            is_j1939=is_extended,
            counter=_counter(signals, signal),
            multiplexing=self._multiplexing(signals, wanted),
        )

    def _message(self, name: str) -> Message:
        try:
            message = self._database.get_message_by_name(name)
        except KeyError:
            known = ", ".join(sorted(item.name for item in self._database.messages)) or "none"
            raise DescriptionError(self._where, f"has no message {name!r}; messages: {known}") from None
        if message.is_fd or message.length > DATA_MAX:
            raise DescriptionError(self._where, f"message {name!r} has {message.length} bytes; a CAN frame has 8")
        return message

    def _multiplexing(self, signals: dict[str, Signal], signal: Signal) -> Multiplexing | None:
        if not signal.multiplexer_ids or signal.multiplexer_signal is None:
            return None
        selector = signals[signal.multiplexer_signal]
        if selector.multiplexer_ids:
            raise DescriptionError(self._where, f"signal {signal.name!r}: nested multiplexers are not supported")
        return Multiplexing(_field(selector), frozenset(signal.multiplexer_ids))


def _counter(signals: dict[str, Signal], signal: str) -> BitField | None:
    counters = [
        item
        for item in signals.values()
        if _COUNTER_NAME.search(item.name) and item.name != signal and not item.multiplexer_ids
    ]
    return _field(counters[0]) if len(counters) == 1 else None


def _place(field: BitField) -> str:
    sign = "signed" if field.is_signed else "unsigned"
    return f"{field.length_bits} {sign} bits from {field.byte_order} bit {field.start_bit}"


def _listed(numbers: Collection[int]) -> str:
    """Return numbers as one line; if there are many, their count and a digest that identifies the set."""
    text = " ".join(map(str, sorted(numbers)))
    if len(numbers) <= _NUMBERS_SHOWN:
        return text
    return f"{len(numbers)} numbers (SHA-256 {hashlib.sha256(text.encode()).hexdigest()[:16]})"


def _plain(text: object) -> str:
    return re.sub(r"[_\s]+", " ", str(text)).strip()


def _field(signal: Signal) -> BitField:
    # cantools has checked that the signal lies within its message
    is_signed = signal.is_signed and not signal.is_float
    if signal.byte_order == "little_endian":
        return BitField(signal.start, signal.length, "intel", is_signed)
    return BitField(signal.start, signal.length, "motorola", is_signed)


@dataclass
class _Size:
    """Quantities that determine how much work cantools needs to check one message.

    Attributes:
        length_bytes: length that the file declares.
        signals: number of its signals.
        values: number of values that its multiplexers may have.
        named: number of named values of its signals, including those of multiplexers.
        nested: names of the multiplexers that are themselves multiplexed.
        repeats: how often cantools checks the nested multiplexers: once for each value of the outer ones.
    """

    length_bytes: int = 0
    signals: int = 0
    values: int = 1
    named: int = 0
    nested: set[str] = field(default_factory=set)
    repeats: int = 1

    @property
    def bit_checks(self) -> int:
        """Number of bits that cantools writes: for each signal the square of the length."""
        return self.signals * self.length_bytes**2

    @property
    def branch_checks(self) -> int:
        """Number of signals and bytes that cantools checks, over all combinations of multiplexer values."""
        each = self.repeats * max(1, self.signals + self.length_bytes)
        return (self.values + self.named) * each if self.values > 1 else 0


def _check_sizes(text: str, where: str) -> None:
    """Refuse a file for which cantools would need too much time or memory.

    Args:
        text: content of the file.
        where: name of the file, for error messages.

    Raises:
        DescriptionError: the file is refused; the text names the message or signal if a single one is the cause.
    """
    tokens = (found[0] for found in _TOKEN.finditer(text) if not found[0].startswith("//"))
    text = " ".join('""' if token[0] == '"' else token for token in tokens)
    beyond = _BEYOND.search(text)
    if beyond is not None:
        raise DescriptionError(where, f"the number {beyond[0][:40]} is too large or too small")
    sizes: dict[str, _Size] = {}
    size = _Size()
    for found in _SIZES.finditer(text):
        if found["message"]:
            size = sizes.setdefault(found["id"], _Size())
            size.length_bytes = max(size.length_bytes, _message_bytes(found, where))
        elif found["signal"]:
            _add_signal(size, found, where)
    for found in _VALUES.finditer(text):
        sizes.setdefault(found["of"], _Size()).named += found["named"].count('""')
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
            "the file is too large to be read in time; keep only the messages that the rig needs in a separate file",
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
