"""What acquisition is doing, as a snapshot for `rigcal status` and the interfaces."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

from daemon.link_intake import LinkIntake
from drivers.can_summary import CanSummary
from drivers.clock import NS_PER_S, Clock
from drivers.readings import Capture, DecodeFailure, DeviceEvent, EventKind, Fix, Reading, Record

RATE_WINDOW_BATCHES = 40
LAG_WINDOW_BATCHES = 1200  # a minute at the usual 20 batches a second


@dataclass(frozen=True)
class LinkStatus:
    """A link.

    Attributes:
        name: of the link.
        up: its port is open; None before the first word from it.
        captures: stored since the start.
        captures_per_s: lately.
        dropped: captures that found the queue full since the start.
        queued: waiting to be stored.
        restarts: how often its loop ended and was started again.
        error_frames: CAN error frames since the start; None for other links.
        unlisted_frames: CAN frames of identifiers that are too many for `AcquisitionStatus.frames`; None likewise.
    """

    name: str
    up: bool | None
    captures: int
    captures_per_s: float
    dropped: int
    queued: int
    restarts: int
    error_frames: int | None
    unlisted_frames: int | None


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
    """A joint or signal.

    Attributes:
        name, unit: of the channel.
        value: of its last reading; None unless `status` is ok.
        status: of its last reading (drivers.readings.Status).
        age_s: since its last reading.
    """

    name: str
    unit: str
    value: float | None
    status: str
    age_s: float


@dataclass(frozen=True)
class StationStatus:
    """A total station.

    Attributes:
        name: of the station.
        status: of its last fix (drivers.readings.Status).
        lock: of its last fix (drivers.readings.LockState).
        reason: why the last fix is not ok.
        age_s: since its last fix.
        fixes: stored since the start.
    """

    name: str
    status: str
    lock: str
    reason: str
    age_s: float
    fixes: int


@dataclass(frozen=True)
class AcquisitionStatus:
    """A snapshot of acquisition.

    Attributes:
        links, frames, channels, stations: see their classes.
        decode_failures: device -> how many captures could not be decoded since the start.
        writer_lag_s: how old the oldest capture of the last batch was when the batch was stored.
        writer_lag_p99_s: the same, of the last minute's batches, 99th percentile.
        error: why something cannot be stored at present; None when all is well.
        is_behind: captures wait in the store to be decoded, as after a kill: readings and fixes come late.
    """

    links: list[LinkStatus]
    frames: list[FrameStatus]
    channels: list[ChannelStatus]
    stations: list[StationStatus]
    decode_failures: dict[str, int]
    writer_lag_s: float
    writer_lag_p99_s: float
    error: str | None
    is_behind: bool


class StatusBoard:
    """Gathers what the writer does; may be read from any thread.

    Args:
        clock: for ages and lags.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._up: dict[str, bool] = {}
        self._totals: Counter[str] = Counter()
        self._history: deque[tuple[int, Counter[str]]] = deque(maxlen=RATE_WINDOW_BATCHES)
        self._lags_ns: deque[int] = deque(maxlen=LAG_WINDOW_BATCHES)
        self._readings: dict[str, Reading] = {}
        self._fixes: dict[str, Fix] = {}
        self._fix_counts: Counter[str] = Counter()
        self._failures: Counter[str] = Counter()
        self._error: str | None = None

    def set_error(self, error: str | None) -> None:
        """Why nothing can be stored; None when it can again."""
        with self._lock:
            self._error = error

    def captured(self, captures: Sequence[Capture]) -> None:
        """These captures are stored now."""
        now_ns = self._clock.monotonic_ns()
        counts = Counter([capture.link for capture in captures])
        with self._lock:
            self._totals.update(counts)
            self._history.append((now_ns, self._totals.copy()))
            if captures:
                self._lags_ns.append(now_ns - min(capture.stamp.monotonic_ns for capture in captures))

    def recorded(self, records: Sequence[Record]) -> None:
        """These records are stored now."""
        with self._lock:
            for record in records:
                if isinstance(record, Reading):
                    self._readings[record.channel] = record
                elif isinstance(record, Fix):
                    self._fixes[record.station] = record
                    self._fix_counts[record.station] += 1
                elif isinstance(record, DecodeFailure):
                    self._failures[record.device] += 1
                elif isinstance(record, DeviceEvent) and record.kind in (EventKind.LINK_UP, EventKind.LINK_LOST):
                    self._up[record.device] = record.kind is EventKind.LINK_UP

    def snapshot(
        self, intakes: Sequence[LinkIntake], summaries: Sequence[CanSummary], *, is_behind: bool
    ) -> AcquisitionStatus:
        """All of it, now.

        Args:
            intakes: of all links.
            summaries: of the CAN links.
            is_behind: as `AcquisitionStatus` has it.
        """
        heard = {summary.link: summary for summary in summaries}
        now_ns = self._clock.monotonic_ns()
        with self._lock:
            lags = sorted(self._lags_ns)
            last_lag = self._lags_ns[-1] if lags else 0
            return AcquisitionStatus(
                links=[self._link(intake, heard.get(intake.name)) for intake in intakes],
                frames=_frames(summaries),
                channels=[
                    ChannelStatus(
                        r.channel, r.unit, r.value, r.status.value, (now_ns - r.stamp.monotonic_ns) / NS_PER_S
                    )
                    for r in self._readings.values()
                ],
                stations=[
                    StationStatus(
                        name=f.station,
                        status=f.status.value,
                        lock=f.lock.value,
                        reason=f.reason,
                        age_s=(now_ns - f.stamp.monotonic_ns) / NS_PER_S,
                        fixes=self._fix_counts[f.station],
                    )
                    for f in self._fixes.values()
                ],
                decode_failures=dict(self._failures),
                writer_lag_s=last_lag / NS_PER_S,
                writer_lag_p99_s=lags[int(0.99 * (len(lags) - 1))] / NS_PER_S if lags else 0.0,
                error=self._error,
                is_behind=is_behind,
            )

    def _link(self, intake: LinkIntake, heard: CanSummary | None) -> LinkStatus:
        name, per_s = intake.name, 0.0
        if len(self._history) > 1:
            (before_ns, before), (after_ns, after) = self._history[0], self._history[-1]
            per_s = (after[name] - before[name]) * NS_PER_S / max(after_ns - before_ns, 1)
        return LinkStatus(
            name=name,
            up=self._up.get(name),
            captures=self._totals[name],
            captures_per_s=per_s,
            dropped=intake.dropped,
            queued=intake.queued,
            restarts=intake.restarts,
            error_frames=None if heard is None else heard.error_frames,
            unlisted_frames=None if heard is None else heard.unlisted_frames,
        )


def _frames(summaries: Sequence[CanSummary]) -> list[FrameStatus]:
    return [
        FrameStatus(
            link=summary.link,
            identifier=f"{one.arbitration_id:0{8 if one.is_extended else 3}X}",
            names=one.names,
            count=one.count,
            rate_per_s=one.rate_per_s,
            age_s=one.age_s,
            missed=one.missed,
        )
        for summary in summaries
        for one in summary.ids
    ]
