"""Captures (raw, as they crossed the wire) and the records decoded from them: all that drivers give.

A decoder is a pure state machine: it owns no port, no thread and no clock. It is fed captures in order and told the
time, and returns records. Fed the same captures it returns the same records, so any reading can be made again.
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
    """One CAN frame as it crossed the wire.

    Attributes:
        link: name of the CAN link.
        stamp: when the frame was received or sent; marked as doubtful where it may have been received long before.
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
            as doubtful where the bytes may have arrived long before.
        data: at least one byte.
        is_transmitted: rigcal sent them.
    """

    link: str
    stamp: Stamp
    data: bytes
    is_transmitted: bool = False


Capture = CanCapture | SerialCapture


class Status(StrEnum):
    """Why a value may or may not be used. Only OK readings carry a value that calibration may use."""

    OK = "ok"
    NOT_AVAILABLE = "not_available"  # the device itself sent "no value" (all ones, Exxx, distance 0)
    OUT_OF_RANGE = "out_of_range"  # beyond the device's measuring range or the signal's declared range
    DEVICE_ALARM = "device_alarm"  # the device reports an alarm (6503h, EMCY) that makes its value void
    MALFORMED = "malformed"  # arrived, could not be decoded; a DecodeFailure says why
    TIME_DOUBTFUL = "time_doubtful"  # nothing else is wrong, but it was read late: when it was measured is not known


@dataclass(frozen=True, slots=True)
class Reading:
    """One value of one channel at one instant.

    Attributes:
        channel: the joint value or signal (`theta1`, `L2`, `boom_valve`), as the rig file names it.
        stamp: when the device sampled it, as well as the link can tell.
        value: in `unit`; None unless `status` is OK.
        unit: deg, mm, deg/s, mm/s, bar, mA, degC, ... as the rig file says.
        status: see Status.
        raw_counts: the device's own integer, where there is one.
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
    UNKNOWN = "unknown"  # the record does not say (classic stations)


@dataclass(frozen=True, slots=True)
class Fix:
    """One total-station measurement, as the instrument gave it.

    Either circle readings with or without a distance, or (NEZ records) the instrument's own coordinates. Coordinates
    in the station's frame are computed by `position_mm`, never taken from the instrument's horizontal distance.

    Attributes:
        station: name of the station.
        stamp: when the first byte of its record arrived; link delay is not taken off.
        last_byte: when its last byte had arrived.
        status: OK when a position can be computed and may be used.
        lock: tracking state.
        hz_angle_rad: horizontal circle, clockwise from north, 0..2 pi.
        zenith_angle_rad: vertical circle, 0 = up, 0..2 pi (beyond pi: face 2).
        slope_distance_m: as displayed by the instrument (its prism constant and ppm already applied).
        north_m, east_m, up_m: the instrument's own coordinates (NEZ records only).
        face: 1 or 2.
        prism_constant_mm, ppm, tilt_ok, edm_level: as the record says, None where it does not.
        reason: for a status other than OK, in words.
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
    BUS_ERROR = "bus_error"  # a protocol violation on the wire; error counters not yet beyond a limit
    FRAMES_DROPPED = "frames_dropped"  # the kernel, the adapter or a full queue lost frames
    TIME_DOUBTFUL = "time_doubtful"  # captures are stored, but when they were received is not known
    BOOT_UP = "boot_up"
    NMT_STATE = "nmt_state"
    HEARTBEAT_LOST = "heartbeat_lost"
    HEARTBEAT_RESTORED = "heartbeat_restored"
    EMERGENCY = "emergency"
    EMERGENCY_CLEARED = "emergency_cleared"
    ALARM = "alarm"
    WARNING = "warning"
    PRESET_JUMP = "preset_jump"  # an encoder's position jumped by more than it can move
    CONFIGURED = "configured"
    LOCK_ACQUIRED = "lock_acquired"
    LOCK_LOST = "lock_lost"
    PRISM_JUMP = "prism_jump"  # the station's target jumped: it may follow another prism
    PRISM_CONFIRMED = "prism_confirmed"  # an operator says that the station is on the prism that is meant
    STATION_SILENT = "station_silent"
    INSTRUMENT_ERROR = "instrument_error"
    CLOCK_STEP = "clock_step"  # the computer's clock was set; the code is by how many milliseconds


@dataclass(frozen=True, slots=True)
class DeviceEvent:
    """Something that happened to a device or link, worth a row of its own.

    Attributes:
        device: channel, station or link name.
        stamp: when.
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
    """Captured bytes that could not be decoded: counted and kept, never guessed at.

    Attributes:
        device: channel, station or link name.
        stamp: when the bytes arrived.
        reason: what was expected and what was found.
        raw: the bytes.
    """

    device: str
    stamp: Stamp
    reason: str
    raw: bytes


class GapReason(StrEnum):
    """Why a channel has nothing for a stretch of time."""

    SILENT = "silent"  # the device is there no more, or was never
    LINK_DOWN = "link_down"
    FRAMES_LOST = "frames_lost"  # on the bus, in the kernel, in the adapter or in rigcal's queue
    TIME_DOUBTFUL = "time_doubtful"  # captures are stored, but none of them may be used: their time is not known
    LOCK_LOST = "lock_lost"
    NOT_RUNNING = "not_running"  # the daemon itself was not there


@dataclass(frozen=True, slots=True)
class Gap:
    """A stretch in which a channel gave nothing. Reported when it opens (`end` None) and again when it closes.

    Attributes:
        channel: joint value, signal, station or link; `daemon` for rigcal itself.
        reason: see GapReason.
        start: the last instant at which the channel was known to be good.
        end: the first instant at which it was good again; None while it lasts.
        missed: how many readings are missing, where that can be told.
    """

    channel: str
    reason: GapReason
    start: Stamp
    end: Stamp | None = None
    missed: int | None = None


Record = Reading | Fix | DeviceEvent | DecodeFailure | Gap


class Decoder(Protocol):
    """A pure decoder of one link's captures. Never raises on any input; what it cannot decode is a DecodeFailure."""

    def feed(self, capture: Capture) -> Sequence[Record]:
        """Records that this capture completes, in order."""

    def tick(self, now: Stamp) -> Sequence[Record]:
        """Records that the mere passing of time causes: missed heartbeats, silent channels."""


LinkItem = Capture | DeviceEvent | Gap


class LinkLoop(Protocol):
    """The thin loop that owns one port: opens it, reads it, opens it again when it goes away. It decodes nothing."""

    @property
    def read_until(self) -> Stamp | None:
        """All that the port had received by then has been handed on, and what was lost has been told.

        None where nothing waits to be read, as while the port is not open, which has been told as well.
        """

    @property
    def name(self) -> str:
        """Name of the link, as its captures carry it."""

    def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
        """Hand on every capture at once, and what captures cannot tell (link up, lost, dropped), until `stop`."""
