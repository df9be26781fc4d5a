"""The host's half of a conversation with a total station: a state machine without port, thread or clock.

    set-up command -> acknowledged, each in turn
    request        -> [acknowledged] -> record -> [host acknowledges] -> pause -> request ...

Nothing here yields readings: those come from the decoder, fed with the captured bytes. The machine only decides what
to send next, and goes on for ever: an instrument that is switched off is asked again until it answers.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import Protocol

from drivers.bytestream import Framer, Garbage
from drivers.clock import NS_PER_S
from drivers.readings import EventKind


class Heard(Enum):
    """What an instrument said, as far as the conversation cares."""

    ACK = auto()
    NAK = auto()
    RECORD = auto()
    RECORD_OFF_TARGET = auto()  # a record of a tracking station that is not locked on a prism
    BROKEN = auto()  # so much like a record that it was meant as the answer, but not a sound one


class Dialect(Protocol):
    """How commands are framed and answers told apart."""

    def encode(self, command: bytes) -> bytes:
        """The bytes that send `command`."""

    def hear(self, data: bytes) -> Sequence[Heard]:
        """What these received bytes complete, in order."""

    def abandon(self) -> bool:
        """Drop an answer that stopped half-way; True when there was one."""


class FramedDialect:
    """The hearing half of a dialect whose answers a framer takes apart.

    Args:
        framer: of the family; this dialect's alone.
        meaning: what the data of one frame says.
        shortest: garbage of at least so many bytes was an answer once.
    """

    def __init__(self, framer: Framer, meaning: Callable[[bytes], Heard], shortest: int) -> None:
        self._framer, self._meaning, self._shortest = framer, meaning, shortest

    def hear(self, data: bytes) -> list[Heard]:
        heard: list[Heard] = []
        for item in self._framer.feed(data):
            if not isinstance(item, Garbage):
                heard.append(self._meaning(item.data))
            elif len(item.raw) >= self._shortest:
                heard.append(Heard.BROKEN)
        return heard

    def abandon(self) -> bool:
        return any(len(garbage.raw) >= self._shortest for garbage in self._framer.flush("broken off"))


@dataclass(frozen=True, slots=True)
class Timing:
    """Time-outs in seconds, from programs that have driven these instruments (protocol facts, 1.3, 1.6 and 1.8).

    Attributes:
        poll_interval_s: from one request to the next, if the answer is there by then.
        ack_timeout_s: a command that is not acknowledged is sent again after this.
        reply_timeout_s: from acknowledgement to record.
        give_up_s: a command without any answer is given up after this.
        idle_s: a record that stops for longer than this is broken off.
        relock_after_s: off target for longer than this, the station is told once more to track; until then its own
            prediction, waiting and search are left to work.
        pause_after_ack_s: what an instrument needs after a setting before the next command.
    """

    poll_interval_s: float = 0.1
    ack_timeout_s: float = 2.0
    reply_timeout_s: float = 10.0
    give_up_s: float = 20.0
    idle_s: float = 1.0
    relock_after_s: float = 30.0
    pause_after_ack_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Script:
    """What to say.

    Attributes:
        opening: sent first; no answer is expected.
        setup: commands that are acknowledged.
        request: asks for a record.
        request_is_acknowledged: the instrument acknowledges the request before it answers.
        streams: one request makes the instrument send records until it is stopped.
        host_acknowledges: command that acknowledges a record; None where the instrument expects none.
        track: command that makes a tracking station follow the prism, sent again when it has stayed off target.
        recover: sent when an acknowledged request brought no record; aborts a measurement that cannot succeed.
        closing: sent when the conversation ends.
    """

    request: bytes
    setup: tuple[bytes, ...] = ()
    opening: tuple[bytes, ...] = ()
    request_is_acknowledged: bool = True
    streams: bool = False
    host_acknowledges: bytes | None = None
    track: bytes | None = None
    recover: tuple[bytes, ...] = ()
    closing: tuple[bytes, ...] = ()


@dataclass(frozen=True, slots=True)
class Notice:
    """Something that an operator should know and that the received bytes alone do not say."""

    kind: EventKind
    text: str


@dataclass(slots=True)
class _Asked:
    """A command that waits for its answer (times in ns)."""

    command: bytes
    is_request: bool
    first_sent: int
    sent: int
    acked: int | None = None


class Conversation:
    """Says what to send and when.

    Args:
        script: what to say.
        dialect: how.
        timing: time-outs.
    """

    def __init__(self, script: Script, dialect: Dialect, timing: Timing) -> None:
        self._script = script
        self._dialect = dialect
        self._timing = timing
        self._outbox: deque[bytes] = deque(dialect.encode(command) for command in script.opening)
        self._commands: deque[bytes] = deque(script.setup)
        self._setting_up = bool(script.setup)
        self._acknowledged: list[str] = []
        self._unanswered: set[bytes] = set()
        self._asked: _Asked | None = None
        self._next_ns: int | None = None  # not before; None: at once
        self._last_byte_ns = 0
        self._off_target_since: int | None = None
        self._notices: list[Notice] = []

    def step(self, now_ns: int) -> bytes | None:
        """Bytes to send at this monotonic instant, if any; call again until there are none."""
        if self._outbox:
            return self._outbox.popleft()
        if self._asked is not None:
            self._judge(self._asked, now_ns)
        if self._asked is not None:
            if not self._is_due(self._asked, now_ns):
                return None
            self._asked.sent, self._asked.acked = now_ns, None
            return self._dialect.encode(self._asked.command)
        if self._next_ns is not None and now_ns < self._next_ns:
            return None
        return self._ask(now_ns)

    def wake_ns(self, now_ns: int) -> int:
        """The instant at which `step` may have something to send, if nothing is heard before."""
        if self._outbox:
            return now_ns
        if self._asked is None:
            return now_ns if self._next_ns is None else self._next_ns
        idle = self._last_byte_ns + _ns(self._timing.idle_s)
        deadline = min(self._deadline(self._asked), self._asked.first_sent + _ns(self._timing.give_up_s))
        return min(deadline, idle) if idle > now_ns else deadline

    def feed(self, data: bytes, now_ns: int) -> None:
        """Received bytes."""
        self._last_byte_ns = now_ns
        for heard in self._dialect.hear(data):
            match heard:
                case Heard.ACK:
                    self._acked(now_ns)
                case Heard.NAK:
                    self._refused(now_ns)
                case Heard.BROKEN:
                    self._answered(now_ns)
                case Heard.RECORD | Heard.RECORD_OFF_TARGET:
                    self._watch_target(heard, now_ns)
                    if self._script.host_acknowledges is not None:
                        self._outbox.append(self._dialect.encode(self._script.host_acknowledges))
                    self._answered(now_ns)

    def closing(self) -> Sequence[bytes]:
        """What to send before the port is closed on purpose."""
        return [self._dialect.encode(command) for command in self._script.closing]

    def take_notices(self) -> list[Notice]:
        """Notices since the last call."""
        notices, self._notices = self._notices, []
        return notices

    def _ask(self, now_ns: int) -> bytes:
        """Send the next set-up command, or the one to track to a station that stays off target, or the request."""
        if self._setting_up and not self._commands:
            self._finish_setup()
        if not self._commands and self._script.track is not None and self._is_lost(now_ns):
            self._commands.append(self._script.track)
            self._off_target_since = now_ns
        is_request = not self._commands
        command = self._script.request if is_request else self._commands.popleft()
        self._asked = _Asked(command, is_request, now_ns, now_ns)
        return self._dialect.encode(command)

    def _finish_setup(self) -> None:
        self._setting_up = False
        if self._acknowledged:
            self._notices.append(Notice(EventKind.CONFIGURED, f"station acknowledged {', '.join(self._acknowledged)}"))
        self._acknowledged = []

    def _deadline(self, asked: _Asked) -> int:
        """When to send it again."""
        if asked.acked is not None:
            return asked.acked + _ns(self._timing.reply_timeout_s)
        waits_for_ack = not asked.is_request or self._script.request_is_acknowledged
        return asked.sent + _ns(self._timing.ack_timeout_s if waits_for_ack else self._timing.reply_timeout_s)

    def _is_due(self, asked: _Asked, now_ns: int) -> bool:
        return now_ns >= self._deadline(asked)

    def _judge(self, asked: _Asked, now_ns: int) -> None:
        """End a question that is not worth asking on."""
        if now_ns - self._last_byte_ns >= _ns(self._timing.idle_s) and self._dialect.abandon():
            self._answered(now_ns)
        elif asked.acked is not None and self._is_due(asked, now_ns):
            self._commands.extend(self._script.recover)
            self._asked = None
        elif now_ns - asked.first_sent >= _ns(self._timing.give_up_s):
            self._give_up(asked)

    def _give_up(self, asked: _Asked) -> None:
        if asked.command not in self._unanswered:
            self._unanswered.add(asked.command)
            self._notices.append(
                Notice(
                    EventKind.INSTRUMENT_ERROR,
                    f"station did not answer {_name(asked.command)} within {self._timing.give_up_s:g} s: check that it "
                    "is on and set to this baud rate, parity and line end",
                )
            )
        self._asked = None
        if asked.is_request:  # it may have been switched off and have lost its settings
            self._commands.extend(self._script.setup)
            self._setting_up = bool(self._script.setup)

    def _acked(self, now_ns: int) -> None:
        asked = self._asked
        if asked is None:
            return
        self._unanswered.discard(asked.command)
        if asked.is_request:
            asked.acked = now_ns
            return
        if self._setting_up:
            self._acknowledged.append(_name(asked.command))
        self._asked = None
        self._next_ns = now_ns + _ns(self._timing.pause_after_ack_s)

    def _refused(self, now_ns: int) -> None:
        """NAK: a setting that the instrument does not take is passed over; a request is repeated in its time."""
        if self._asked is not None and not self._asked.is_request:
            self._asked = None
            self._next_ns = now_ns + _ns(self._timing.pause_after_ack_s)

    def _answered(self, now_ns: int) -> None:
        asked = self._asked
        if asked is None or not asked.is_request:
            return
        self._unanswered.clear()
        if self._script.streams:
            asked.first_sent = asked.sent = now_ns
            return
        self._asked = None
        self._next_ns = max(now_ns, asked.first_sent + _ns(self._timing.poll_interval_s))

    def _is_lost(self, now_ns: int) -> bool:
        since = self._off_target_since
        return since is not None and now_ns - since >= _ns(self._timing.relock_after_s)

    def _watch_target(self, heard: Heard, now_ns: int) -> None:
        if heard is Heard.RECORD:
            self._off_target_since = None
        elif self._off_target_since is None:
            self._off_target_since = now_ns


def _ns(seconds: float) -> int:
    return round(seconds * NS_PER_S)


def _name(command: bytes) -> str:
    return command.decode("ascii", errors="backslashreplace")
