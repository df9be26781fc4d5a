"""DBC files: cantools reads them, a `SignalChannel` comes out. See `raw_signal` for the decoding."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import cantools.database
from cantools.database.can import Database, Message, Signal
from cantools.database.errors import Error as CantoolsError

from drivers.canframe import DATA_MAX
from drivers.dbc_sizes import check_sizes
from drivers.errors import DescriptionError
from drivers.files import read_whole
from drivers.raw_signal import BitField, Multiplexing, SignalChannel

_FILE_MAX_BYTES = 2 << 20  # cantools takes more than a second for a megabyte

_COUNTER_NAME = re.compile(r"counter|alive", re.IGNORECASE)
_NO_VALUE_TEXT = re.compile(r"^(sna|(signal )?not available|invalid)$", re.IGNORECASE)


class DbcFile:
    """A DBC file.

    Args:
        path: the file, in Windows' western character set, as DBC files are.

    Raises:
        DescriptionError: it cannot be read or is malformed; the message gives line and column, or the signal.
    """

    def __init__(self, path: Path) -> None:
        self._where = str(path)
        try:
            text = read_whole(path, _FILE_MAX_BYTES).decode("cp1252", errors="replace")
            check_sizes(text, self._where)
            database = cantools.database.load_string(text, database_format="dbc")
        except OSError as error:
            raise DescriptionError(self._where, f"cannot be read: {error.strerror}") from error
        # Beside its own errors, what cantools lets through from parsing numbers and names
        except (CantoolsError, ArithmeticError, LookupError, RecursionError, TypeError, ValueError) as error:
            raise DescriptionError(self._where, f"not a valid DBC file: {' '.join(str(error).split())}") from error
        assert isinstance(database, Database)  # database_format="dbc" gives no other
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
        counter: str | None = None,
    ) -> SignalChannel:
        """The channel that a signal of this file is.

        "No value" is what the file itself names so (SNA, not available, invalid), FEh and FFh in the most significant
        byte for 29-bit identifiers (J1939-71), and all ones in unsigned signals of 8 bits and more for 11-bit ones.

        Args:
            name, unit, timeout_s: see SignalChannel.
            message, signal: names in the file.
            scale, offset: from the file's physical value to `unit`.
            counter: the signal that counts the message's frames; by default the one with "counter" or "alive" in its
                name, if there is exactly one.

        Raises:
            DescriptionError: no such message or signal, or one that no classic CAN frame can carry.
        """
        try:
            declared = self._declared(message, signal, counter)
        except (ArithmeticError, LookupError, ValueError) as error:
            raise DescriptionError(self._where, f"signal {signal!r} cannot be read: {error}") from error
        return dataclasses.replace(declared, name=name, unit=unit, scale=scale, offset=offset, timeout_s=timeout_s)

    def _declared(self, message: str, signal: str, counter: str | None) -> SignalChannel:
        """The channel as far as the file tells; numbers may be beyond what can be computed with."""
        found = self._message(message)
        signals: dict[str, Signal] = {item.name: item for item in found.signals}
        wanted = self._signal(signals, message, signal)
        is_extended = bool(found.is_extended_frame)
        if not (math.isfinite(wanted.scale) and wanted.scale != 0 and math.isfinite(wanted.offset)):
            raise DescriptionError(
                self._where, f"signal {signal!r}: factor {wanted.scale} and offset {wanted.offset} make no value"
            )
        return SignalChannel(
            name=signal,
            unit="",
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
            counter=self._counter(signals, message, signal, counter),
            multiplexing=self._multiplexing(signals, wanted),
        )

    def _message(self, name: str) -> Message:
        try:
            message = self._database.get_message_by_name(name)
        except KeyError:
            known = ", ".join(sorted(item.name for item in self._database.messages)) or "none"
            raise DescriptionError(self._where, f"has no message {name!r}; messages: {known}") from None
        if message.is_fd or message.length > DATA_MAX:
            raise DescriptionError(self._where, f"message {name!r} has {message.length} bytes, a CAN frame has 8")
        return message

    def _signal(self, signals: dict[str, Signal], message: str, name: str) -> Signal:
        if name not in signals:
            known = ", ".join(sorted(signals)) or "none"
            raise DescriptionError(self._where, f"message {message!r} has no signal {name!r}; signals: {known}")
        return signals[name]

    def _counter(self, signals: dict[str, Signal], message: str, signal: str, name: str | None) -> BitField | None:
        if name is not None:
            return _field(self._signal(signals, message, name))
        counters = [
            item
            for item in signals.values()
            if _COUNTER_NAME.search(item.name) and item.name != signal and not item.multiplexer_ids
        ]
        return _field(counters[0]) if len(counters) == 1 else None

    def _multiplexing(self, signals: dict[str, Signal], signal: Signal) -> Multiplexing | None:
        if not signal.multiplexer_ids or signal.multiplexer_signal is None:
            return None
        selector = signals[signal.multiplexer_signal]
        if selector.multiplexer_ids:
            raise DescriptionError(
                self._where, f"signal {signal.name!r}: a multiplexer behind a multiplexer is not supported"
            )
        return Multiplexing(_field(selector), frozenset(signal.multiplexer_ids))


def _plain(text: object) -> str:
    return re.sub(r"[_\s]+", " ", str(text)).strip()


def _field(signal: Signal) -> BitField:
    # cantools has made sure that it lies in its message
    is_signed = signal.is_signed and not signal.is_float
    if signal.byte_order == "little_endian":
        return BitField(signal.start, signal.length, "intel", is_signed)
    return BitField(signal.start, signal.length, "motorola", is_signed)
