"""A total station on a serial port: its configuration, the loop that talks to it, the decoder of what it sends."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Literal, Protocol

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from drivers.attendance import NOT_READ_IN_TIME, Attendance, DoubtReport
from drivers.bytestream import ByteTimes, Frame, Framer, Garbage
from drivers.clock import NS_PER_S, Clock, Stamp
from drivers.conversation import Conversation, Timing
from drivers.device_watch import DeviceWatch, watch_path
from drivers.errors import LinkError
from drivers.readings import (
    Capture,
    DecodeFailure,
    DeviceEvent,
    EventKind,
    Fix,
    Gap,
    GapReason,
    LinkItem,
    Record,
    SerialCapture,
    Status,
)
from drivers.serialport import SerialConfig, SerialPort
from drivers.sokkia.conversation import set_conversation
from drivers.sokkia.interpreter import SetInterpreter
from drivers.sokkia.set import TRACKING, SetFramer
from drivers.survey import RecordError, position_mm, range_checked
from drivers.target import LockWatch, SilenceWatch
from drivers.topcon.codec import GtsFramer
from drivers.topcon.conversation import classic_conversation, tracking_conversation
from drivers.topcon.interpreter import GtsInterpreter
from drivers.topcon.records import CorrectionScales

__all__ = ["StationConfig", "StationDecoder", "StationLink", "position_mm"]

_LONGEST_READ_S = 0.5  # how soon a loop with nothing to do notices that it is to stop
_LONGEST_WRITE_S = 5.0
_SET_PAUSE_S = 0.7  # SET600: the next command comes this long after ACK or NAK
_UNFINISHED_NS = 2 * NS_PER_S  # an unfinished record is given up after this; the slowest takes 0.6 s at 1200 baud
_FIRST_PAUSE_S = 0.5
_LAST_PAUSE_S = 2.0  # a device is back for no longer than this before it is opened, also where nothing can be watched

Emit = Callable[[LinkItem], None]


class StationConfig(BaseModel):
    """A total station and how to listen to it.

    Attributes:
        name: of the station; its captures, fixes and events carry it.
        profile: `topcon_gts8` (tracking family, polled with C11), `topcon_classic` (single shots with C),
            `sokkia_set` (SET command family, newer Topcon too), or `passive` (sends nothing, ever).
        serial: its port.
        listen_to: whose records a passive listener expects.
        init: further commands of the set-up, without check sums: `ZB4+`, `ZB52`, `ZB61` (circle clockwise, compensator
            on, zenith 0) for topcon_gts8, `Xe` (tracking) for sokkia_set. Each must be one that the station
            acknowledges.
        crlf: commands end with CR LF after ETX (Topcon), or CR LF rather than CR (Sokkia).
        measure: what topcon_classic asks for.
        poll_interval_s: from one request to the next.
        link_delay_s: constant delay from the measurement to the first byte on the host. Fixes do not contain it; who
            joins them with the joints takes it off.
        ack_timeout_s, reply_timeout_s, give_up_s, relock_after_s: see `drivers.conversation.Timing`.
        max_speed_m_s, jump_slack_m, relock_within_m: a target that moves by more than the first two allow from one fix
            to the next may be another prism, and so may one that is locked, after the prism was lost, further than the
            third from where that was. In a session such fixes do not count until the station is back or an operator
            confirms the prism.
        max_range_m: a fix further away is refused. The default is the longest that distance meters of these families
            measure to a single prism, under good conditions.
        silence_timeout_s: no record for longer than this is a gap; 0 for a station that speaks when it is told to.
        ppm_scale, prism_scale_mm: see `drivers.topcon.records.CorrectionScales`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(default="station", pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    profile: Literal["topcon_gts8", "topcon_classic", "sokkia_set", "passive"] = "topcon_gts8"
    serial: SerialConfig
    listen_to: Literal["topcon", "sokkia"] = "topcon"
    init: tuple[str, ...] = ()
    crlf: bool = True
    measure: Literal["slope_distance", "coordinates"] = "slope_distance"
    poll_interval_s: float = Field(default=0.1, ge=0)
    link_delay_s: float = Field(default=0.0, ge=0)
    ack_timeout_s: float = Field(default=2.0, gt=0)
    reply_timeout_s: float = Field(default=10.0, gt=0)
    give_up_s: float = Field(default=20.0, gt=0)
    relock_after_s: float = Field(default=30.0, gt=0)
    max_speed_m_s: float = Field(default=5.0, gt=0)
    jump_slack_m: float = Field(default=0.1, gt=0)
    relock_within_m: float = Field(default=2.0, gt=0)
    max_range_m: float = Field(default=6000.0, gt=0)
    silence_timeout_s: float = Field(default=4.0, ge=0)
    ppm_scale: float = Field(default=0.1, gt=0)
    prism_scale_mm: float = Field(default=0.1, gt=0)

    @model_validator(mode="before")
    @classmethod
    def _no_prism_is_accepted_by_time(cls, given: object) -> object:
        if isinstance(given, dict) and "new_target_after_s" in given:
            raise ValueError(
                "new_target_after_s is gone, remove it: another prism is never taken for the one that is meant because "
                "time has passed; `rigcal session confirm-prism` says that it is"
            )
        return given

    @field_validator("init")
    @classmethod
    def _printable(cls, commands: tuple[str, ...]) -> tuple[str, ...]:
        for command in commands:
            if not (command and command.isascii() and command.isprintable()):
                raise ValueError(f"{command!r} is no command: give printable ASCII without check sum and line end")
        return commands

    @model_validator(mode="after")
    def _passive_is_silent(self) -> StationConfig:
        if self.profile == "passive" and self.init:
            raise ValueError("a passive listener sends nothing: remove init, or choose another profile")
        return self

    @property
    def is_sokkia(self) -> bool:
        """Whether the station's records are those of the SET family."""
        return self.profile == "sokkia_set" or (self.profile == "passive" and self.listen_to == "sokkia")

    @property
    def tracks_silently(self) -> bool:
        """Whether the station follows its prism by itself although its records say nothing of its lock."""
        return self.is_sokkia and TRACKING.decode() in self.init


def start_conversation(config: StationConfig) -> Conversation | None:
    """The conversation of the station's profile, at its beginning; None for a passive listener."""
    init = tuple(command.encode("ascii") for command in config.init)
    timing = Timing(
        poll_interval_s=config.poll_interval_s,
        ack_timeout_s=config.ack_timeout_s,
        reply_timeout_s=config.reply_timeout_s,
        give_up_s=config.give_up_s,
        relock_after_s=config.relock_after_s,
        pause_after_ack_s=_SET_PAUSE_S if config.is_sokkia else 0.0,
    )
    match config.profile:
        case "topcon_gts8":
            return tracking_conversation(init, config.crlf, timing)
        case "topcon_classic":
            return classic_conversation(init, config.measure == "coordinates", config.crlf, timing)
        case "sokkia_set":
            return set_conversation(init, config.crlf, timing)
        case "passive":
            return None


class StationLink:
    """Owns a station's port, opens it again when it was lost, talks to the station, hands on what crosses the wire.

    It decodes no value: the conversation looks at answers only to know what to send next.

    Args:
        config: the station.
        clock: stamps captures, paces the conversation.
    """

    def __init__(self, config: StationConfig, clock: Clock) -> None:
        self.name = config.name
        self._config = config
        self._clock = clock
        self._attended = clock.now()  # the last time that the port was read

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Listen and talk until `stop` is set.

        Emits captures at once, LINK_UP, LINK_LOST, CONFIGURED and INSTRUMENT_ERROR events, and the LINK_DOWN gap.
        """
        with closing(watch_path(self._config.serial.path)) as watch:
            self._run(watch, emit, stop)

    def _run(self, watch: DeviceWatch, emit: Emit, stop: threading.Event) -> None:
        pause_s = _FIRST_PAUSE_S
        down_since: Stamp | None = None
        told = ""
        while not stop.is_set():
            opened: Stamp | None = None
            try:
                port = SerialPort(self._config.serial, self.name, self._clock.real_seconds(_LONGEST_WRITE_S))
                with closing(port):
                    watch.close()
                    self._tell(emit, EventKind.LINK_UP, f"{self._config.serial.path} opened")
                    if down_since is not None:
                        emit(Gap(self.name, GapReason.LINK_DOWN, down_since, self._clock.now()))
                    down_since, told, opened = None, "", self._clock.now()
                    self._attended = opened
                    self._converse(port, emit, stop)
            except LinkError as error:
                if down_since is None:
                    # What came since the last read is lost with the device, however long ago that was.
                    down_since = self._clock.now() if opened is None else self._attended
                    emit(Gap(self.name, GapReason.LINK_DOWN, down_since))
                if str(error) != told:  # once a cause, not once an attempt
                    told = str(error)
                    self._tell(emit, EventKind.LINK_LOST, told)
                is_short_lived = opened is not None and self._clock.now().since(opened) < _LAST_PAUSE_S * NS_PER_S
                if opened is not None and not is_short_lived:
                    pause_s = _FIRST_PAUSE_S
                real_s = min(pause_s, self._clock.real_seconds(pause_s))
                if is_short_lived:
                    stop.wait(real_s)  # it comes and goes by itself: to try whenever it comes would be to spin
                else:
                    watch.wait(stop, real_s)
                pause_s = min(2 * pause_s, _LAST_PAUSE_S)

    def _converse(self, port: SerialPort, emit: Emit, stop: threading.Event) -> None:
        doubts = DoubtReport(self.name, "bytes", self._clock.now())
        try:
            self._listen(port, emit, stop, doubts)
        finally:
            for item in doubts.end(self._clock.now()):
                emit(item)

    def _listen(self, port: SerialPort, emit: Emit, stop: threading.Event, doubts: DoubtReport) -> None:
        conversation = start_conversation(self._config)
        attendance = Attendance(self._clock)
        while not stop.is_set():
            wait_s = _LONGEST_READ_S if conversation is None else self._speak(port, conversation, emit)
            patience_s = self._clock.real_seconds(wait_s)
            data = port.read(patience_s)
            self._attended = stamp = self._clock.now()
            if attendance.is_late(stamp, patience_s):
                stamp = stamp.doubted()
                doubts.doubt(len(data), NOT_READ_IN_TIME)
            else:
                for item in doubts.trust(stamp):
                    emit(item)
            if data:
                emit(SerialCapture(self.name, stamp, data))
            if data and conversation is not None:
                conversation.feed(data, stamp.monotonic_ns)
        if conversation is not None:
            for command in conversation.closing():
                self._send(port, command, emit)

    def _speak(self, port: SerialPort, conversation: Conversation, emit: Emit) -> float:
        """Send what is due; how many seconds there is nothing more to send."""
        now_ns = self._clock.monotonic_ns()
        while (command := conversation.step(now_ns)) is not None:
            self._send(port, command, emit)
        for notice in conversation.take_notices():
            self._tell(emit, notice.kind, notice.text)
        now_ns = self._clock.monotonic_ns()
        return min(_LONGEST_READ_S, max(0, conversation.wake_ns(now_ns) - now_ns) / NS_PER_S)

    def _send(self, port: SerialPort, command: bytes, emit: Emit) -> None:
        stamp = self._clock.now()
        port.write(command)
        emit(SerialCapture(self.name, stamp, command, is_transmitted=True))

    def _tell(self, emit: Emit, kind: EventKind, text: str) -> None:
        emit(DeviceEvent(self.name, self._clock.now(), kind, text))


class Interpreter(Protocol):
    """What a protocol's frames mean."""

    def interpret(self, data: bytes, first_byte: Stamp, last_byte: Stamp) -> Sequence[Fix | DeviceEvent]:
        """The records of one frame; RecordError if it is none that is known."""


class StationDecoder:
    """Captures of a station's link to fixes, events, gaps and failures (`drivers.readings.Decoder`).

    A fix is stamped with the arrival of its first byte; where that is doubtful, the fix may not be used. Transmitted
    captures yield nothing; an answer arrives after them. What the passing of time alone causes is stamped with the
    instant at which it was due, so records do not depend on how often `tick` is called.

    Args:
        config: the station, as its link has it.
    """

    def __init__(self, config: StationConfig) -> None:
        self._station = config.name
        self._framer: Framer = SetFramer() if config.is_sokkia else GtsFramer()
        self._interpreter: Interpreter = (
            SetInterpreter(config.name)
            if config.is_sokkia
            else GtsInterpreter(config.name, CorrectionScales(config.ppm_scale, config.prism_scale_mm))
        )
        self._times = ByteTimes(config.serial.character_s)
        self._lock = LockWatch(config.name)
        self._max_range_m = config.max_range_m
        self._silence = SilenceWatch(config.name, config.silence_timeout_s)
        self._last_byte: Stamp | None = None

    def feed(self, capture: Capture) -> list[Record]:
        if not isinstance(capture, SerialCapture):
            return []
        records = self.tick(capture.stamp)
        if capture.is_transmitted:
            self._times.sent(capture.stamp)
            return records
        self._last_byte = capture.stamp
        self._times.received(len(capture.data), capture.stamp)
        for item in self._framer.feed(capture.data):
            records += self._failure(item) if isinstance(item, Garbage) else self._records(item)
        return records

    def tick(self, now: Stamp) -> list[Record]:
        records: list[Record] = []
        if self._last_byte is not None and now.since(self._last_byte) > _UNFINISHED_NS:
            # In the order of their deadlines, so that it does not matter how often time is told.
            records += self._silence.tick(self._last_byte.shifted(_UNFINISHED_NS))
            for garbage in self._framer.flush("record broken off"):
                records += self._failure(garbage)
            self._last_byte = None
        return records + self._silence.tick(now)

    def _failure(self, garbage: Garbage) -> list[Record]:
        return [DecodeFailure(self._station, self._times.at(garbage.start), garbage.reason, garbage.raw)]

    def _records(self, frame: Frame) -> list[Record]:
        first, last = self._times.at(frame.start), self._times.at(frame.end)
        try:
            said = self._interpreter.interpret(frame.data, first, last)
        except RecordError as error:
            return [DecodeFailure(self._station, first, str(error), frame.data)]
        records: list[Record] = []
        for record in said:
            if isinstance(record, Fix):
                fix = range_checked(_without_time(record) if first.is_doubtful else record, self._max_range_m)
                records += [*self._silence.heard(fix), *self._lock.see(fix), fix]
            else:
                records.append(record)
        return records


def _without_time(fix: Fix) -> Fix:
    """A fix whose bytes were read late: it may not be used, because it is not known when it was measured."""
    if fix.status is not Status.OK:
        return fix
    return replace(fix, status=Status.TIME_DOUBTFUL, reason=f"its time is doubtful: {NOT_READ_IN_TIME}")
