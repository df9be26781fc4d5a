"""State of acquisition, as a snapshot for `rigcal status`, the alarms and the interfaces."""

from __future__ import annotations

from dataclasses import dataclass, field

from daemon.acquisition.status.decode_failures import DecodeStatus
from daemon.acquisition.status.present import Kind


@dataclass(frozen=True)
class LinkStatus:
    """A link.

    Attributes:
        name: of the link.
        up: its port is open; None before the first word from it.
        since_s: for how long it has been so.
        reason: why it is not open; "" while it is, and before the first word.
        captures: stored since the start.
        captures_per_s: of the last two seconds.
        dropped: captures that found the queue full since the start.
        dropped_age_s: since the last of them were noticed; None without any.
        queued: waiting to be stored.
        restarts: how often its loop ended and was started again.
        restarted_age_s: since that was noticed last; None without any.
        decoder_failed_age_s: since its decoder last showed a defect of its own; None if it never did.
        error_frames: CAN error frames since the start; None for other links.
        unlisted_frames: CAN frames of identifiers that are too many for `AcquisitionStatus.frames`; None likewise.
    """

    name: str
    up: bool | None
    captures: int = 0
    captures_per_s: float = 0.0
    dropped: int = 0
    queued: int = 0
    restarts: int = 0
    error_frames: int | None = None
    unlisted_frames: int | None = None
    since_s: float = 0.0
    reason: str = ""
    dropped_age_s: float | None = None
    restarted_age_s: float | None = None
    decoder_failed_age_s: float | None = None


@dataclass(frozen=True)
class FrameStatus:
    """The CAN frames of one identifier.

    Attributes:
        link: name of the link.
        identifier: hexadecimal, 3 digits for 11 bits and 8 digits for 29.
        names: the channels that they feed; for others what the identifier says of itself, "" if nothing.
        count: since the start.
        rate_per_s: over about the last 10 s; None before it is known.
        age_s: since the last one; None if there was none.
        missed: how many did not arrive since the start, by the counter that they carry; None without one.
    """

    link: str
    identifier: str
    names: str
    count: int
    rate_per_s: float | None
    age_s: float | None
    missed: int | None


@dataclass(frozen=True)
class ChannelStatus:
    """A joint or signal, as it is now.

    Attributes:
        name, unit: of the channel.
        value: of its last reading; None unless `status` is ok.
        status: that of its last reading (drivers.readings.Status) while it is fresh, else `silent`, `link_down` or
            `starting`.
        age_s: since its last reading; None if there was none.
        last_status: of its last reading, however old; None if there was none.
        link: that it is read from; "" if it is none of the rig's.
        kind: joint or signal.
    """

    name: str
    unit: str
    value: float | None
    status: str
    age_s: float | None
    last_status: str | None = None
    link: str = ""
    kind: Kind = "signal"


@dataclass(frozen=True)
class StationStatus:
    """A total station, as it is now.

    Attributes:
        name: of the station.
        status: that of its last fix (drivers.readings.Status) while it is fresh, else `silent`, `link_down` or
            `starting`.
        lock: of its last fix (drivers.readings.LockState) while it is fresh, else `unknown`.
        reason: why the last fix is not ok.
        age_s: since its last fix; None if there was none.
        fixes: stored since the start.
        last_status, last_lock: of its last fix, however old; "" if there was none.
        good_age_s: since its last fix that is ok; None if there was none.
        tilt_ok: its last fix says that the compensator works and is in range; None where it does not say.
        sentence: all of it in one clause, for people.
    """

    name: str
    status: str
    lock: str
    reason: str
    age_s: float | None
    fixes: int
    last_status: str = ""
    last_lock: str = ""
    good_age_s: float | None = None
    tilt_ok: bool | None = None
    sentence: str = ""


@dataclass(frozen=True)
class GapStatus:
    """A gap that has not closed.

    Attributes:
        channel: joint value, signal, station or link.
        reason: drivers.readings.GapReason.
        since_utc_ns: the last instant at which it was known to be good.
        age_s: since then.
    """

    channel: str
    reason: str
    since_utc_ns: int
    age_s: float


@dataclass(frozen=True)
class EventStatus:
    """The last event of its kind that a device or link had since the start.

    Attributes:
        device, kind, text, code: as of the event (drivers.readings.DeviceEvent).
        utc_ns, age_s: when it was, and how long ago.
        number: grows from one event to the next, of all devices.
    """

    device: str
    kind: str
    text: str
    code: int | None
    utc_ns: int
    age_s: float
    number: int


@dataclass(frozen=True)
class GapCount:
    """The gaps of one channel for one reason since the start, open ones too.

    Attributes:
        channel, reason: as of `GapStatus`.
        count: how many.
        missed: how many readings or frames are missing in them, as far as that could be told.
    """

    channel: str
    reason: str
    count: int
    missed: int


@dataclass(frozen=True)
class EventCount:
    """The events of one kind that a device or link had since the start.

    Attributes:
        device, kind: as of `EventStatus`.
        count: how many.
    """

    device: str
    kind: str
    count: int


@dataclass(frozen=True)
class AcquisitionStatus:
    """A snapshot of acquisition.

    Attributes:
        links, frames, channels, stations: see their classes.
        gap_counts, event_counts: see their classes.
        decode_failures: device -> how many captures could not be decoded since the start.
        decoding: the same with the commonest reason of each.
        gaps: those that are open, longest first.
        last_events: of each device and kind the last one, newest last.
        writer_lag_s: how old the oldest capture of the last batch was when the batch was stored.
        writer_lag_p99_s: the same, of the last minute's batches, 99th percentile.
        error: why something cannot be stored at present; None when all is well.
        is_behind: captures wait in the store to be decoded, as after a kill: readings and fixes come late.
        is_write_hung: a write to the store does not end: its disk does not answer, or another program holds it.
    """

    links: list[LinkStatus] = field(default_factory=list)
    frames: list[FrameStatus] = field(default_factory=list)
    channels: list[ChannelStatus] = field(default_factory=list)
    stations: list[StationStatus] = field(default_factory=list)
    decode_failures: dict[str, int] = field(default_factory=dict)
    decoding: list[DecodeStatus] = field(default_factory=list)
    gaps: list[GapStatus] = field(default_factory=list)
    last_events: list[EventStatus] = field(default_factory=list)
    gap_counts: list[GapCount] = field(default_factory=list)
    event_counts: list[EventCount] = field(default_factory=list)
    writer_lag_s: float = 0.0
    writer_lag_p99_s: float = 0.0
    error: str | None = None
    is_behind: bool = False
    is_write_hung: bool = False
