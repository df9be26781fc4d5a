"""Polling of a total station: a state machine without port, thread or clock that decides what to send next.

    set-up command -> acknowledged, each in turn
    request        -> [acknowledged] -> record -> [host acknowledges] -> pause -> request ...

Polling never ends: an instrument that is switched off receives requests until it answers again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from pydantic import Field

from drivers.clock import NS_PER_S
from drivers.readings import EventKind, SerialCapture
from drivers.settings import Settings
from drivers.stations.replies import ReplyKind, ReplyReader

_IDLE_NS = NS_PER_S  # a record that pauses for longer than this is incomplete


class PollTiming(Settings):
    """Timeouts in seconds, taken from existing programs for these instruments.

    Attributes:
        poll_interval_s: from one request to the next, if the answer has arrived by then.
        ack_timeout_s: a command that is not acknowledged is sent again after this.
        reply_timeout_s: from acknowledgement to record.
        give_up_s: a command without any answer is abandoned after this.
        relock_after_s: a station that is off target for longer than this gets the command to track again; until then
            its own prediction, waiting and search have time to work.
    """

    poll_interval_s: float = Field(default=0.1, ge=0)
    ack_timeout_s: float = Field(default=2.0, gt=0)
    reply_timeout_s: float = Field(default=10.0, gt=0)
    give_up_s: float = Field(default=20.0, gt=0)
    relock_after_s: float = Field(default=30.0, gt=0)


@dataclass(frozen=True, slots=True)
class CommandPlan:
    """Commands of a station, and the pause between them.

    Attributes:
        request: command that requests a record.
        setup: set-up commands; the instrument acknowledges each.
        opening: commands sent first; no answer is expected.
        request_is_acknowledged: the instrument acknowledges the request before it answers.
        streams: after one request the instrument sends records until it is stopped.
        host_acknowledges: command that acknowledges a record; None if the instrument expects no acknowledgement.
        track: command that makes a tracking station follow the prism; sent again if it stays off target.
        recover: commands sent if no record follows an acknowledged request; they abort a measurement that cannot
            succeed.
        closing: commands sent before a regular close of the port.
        pause_after_ack_s: time that the instrument needs after a setting before the next command.
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
    pause_after_ack_s: float = 0.0


@dataclass(slots=True)
class _Asked:
    """A command that is waiting for its answer (times in ns)."""

    command: bytes
    is_request: bool
    first_sent: int
    sent: int
    acked: int | None = None


