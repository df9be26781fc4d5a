"""Protocol of Topcon stations: frames of `framing`, records of `records`, errors that the instrument reports."""

from __future__ import annotations

from drivers.clock import Stamp
from drivers.readings import LockState, Status
from drivers.stations.profile import Codec, ProfileOptions
from drivers.stations.replies import Reply, ReplyKind, instrument_error
from drivers.stations.topcon.framing import GtsFramer, encode_frame
from drivers.stations.topcon.records import CorrectionScales, parse_record

_SHORTEST_RECORD = 20  # `<` has 25 characters; an acknowledgement has 4 or 5
_RECOVERING = 6  # tracking flag


class GtsParser:
    """Parser of Topcon's frames (`drivers.stations.replies.Parser`).

    Args:
        station: name of the station.
        options: options of the station, with the units of the corrections in its records.
    """

    def __init__(self, station: str, options: ProfileOptions) -> None:
        self._station = station
        self._scales = CorrectionScales(options.ppm_scale, options.prism_scale_mm)
        self._in_error = False

    def parse(self, data: bytes, first_byte: Stamp, last_byte: Stamp) -> Reply:
        if data.startswith(b"E"):  # the meaning of the error codes is unknown
            error = instrument_error(self._station, first_byte, f"station reports error {data.decode('ascii')!r}")
            return Reply(ReplyKind.UNUSABLE, (error,))
        fix = parse_record(data, self._station, first_byte, last_byte, self._scales)
        was_in_error, self._in_error = self._in_error, fix.lock is LockState.ERROR
        is_locked = fix.lock is LockState.LOCKED and fix.status is not Status.NOT_AVAILABLE
        kind = ReplyKind.RECORD if is_locked or fix.lock is LockState.UNKNOWN else ReplyKind.RECORD_OFF_TARGET
        if self._in_error and not was_in_error:
            return Reply(kind, (instrument_error(self._station, first_byte, fix.reason, _RECOVERING), fix))
        return Reply(kind, (fix,))


CODEC = Codec(
    family="topcon",
    encode=encode_frame,
    framer=GtsFramer,
    parser=GtsParser,
    shortest_record=_SHORTEST_RECORD,
)
