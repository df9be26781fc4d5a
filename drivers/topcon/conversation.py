"""Conversations with Topcon stations: the GTS-8 tracking family and the classic series."""

from __future__ import annotations

from drivers.clock import Stamp
from drivers.conversation import Conversation, FramedDialect, Heard, Script, Timing
from drivers.readings import LockState, Status
from drivers.survey import RecordError
from drivers.topcon.codec import ACK, NAK, GtsFramer, encode_frame
from drivers.topcon.records import parse_record

TRACK = b"T34"
REQUEST_TRACKED = b"C11"
REQUEST = b"C"
SLOPE_DISTANCE = b"Z34"
COORDINATES = b"Z64"

_SHORTEST_RECORD = 20  # `<` has 25 characters; an acknowledgement has 4 or 5
_ANY_TIME = Stamp(0, 0, "")  # the conversation looks at what records say, not at when


class GtsDialect(FramedDialect):
    """Frames with BCC and ETX (`drivers.conversation.Dialect`).

    Args:
        crlf: end frames with CR LF after ETX.
    """

    def __init__(self, crlf: bool) -> None:
        self._crlf = crlf
        super().__init__(GtsFramer(), _meaning, _SHORTEST_RECORD)

    def encode(self, command: bytes) -> bytes:
        return encode_frame(command, self._crlf)


def _meaning(data: bytes) -> Heard:
    if data == ACK:
        return Heard.ACK
    if data == NAK:
        return Heard.NAK
    try:
        fix = parse_record(data, "", _ANY_TIME, _ANY_TIME)
    except RecordError:
        return Heard.BROKEN
    says_its_lock = fix.lock is not LockState.UNKNOWN
    off_target = fix.lock is not LockState.LOCKED or fix.status is Status.NOT_AVAILABLE
    return Heard.RECORD_OFF_TARGET if says_its_lock and off_target else Heard.RECORD


def tracking_conversation(init: tuple[bytes, ...], crlf: bool, timing: Timing) -> Conversation:
    """GTS-8 family: `init`, T34 (track), then C11 for ever. The host acknowledges nothing.

    Args:
        init: further commands for the set-up, without BCC (`ZB23`, `ZB52`, ...).
        crlf: end frames with CR LF.
        timing: time-outs.
    """
    script = Script(request=REQUEST_TRACKED, setup=(*init, TRACK), track=TRACK)
    return Conversation(script, GtsDialect(crlf), timing)


def classic_conversation(init: tuple[bytes, ...], coordinates: bool, crlf: bool, timing: Timing) -> Conversation:
    """Classic series: `init`, measuring mode, then C for ever; the host acknowledges each record.

    Args:
        init: further commands for the set-up, without BCC.
        coordinates: ask for N, E, Z (Z64) in place of slope distance and circles (Z34).
        crlf: end frames with CR LF.
        timing: time-outs.
    """
    mode = COORDINATES if coordinates else SLOPE_DISTANCE
    script = Script(request=REQUEST, setup=(*init, mode), host_acknowledges=ACK, recover=(mode,))
    return Conversation(script, GtsDialect(crlf), timing)
