"""State of acquisition, as a snapshot for `rigcal status`, the alarms and the interfaces."""

from __future__ import annotations

from dataclasses import dataclass, field

from daemon.acquisition.status.decode_failures import DecodeStatus
from daemon.acquisition.status.present import Kind, is_present


@dataclass(frozen=True)
class LinkStatus:
    """Present state of a link. Counts are since the start; ages are in seconds.

    Attributes:
        name: name of the link.
        up: whether its port is open; None before its first report.
        since_s: for how long the port has been in this state.
        reason: why it is not open; "" while it is, and before the first report.
        captures: captures stored.
        captures_per_s: rate over the last two seconds.
        dropped: captures lost because the queue was full.
        dropped_age_s: time since such a loss was last noticed; None without any.
        queued: items waiting to be stored.
        restarts: how often its loop ended and was restarted.
        restarted_age_s: time since a restart was last noticed; None without any.
        decoder_failed_age_s: time since its decoder last failed by an internal error; None if it never did.
        error_frames: CAN error frames; None for other links.
        unlisted_frames: CAN frames whose identifiers did not fit into `AcquisitionStatus.frames`; None for other links.
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
        names: channels decoded from them; for others the standard meaning of the identifier, "" if it has none.
        count: number since the start.
        rate_per_s: rate over about the last 10 s; None before it is known.
        age_s: time since the last frame; None if there was none.
        missed: number that did not arrive since the start, by the counter in the frames; None without a counter.
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
    """Present state of a joint or signal.

    Attributes:
        name, unit: name and unit of the channel.
        value: value of its last reading; None unless `status` is ok.
        status: status of its last reading (drivers.readings.Status) while that is fresh, otherwise `silent`,
            `link_down` or `starting`.
        age_s: time since its last reading; None if there was none.
        last_status: status of its last reading, however old; None if there was none.
        link: link from which it is read; "" if it is not a channel of the rig.
        kind: joint or signal.
        is_silent: its timeout has passed without a reading, and no reading waits to be stored or decoded.
        silence: why a silent channel's node sends no values although it lives, a clause; "" if that is not known.
    """

    name: str
    unit: str
    value: float | None
    status: str
    age_s: float | None
    last_status: str | None = None
    link: str = ""
    kind: Kind = "signal"
    is_silent: bool = False
    silence: str = ""


@dataclass(frozen=True)
class StationStatus:
    """Present state of a total station.

    Attributes:
        name: name of the station.
        status: status of its last fix (drivers.readings.Status) while that is fresh, otherwise `silent`, `link_down` or
            `starting`.
        lock: lock of its last fix (drivers.readings.LockState) while that is fresh, otherwise `unknown`.
        reason: why the last fix is not ok.
        age_s: time since its last fix; None if there was none.
        fixes: number of fixes since the start.
        last_status, last_lock: status and lock of its last fix, however old; "" if there was none.
        good_age_s: time since its last good fix; None if there was none.
        tilt_ok: whether its last fix reports the compensator as working and in range; None if it does not report this.
        sentence: summary of the state in one clause, for people.
        is_silent: its timeout has passed without a record, and no record waits to be stored or decoded.
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
    is_silent: bool = False


@dataclass(frozen=True)
class GapStatus:
    """An open gap.

    Attributes:
        channel: joint value, signal, station or link.
        reason: drivers.readings.GapReason.
        since_utc_ns: last instant at which the channel was known to be good.
        age_s: time since then.
    """

    channel: str
    reason: str
    since_utc_ns: int
    age_s: float


@dataclass(frozen=True)
class EventStatus:
    """The last event of one kind of a device or link since the start.

    Attributes:
        device, kind, text, code: as in the event (drivers.readings.DeviceEvent).
        utc_ns, age_s: instant of the event, and time since then.
        number: increases from one event to the next, over all devices.
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
    """The gaps of one channel for one reason since the start, including open ones.

    Attributes:
        channel, reason: as in `GapStatus`.
        count: number of gaps.
        missed: number of readings or frames missing in them, as far as known.
        lately: how many of those are missing in the last 30 to 60 s.
        lately_share: their share of the readings that were due in that time, 0 to 1.
    """

    channel: str
    reason: str
    count: int
    missed: int
    lately: int = 0
    lately_share: float = 0.0


@dataclass(frozen=True)
class EventCount:
    """The events of one kind of a device or link since the start.

    Attributes:
        device, kind: as in `EventStatus`.
        count: number of events.
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
        decode_failures: device -> number of captures that could not be decoded since the start.
        decoding: the same with the most frequent reason of each device.
        gaps: open gaps, longest first.
        last_events: last event of each device and kind, newest last.
        writer_lag_s: age of the oldest capture of the last batch when the batch was stored.
        writer_lag_p99_s: 99th percentile of this age over the last minute's batches.
        error: why data cannot be stored at present; None if they can.
        undecoded_s: how far decoding is behind, in real seconds; None until captures of this run are decoded.
        decoded_age_s: the same as an age, in seconds of rigcal's clock: whether devices are silent is known up to then.
        is_behind: captures wait in the store to be decoded, as after a kill: readings and fixes are late.
        is_write_hung: a write to the store does not end; its disk does not answer, or another program holds a lock.
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
    undecoded_s: float | None = 0.0
    decoded_age_s: float | None = 0.0
    is_behind: bool = False
    is_write_hung: bool = False

    def why_no_fix(self) -> str | None:
        """Return why no fix of any station can arrive at present, a clause; None if fixes can arrive."""
        if self.error is not None:
            return f"nothing can be stored: {self.error}"
        if self.is_write_hung:
            return "a write to the store does not end"
        if self.is_behind:
            return "earlier captures are still being decoded"
        if any(is_present(station.status) for station in self.stations):
            return None
        return "; ".join(f"{station.name}: {station.sentence}" for station in self.stations) or "there is no station"
