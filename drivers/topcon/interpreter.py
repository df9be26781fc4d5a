"""What the frames of a Topcon station mean to the program: fixes, and errors that the instrument reports."""

from __future__ import annotations

from drivers.clock import Stamp
from drivers.readings import DeviceEvent, EventKind, Fix, LockState
from drivers.topcon.codec import ACK, NAK
from drivers.topcon.records import CorrectionScales, parse_record


class GtsInterpreter:
    """Frames to records. Remembers only whether an error has been reported already.

    Args:
        station: name of the station.
        scales: units of the corrections in its records.
    """

    def __init__(self, station: str, scales: CorrectionScales) -> None:
        self._station = station
        self._scales = scales
        self._in_error = False

    def interpret(self, data: bytes, first_byte: Stamp, last_byte: Stamp) -> list[Fix | DeviceEvent]:
        """The records of one frame.

        Raises:
            RecordError: the frame's data are no known record.
        """
        if data == ACK:
            return []
        if data == NAK:
            return [self._error(first_byte, "station refused a command (NAK)")]
        if data.startswith(b"E"):  # seen by name only: which code means what is not known
            return [self._error(first_byte, f"station reports error {data.decode('ascii')!r}")]
        fix = parse_record(data, self._station, first_byte, last_byte, self._scales)
        began = fix.lock is LockState.ERROR and not self._in_error
        self._in_error = fix.lock is LockState.ERROR
        return [self._error(first_byte, fix.reason, code=6), fix] if began else [fix]

    def _error(self, stamp: Stamp, text: str, code: int | None = None) -> DeviceEvent:
        return DeviceEvent(self._station, stamp, EventKind.INSTRUMENT_ERROR, text, code)