class Poller:
    """Decides what to send and when.

    Args:
        plan: the station's commands.
        encode: function that frames a command.
        reader: decoder of the replies, not shared with other users.
        timing: timeouts.
    """

    def __init__(
        self, plan: CommandPlan, encode: Callable[[bytes], bytes], reader: ReplyReader, timing: PollTiming
    ) -> None:
        self._plan = plan
        self._encode = encode
        self._reader = reader
        self._timing = timing
        self._outbox: deque[bytes] = deque(encode(command) for command in plan.opening)
        self._commands: deque[bytes] = deque(plan.setup)
        self._setting_up = bool(plan.setup)
        self._is_set_up = False  # the station has acknowledged its set-up since its last record
        self._acknowledged: list[str] = []
        self._unanswered: set[bytes] = set()
        self._asked: _Asked | None = None
        self._next_ns: int | None = None  # earliest time of the next command; None for at once
        self._last_byte_ns = 0
        self._off_target_since: int | None = None
        self._notices: list[tuple[EventKind, str]] = []

    def step(self, now_ns: int) -> bytes | None:
        """Return the bytes to send at this monotonic instant; call again until it returns None."""
        if self._outbox:
            return self._outbox.popleft()
        if self._asked is not None:
            self._check(self._asked, now_ns)
        if self._asked is not None:
            if now_ns < self._deadline(self._asked):
                return None
            self._asked.sent, self._asked.acked = now_ns, None
            return self._encode(self._asked.command)
        if self._next_ns is not None and now_ns < self._next_ns:
            return None
        return self._ask(now_ns)

    def wake_ns(self, now_ns: int) -> int:
        """Return the instant at which `step` may have something to send if nothing is received before."""
        if self._outbox:
            return now_ns
        if self._asked is None:
            return now_ns if self._next_ns is None else self._next_ns
        idle = self._last_byte_ns + _IDLE_NS
        deadline = min(self._deadline(self._asked), self._asked.first_sent + _ns(self._timing.give_up_s))
        return min(deadline, idle) if idle > now_ns else deadline

    def feed(self, capture: SerialCapture) -> None:
        """Process received bytes."""
        now_ns = self._last_byte_ns = capture.stamp.monotonic_ns
        for reply in self._reader.feed(capture):
            match reply.kind:
                case ReplyKind.ACK:
                    self._acked(now_ns)
                case ReplyKind.NAK:
                    self._refused(now_ns)
                case ReplyKind.UNUSABLE:
                    self._answered(now_ns)
                case ReplyKind.RECORD | ReplyKind.RECORD_OFF_TARGET:
                    if reply.kind is ReplyKind.RECORD:
                        self._off_target_since = None
                    elif self._off_target_since is None:
                        self._off_target_since = now_ns
                    if self._plan.host_acknowledges is not None:
                        self._outbox.append(self._encode(self._plan.host_acknowledges))
                    self._answered(now_ns)

    def closing(self) -> list[bytes]:
        """Return the commands to send before a regular close of the port."""
        return [self._encode(command) for command in self._plan.closing]

    def take_notices(self) -> list[tuple[EventKind, str]]:
        """Return (event kind, text) of notices for operators since the last call that the replies do not contain."""
        notices, self._notices = self._notices, []
        return notices

    def _has_broken_off(self) -> bool:
        """Discard an incomplete answer; return True if there was one."""
        return any(reply.kind is not ReplyKind.NOISE for reply in self._reader.flush("incomplete"))

    def _ask(self, now_ns: int) -> bytes:
        """Send the next set-up command, the command to track if the station stays off target, or the request."""
        if self._setting_up and not self._commands:
            self._finish_setup()
        since = self._off_target_since
        is_lost = since is not None and now_ns - since >= _ns(self._timing.relock_after_s)
        if not self._commands and self._plan.track is not None and is_lost:
            self._commands.append(self._plan.track)
            self._off_target_since = now_ns
        is_request = not self._commands
        command = self._plan.request if is_request else self._commands.popleft()
        self._asked = _Asked(command, is_request, now_ns, now_ns)
        return self._encode(command)

    def _finish_setup(self) -> None:
        self._setting_up = False
        self._is_set_up = bool(self._acknowledged)
        if self._acknowledged:
            self._notices.append((EventKind.CONFIGURED, f"station acknowledged {', '.join(self._acknowledged)}"))
        self._acknowledged = []

    def _deadline(self, asked: _Asked) -> int:
        """Return when to send the command again."""
        if asked.acked is not None:
            return asked.acked + _ns(self._timing.reply_timeout_s)
        waits_for_ack = not asked.is_request or self._plan.request_is_acknowledged
        return asked.sent + _ns(self._timing.ack_timeout_s if waits_for_ack else self._timing.reply_timeout_s)

    def _check(self, asked: _Asked, now_ns: int) -> None:
        """Stop waiting for an answer that is incomplete or missing."""
        if now_ns - self._last_byte_ns >= _IDLE_NS and self._has_broken_off():
            self._answered(now_ns)
        elif asked.acked is not None and now_ns >= self._deadline(asked):
            self._commands.extend(self._plan.recover)
            self._asked = None
        elif asked.is_request and self._plan.streams and not self._is_set_up and now_ns >= self._deadline(asked):
            self._asked = None
            self._set_up_again()
        elif now_ns - asked.first_sent >= _ns(self._timing.give_up_s):
            self._give_up(asked)

    def _give_up(self, asked: _Asked) -> None:
        if asked.command not in self._unanswered:
            self._unanswered.add(asked.command)
            text = (
                f"station did not answer {_name(asked.command)} within {self._timing.give_up_s:g} s: check that it "
                "is on and set to the configured baud rate, parity and line end"
            )
            self._notices.append((EventKind.INSTRUMENT_ERROR, text))
        self._asked = None
        if asked.is_request:
            self._set_up_again()

    def _set_up_again(self) -> None:
        """Set the station up before the next request: it may have been switched off and have lost its settings."""
        self._commands.extend(self._plan.setup)
        self._setting_up = bool(self._plan.setup)

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
        self._next_ns = now_ns + _ns(self._plan.pause_after_ack_s)

    def _refused(self, now_ns: int) -> None:
        """Process a NAK: skip a setting that the instrument refuses; a request is repeated after its timeout."""
        if self._asked is not None and not self._asked.is_request:
            self._asked = None
            self._next_ns = now_ns + _ns(self._plan.pause_after_ack_s)

    def _answered(self, now_ns: int) -> None:
        asked = self._asked
        if asked is None or not asked.is_request:
            return
        self._unanswered.clear()
        self._is_set_up = False
        if self._plan.streams:
            asked.first_sent = asked.sent = now_ns
            return
        self._asked = None
        self._next_ns = max(now_ns, asked.first_sent + _ns(self._timing.poll_interval_s))


def _ns(seconds: float) -> int:
    return round(seconds * NS_PER_S)


def _name(command: bytes) -> str:
    """Return a command as text: control characters as in the manuals, `11h`."""
    return "".join(chr(byte) if 0x20 <= byte < 0x7F else f"{byte:02X}h" for byte in command)
