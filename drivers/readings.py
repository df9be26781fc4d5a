"""Captures (raw data as transferred on the wire) and the records decoded from them: the output of all drivers.

A decoder is a pure state machine: it owns no port, no thread and no clock. It receives captures in order and the time,
and returns records. The same captures always give the same records, so any reading can be reproduced.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from drivers.clock import Stamp


@dataclass(frozen=True, slots=True)
class CanCapture:
    """One CAN frame as transferred on the wire.

    Attributes:
        link: name of the CAN link.
        stamp: when the frame was received or sent; marked as doubtful if it may have been received long before.
        arbitration_id: 11-bit, or 29-bit if `is_extended`; the error class bits of SocketCAN if `is_error`.
        data: 0 to 8 bytes.
        is_extended, is_remote, is_error: the frame's flags.
        is_transmitted: rigcal sent it.
    """

    link: str
    stamp: Stamp
    arbitration_id: int
    data: bytes
    is_extended: bool = False
    is_remote: bool = False
    is_error: bool = False
    is_transmitted: bool = False


@dataclass(frozen=True, slots=True)
class SerialCapture:
    """Bytes that one read returned, or that one write sent.

    Attributes:
        link: name of the serial link.
        stamp: the instant just after the read returned (the last byte had arrived), or just before the write; marked
            as doubtful if the bytes may have arrived long before.
        data: the bytes, at least one.
        is_transmitted: rigcal sent the bytes.
    """

    link: str
    stamp: Stamp
    data: bytes
    is_transmitted: bool = False


Capture = CanCapture | SerialCapture


class Status(StrEnum):
    """Whether a value may be used, and if not, why. Only OK readings have a value that calibration may use."""

    OK = "ok"
    NOT_AVAILABLE = "not_available"  # the device itself sent "no value" (all ones, Exxx, distance 0)
    OUT_OF_RANGE = "out_of_range"  # outside the device's measuring range or the signal's declared range
    DEVICE_ALARM = "device_alarm"  # an alarm (6503h, EMCY), a wrong device or a duplicate node makes the value invalid
    MALFORMED = "malformed"  # received but could not be decoded; a DecodeFailure gives the reason
    TIME_DOUBTFUL = "time_doubtful"  # valid, but read late, so the time of measurement is unknown


@dataclass(frozen=True, slots=True)
class Reading:
    """One value of one channel at one instant.

    Attributes:
        channel: name of the joint value or signal in the rig file (`theta1`, `L2`, `boom_valve`).
        stamp: when the device sampled the value, as accurately as the link can determine it.
        value: value in `unit`; None unless `status` is OK.
        unit: unit given in the rig file: deg, mm, deg/s, mm/s, bar, mA, degC, ...
        status: see Status.
        raw_counts: the device's own integer, if there is one.
    """

    channel: str
    stamp: Stamp
    value: float | None
    unit: str
    status: Status = Status.OK
    raw_counts: int | None = None


class LockState(StrEnum):
    """Tracking state of a robotic station."""

    STANDBY = "standby"
    LOCKED = "locked"
    SEARCHING = "searching"
    WAITING = "waiting"
    ROTATING = "rotating"
    ERROR = "error"
    UNKNOWN = "unknown"  # not contained in the record (classic stations)


@dataclass(frozen=True, slots=True)
class Fix:
    """One total-station measurement as sent by the instrument.

    A fix has either circle readings with or without a distance, or (NEZ records) the instrument's own coordinates.
    Coordinates in the station's frame are computed by `position_mm`, never from the instrument's horizontal distance.

    Attributes:
        station: name of the station.
        stamp: when the first byte of its record arrived; the link delay is not subtracted.
        last_byte: when the last byte of its record arrived.
        status: OK if a position can be computed and may be used.
        lock: tracking state.
        hz_angle_rad: horizontal circle, clockwise from north, 0..2 pi.
        zenith_angle_rad: vertical circle, 0 = up, 0..2 pi (beyond pi: face 2).
        slope_distance_m: distance as displayed by the instrument (with its prism constant and ppm already applied).
        north_m, east_m, up_m: the instrument's own coordinates (NEZ records only).
        face: 1 or 2.
        prism_constant_mm, ppm, tilt_ok, edm_level: values from the record; None if it does not contain them.
        reason: reason for a status other than OK.
        raw: the record's bytes without checksum and terminator.
    """

    station: str
    stamp: Stamp
    last_byte: Stamp
    status: Status
    lock: LockState
    hz_angle_rad: float | None = None
    zenith_angle_rad: float | None = None
    slope_distance_m: float | None = None
    north_m: float | None = None
    east_m: float | None = None
    up_m: float | None = None
    face: int | None = None
    prism_constant_mm: float | None = None
    ppm: float | None = None
    tilt_ok: bool | None = None
    edm_level: int | None = None
    reason: str = ""
    raw: bytes = b""


class EventKind(StrEnum):
    """Kinds of events of devices and links."""

    LINK_UP = "link_up"
    LINK_LOST = "link_lost"
    BUS_ERROR_ACTIVE = "bus_error_active"
    BUS_ERROR_WARNING = "bus_error_warning"
    BUS_ERROR_PASSIVE = "bus_error_passive"
    BUS_OFF = "bus_off"
    BUS_ERROR = "bus_error"  # a protocol violation on the wire; no error counter has reached a limit
    FRAMES_DROPPED = "frames_dropped"  # the kernel, the adapter or a full queue lost frames
    TIME_DOUBTFUL = "time_doubtful"  # captures are stored, but their receive time is unknown
    BOOT_UP = "boot_up"
    NMT_STATE = "nmt_state"
    HEARTBEAT_LOST = "heartbeat_lost"
    HEARTBEAT_RESTORED = "heartbeat_restored"
    DUPLICATE_NODE = "duplicate_node"  # a second device on the bus has the number of a node
    DUPLICATE_NODE_GONE = "duplicate_node_gone"
    EMERGENCY = "emergency"
    EMERGENCY_CLEARED = "emergency_cleared"
    ALARM = "alarm"
    WARNING = "warning"
    PRESET_JUMP = "preset_jump"  # an encoder's position jumped by more than it can move, or it was exchanged
    CONFIGURED = "configured"
    LOCK_ACQUIRED = "lock_acquired"
    LOCK_LOST = "lock_lost"
    PRISM_JUMP = "prism_jump"  # the station's target jumped: it may follow a different prism
    PRISM_CONFIRMED = "prism_confirmed"  # an operator confirmed that the station is on the intended prism
    SHOT_BEGUN = "shot_begun"  # of a control point: the station is on no prism until the shot has ended
    SHOT_ENDED = "shot_ended"
    STATION_SILENT = "station_silent"
    INSTRUMENT_ERROR = "instrument_error"
    CLOCK_STEP = "clock_step"  # the computer's clock was set; the code is the change in milliseconds


@dataclass(frozen=True, slots=True)
class DeviceEvent:
    """An event of a device or link.

    Attributes:
        device: name of the channel, station or link.
        stamp: when it happened.
        kind: see EventKind.
        text: one sentence for an operator.
        code: the device's own code (EMCY code, alarm bits, instrument error), if any.
    """

    device: str
    stamp: Stamp
    kind: EventKind
    text: str
    code: int | None = None


@dataclass(frozen=True, slots=True)
class DecodeFailure:
    """Captured bytes that could not be decoded. They are counted and stored, and their meaning is never guessed.

    Attributes:
        device: name of the channel, station or link.
        stamp: when the bytes arrived.
        reason: what was expected and what was found.
        raw: the bytes.
    """

    device: str
    stamp: Stamp
    reason: str
    raw: bytes


class GapReason(StrEnum):
    """Reasons why a channel has no data for a period of time."""

    SILENT = "silent"  # the device has gone, or was never there
    LINK_DOWN = "link_down"
    FRAMES_LOST = "frames_lost"  # on the bus, in the kernel, in the adapter or in rigcal's queue
    TIME_DOUBTFUL = "time_doubtful"  # captures are stored but must not be used, because their time is unknown
    LOCK_LOST = "lock_lost"
    NOT_RUNNING = "not_running"  # the daemon itself was not running


@dataclass(frozen=True, slots=True)
class Gap:
    """A period without data from a channel. Reported when it opens (`end` None) and again when it closes.

    Attributes:
        channel: joint value, signal, station or link; `daemon` for rigcal itself.
        reason: see GapReason.
        start: the last instant at which the channel was known to be good.
        end: the first instant at which it was good again; None while the gap lasts.
        missed: number of missing readings, if known.
    """

    channel: str
    reason: GapReason
    start: Stamp
    end: Stamp | None = None
    missed: int | None = None


Record = Reading | Fix | DeviceEvent | DecodeFailure | Gap


class Decoder(Protocol):
    """A pure decoder of one link's captures. It never raises; undecodable input becomes a DecodeFailure."""

    def feed(self, capture: Capture) -> Sequence[Record]:
        """Return the records that this capture completes, in order."""

    def tick(self, now: Stamp) -> Sequence[Record]:
        """Return the records that are caused by the passing of time alone: missed heartbeats, silent channels."""


LinkItem = Capture | DeviceEvent | Gap


class LinkLoop(Protocol):
    """The thin loop that owns one port: opens it, reads it, and reopens it when it is lost. It decodes nothing."""

    @property
    def read_until(self) -> Stamp | None:
        """Instant up to which all data received by the port has been passed on and all losses have been reported.

        None if no data can be waiting, such as while the port is not open; that has been reported as well.
        """

    @property
    def name(self) -> str:
        """Name of the link in its captures."""

    def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
        """Until `stop`, pass every capture on at once, with events and gaps of the link (up, lost, dropped)."""
