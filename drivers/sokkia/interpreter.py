"""What the lines of a SET station mean to the program: fixes, its identity, errors, and lines without check sums."""

from __future__ import annotations

from drivers.clock import Stamp
from drivers.readings import DeviceEvent, EventKind, Fix
from drivers.sokkia.set import ACK, NAK, carries_sum, instrument_codes, parse_identity, parse_reply
from drivers.survey import RecordError

NO_SUM = (
    "station sends its records without check sums, so that a digit changed on the line passes unseen: switch Checksum "
    "on in the instrument's communication settings"
)


class SetInterpreter:
    """Lines to records. Remembers which error codes have been reported, and whether lines carry their SUM.

    A station without SUM is warned about once, when its first line shows it. After lines with SUM a single one without
    has lost its end on the way and is refused; the next one shows that SUM was switched off.

    Args:
        station: name of the station.
    """

    def __init__(self, station: str) -> None:
        self._station = station
        self._codes: frozenset[int] = frozenset()
        self._has_sum: bool | None = None  # None: not known yet, or in doubt

    def interpret(self, data: bytes, first_byte: Stamp, last_byte: Stamp) -> list[Fix | DeviceEvent]:
        """The records of one line.

        Raises:
            RecordError: the line is neither a measurement nor an identity, or lacks the SUM that others carry.
        """
        if data == ACK:
            return []
        if data == NAK:
            return [
                DeviceEvent(self._station, first_byte, EventKind.INSTRUMENT_ERROR, "station refused a command (NAK)")
            ]
        if data.startswith(b"A "):
            text = f"station is {parse_identity(data)}"
            identity = DeviceEvent(self._station, first_byte, EventKind.CONFIGURED, text)
            return [*self._watch_sum(data, first_byte), identity]
        fix = parse_reply(data, self._station, first_byte, last_byte)
        codes = frozenset(instrument_codes(fix))
        # Whether lines with error codes carry a SUM as well is not known; they hold no digits that could be changed
        warnings = [] if codes else self._watch_sum(data, first_byte)
        new, self._codes = codes - self._codes, codes
        errors = [
            DeviceEvent(self._station, first_byte, EventKind.INSTRUMENT_ERROR, f"station reports E{code:03d}", code)
            for code in sorted(new)
        ]
        return [*warnings, *errors, fix]

    def _watch_sum(self, data: bytes, first_byte: Stamp) -> list[DeviceEvent]:
        """The warning, when this sound line is the first to show that the station sends no SUM."""
        had_sum, self._has_sum = self._has_sum, carries_sum(data)
        if self._has_sum or had_sum is False:
            return []
        if had_sum:
            self._has_sum = None
            raise RecordError("the line ends before its SUM, which the lines before it carry")
        return [DeviceEvent(self._station, first_byte, EventKind.WARNING, NO_SUM)]
