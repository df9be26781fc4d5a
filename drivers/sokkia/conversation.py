"""Conversations with stations of the SET family: settings acknowledged by one character, then 11h."""

from __future__ import annotations

from drivers.clock import Stamp
from drivers.conversation import Conversation, FramedDialect, Heard, Script, Timing
from drivers.sokkia.set import ACK, CR, LF, NAK, REQUEST_DISTANCE, STOP, SetFramer, parse_identity, parse_reply
from drivers.survey import RecordError

REPEATING = (b"Xb", b"Xd", b"Xe")  # fine repeat, rapid repeat, tracking
_MEASURING_MODES = (b"Xa", b"Xb", b"Xc", b"Xd", b"Xe")
_SHORTEST_REPLY = 14  # E100 E100 E100
_ANY_TIME = Stamp(0, 0, "")


class SetDialect(FramedDialect):
    """Lines (`drivers.conversation.Dialect`).

    Args:
        crlf: end commands with CR LF, else with CR.
    """

    def __init__(self, crlf: bool) -> None:
        self._end = CR + LF if crlf else CR
        super().__init__(SetFramer(), _meaning, _SHORTEST_REPLY)

    def encode(self, command: bytes) -> bytes:
        return command + self._end


def _meaning(data: bytes) -> Heard:
    if data == ACK:
        return Heard.ACK
    if data == NAK:
        return Heard.NAK
    try:
        parse_reply(data, "", _ANY_TIME, _ANY_TIME)
    except RecordError:
        return _other_line(data)
    return Heard.RECORD


def _other_line(data: bytes) -> Heard:
    """The identity (`A`) answers a set-up command."""
    try:
        parse_identity(data)
    except RecordError:
        return Heard.BROKEN
    return Heard.ACK


def set_conversation(init: tuple[bytes, ...], crlf: bool, timing: Timing) -> Conversation:
    """SET family: 12h (stop what runs), `init`, then 11h.

    When the last measuring mode in `init` repeats (Xb, Xd, Xe), one 11h starts a stream of replies; it is sent again
    only when the stream has stopped for `reply_timeout_s`, and 12h ends it when the conversation closes.

    Args:
        init: settings (`Xe`), or opaque commands of the instrument that it answers with 06h.
        crlf: end commands with CR LF, else with CR.
        timing: time-outs.
    """
    modes = [command for command in init if command in _MEASURING_MODES]
    streams = bool(modes) and modes[-1] in REPEATING
    script = Script(
        request=REQUEST_DISTANCE,
        setup=init,
        opening=(STOP,),
        request_is_acknowledged=False,
        streams=streams,
        closing=(STOP,) if streams else (),
    )
    return Conversation(script, SetDialect(crlf), timing)
