"""What the lines of a SET station mean to the program: fixes, its identity, and errors that it reports."""

from __future__ import annotations

from drivers.clock import Stamp
from drivers.readings import DeviceEvent, EventKind, Fix
from drivers.sokkia.set import ACK, NAK, instrument_codes, parse_identity, parse_reply


class SetInterpreter:
    """Lines to records. Remembers only which error codes have been reported already.

    Args:
        station: name of the station.
    """

    def __init__(self, station: str) -> None:
        self._station = station
        self._codes: frozenset[int] = frozenset()

    def interpret(self, data: bytes, first_byte: Stamp, last_byte: Stamp) -> list[Fix | DeviceEvent]:
        """The records of one line.

        Raises:
            RecordError: the line is neither a measurement nor an identity.
        """
        if data == ACK:
            return []
        if data == NAK:
            return [
                DeviceEvent(self._station, first_byte, EventKind.INSTRUMENT_ERROR, "station refused a command (NAK)")
            ]
        if data.startswith(b"A "):
            text = f"station is {parse_identity(data)}"
            return [DeviceEvent(self._station, first_byte, EventKind.CONFIGURED, text)]
        fix = parse_reply(data, self._station, first_byte, last_byte)
        codes = frozenset(instrument_codes(fix))
        new, self._codes = codes - self._codes, codes
        errors = [
            DeviceEvent(self._station, first_byte, EventKind.INSTRUMENT_ERROR, f"station reports E{code:03d}", code)
            for code in sorted(new)
        ]
        return [*errors, fix]
