"""Collects the results of the writer, and gives a snapshot of the state at any time."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from daemon.acquisition.link_intake import LinkIntake
from daemon.acquisition.status.decode_failures import FailureCounter
from daemon.acquisition.status.present import (
    NOTHING_EXPECTED,
    SILENT,
    Expected,
    ExpectedChannel,
    ExpectedStation,
    is_present,
    present_status,
    station_sentence,
)
from daemon.acquisition.status.recent_counts import RecentCounts
from daemon.acquisition.status.silence import why_silent
from daemon.acquisition.status.snapshot import (
    AcquisitionStatus,
    ChannelStatus,
    EventCount,
    EventStatus,
    FrameStatus,
    GapCount,
    GapStatus,
    LinkStatus,
    StationStatus,
)
from drivers.can.summary import CanSummary
from drivers.clock import NS_PER_S, Clock, Stamp
from drivers.readings import (
    Capture,
    DecodeFailure,
    DeviceEvent,
    EventKind,
    Fix,
    Gap,
    GapReason,
    LockState,
    Reading,
    Record,
    Status,
)

RATE_WINDOW_S = 2.0  # real time, like batches
RATE_WINDOW_BATCHES = 40  # RATE_WINDOW_S at the usual 20 batches a second
LAG_WINDOW_BATCHES = 1200  # a minute at the usual 20 batches a second


@dataclass
class _Link:
    """Last record of a link, and its counters."""

    since: Stamp
    up: bool | None = None
    reason: str = ""
    dropped: int = 0
    dropped_at: Stamp | None = None
    restarts: int = 0
    restarted_at: Stamp | None = None


class StatusBoard:
    """Collects the results of the writer; may be read from any thread.

    Args:
        clock: clock for ages and lags.
        expected: devices from which data are expected; a device that never sent data is known only from here.
    """

    def __init__(self, clock: Clock, expected: Expected = NOTHING_EXPECTED) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._started = clock.now()
        real_s = clock.real_seconds(1.0) or 1.0  # 0 for a clock that moves only when told to
        self._rate_window_ns = round(RATE_WINDOW_S / real_s * NS_PER_S)
        self._channels = {channel.name: channel for channel in expected.channels}
        self._stations = {station.name: station for station in expected.stations}
        self._links: dict[str, _Link] = {}
        self._totals: Counter[str] = Counter()
        self._history: deque[tuple[int, Counter[str]]] = deque(maxlen=RATE_WINDOW_BATCHES)
        self._lags_ns: deque[int] = deque(maxlen=LAG_WINDOW_BATCHES)
        self._readings: dict[str, Reading] = {}
        self._fixes: dict[str, Fix] = {}
        self._good_fixes: dict[str, Fix] = {}
        self._fix_counts: Counter[str] = Counter()
        self._failures = FailureCounter()
        self._lately_missed = RecentCounts()
        self._gaps: dict[tuple[str, str], Gap] = {}
        self._gap_counts: Counter[tuple[str, str]] = Counter()
        self._missed: Counter[tuple[str, str]] = Counter()
        self._event_counts: Counter[tuple[str, str]] = Counter()
        self._events: dict[tuple[str, str, bool], tuple[int, DeviceEvent]] = {}
        self._event_count = 0
        self._error: str | None = None
        self._decoded_until: Stamp | None = None

    def set_error(self, error: str | None) -> None:
        """Set why nothing can be stored; None when it can again."""
        with self._lock:
            self._error = error

    def recall(self, events: Sequence[DeviceEvent]) -> None:
        """Restore events of expected channels from before this run, without counting them."""
        with self._lock:
            for event in events:
                if event.device in self._channels:
                    self._event_count += 1
                    self._events[self._place(event)] = self._event_count, event

    def captured(self, captures: Sequence[Capture]) -> None:
        """Count captures that have just been stored, by link, and note how long the oldest one has waited."""
        now_ns = self._clock.monotonic_ns()
        counts = Counter([capture.link for capture in captures])
        with self._lock:
            self._totals.update(counts)
            self._history.append((now_ns, self._totals.copy()))
            if captures:
                self._lags_ns.append(now_ns - min(capture.stamp.monotonic_ns for capture in captures))

    def recorded(self, records: Sequence[Record], until: Stamp | None = None) -> None:
        """Note the newest readings, fixes and events of records that have just been stored.

        Args:
            records: the records.
            until: all captures up to this time have been decoded; None if no time has passed.
        """
        with self._lock:
            self._decoded_until = until or self._decoded_until
            self._tell_time(self._clock.monotonic_ns())
            decoded: list[str] = []
            malformed = Status.MALFORMED
            for record in records:
                if isinstance(record, Reading):
                    self._readings[record.channel] = record
                    if record.status is not malformed:
                        decoded.append(record.channel)
                elif isinstance(record, Fix):
                    self._fixes[record.station] = record
                    self._fix_counts[record.station] += 1
                    decoded.append(record.station)
                    if record.status is Status.OK:
                        self._good_fixes[record.station] = record
                elif isinstance(record, DecodeFailure):
                    self._failures.add(record.device, record.reason)
                elif isinstance(record, DeviceEvent):
                    self._happened(record)
                else:
                    self._note_gap(record)
            self._failures.decoded.update(decoded)

    def _tell_time(self, now_ns: int) -> None:
        self._failures.tell_time(now_ns)
        self._lately_missed.tell_time(now_ns)

    def _note_gap(self, gap: Gap) -> None:
        key = gap.channel, gap.reason.value
        was_open = self._gaps.pop(key, None)
        if gap.end is None:
            self._gaps[key] = gap
        if was_open is None or was_open.start != gap.start:  # a gap is recorded when it opens and again when it closes
            self._gap_counts[key] += 1
        if gap.end is not None:
            self._missed[key] += gap.missed or 0
            if gap.reason is GapReason.FRAMES_LOST:
                self._lately_missed.add(gap.channel, gap.missed or 0)

    def _place(self, event: DeviceEvent) -> tuple[str, str, bool]:
        """Return the key of the events that this event replaces.

        What a device reports, and what rigcal says about it, are kept apart. All events of a link are rigcal's own.
        """
        is_kept_apart = event.kind in (EventKind.ALARM, EventKind.WARNING) and event.device not in self._links
        return event.device, event.kind, is_kept_apart and event.code is None

    def _happened(self, event: DeviceEvent) -> None:
        self._event_count += 1
        self._event_counts[event.device, event.kind.value] += 1
        self._events[self._place(event)] = self._event_count, event
        if event.kind in (EventKind.LINK_UP, EventKind.LINK_LOST):
            link = self._links.setdefault(event.device, _Link(event.stamp))
            is_up = event.kind is EventKind.LINK_UP
            if link.up is not is_up or is_up:  # after reopening a link, its devices start again
                link.since = event.stamp
            link.up, link.reason = is_up, "" if is_up else event.text

    def snapshot(
        self,
        intakes: Sequence[LinkIntake],
        summaries: Sequence[CanSummary],
        defects: Mapping[str, Stamp] = MappingProxyType({}),
        *,
        is_behind: bool = False,
        is_write_hung: bool = False,
    ) -> AcquisitionStatus:
        """Return the state of acquisition at this moment.

        Args:
            intakes: intakes of all links.
            summaries: summaries of the CAN links.
            defects: link -> when its decoder last failed by an internal error.
            is_behind: as in `AcquisitionStatus`.
            is_write_hung: as in `AcquisitionStatus`.
        """
        heard = {summary.link: summary for summary in summaries}
        now = self._clock.now()
        with self._lock:
            self._tell_time(now.monotonic_ns)
            lags = sorted(self._lags_ns)
            last_lag = self._lags_ns[-1] if lags else 0
            links = [self._link(intake, heard.get(intake.name), defects.get(intake.name), now) for intake in intakes]
            by_name = {link.name: link for link in links}
            decoded_age_s = None if self._decoded_until is None else _age_s(self._decoded_until, now)
            frames = _frames(summaries)
            events = sorted(
                (_event(number, event, now) for number, event in self._events.values()), key=lambda e: e.number
            )
            channels = [self._channel(name, by_name, now) for name in self._known(self._channels, self._readings)]
            return AcquisitionStatus(
                links=links,
                frames=frames,
                channels=[self._explained(channel, by_name, frames, events) for channel in channels],
                stations=[self._station(name, by_name, now) for name in self._known(self._stations, self._fixes)],
                decode_failures=self._failures.totals(),
                decoding=self._failures.status(),
                gaps=sorted((_gap(gap, now) for gap in self._gaps.values()), key=lambda gap: -gap.age_s),
                last_events=events,
                gap_counts=[self._gap_count(*key) for key in self._gap_counts],
                event_counts=[EventCount(device, kind, count) for (device, kind), count in self._event_counts.items()],
                writer_lag_s=last_lag / NS_PER_S,
                writer_lag_p99_s=lags[int(0.99 * (len(lags) - 1))] / NS_PER_S if lags else 0.0,
                error=self._error,
                undecoded_s=None if decoded_age_s is None else self._clock.real_seconds(decoded_age_s),
                decoded_age_s=decoded_age_s,
                is_behind=is_behind,
                is_write_hung=is_write_hung,
            )

    def _gap_count(self, channel: str, reason: str) -> GapCount:
        lately = self._lately_missed[channel] if reason == GapReason.FRAMES_LOST else 0
        return GapCount(
            channel,
            reason,
            self._gap_counts[channel, reason],
            self._missed[channel, reason],
            lately,
            lately / (lately + self._failures.decoded[channel]) if lately else 0.0,
        )

    @staticmethod
    def _known(expected: Mapping[str, object], heard: Mapping[str, object]) -> list[str]:
        """Return the expected devices in their order, then other devices that have sent data."""
        return [*dict.fromkeys([*expected, *heard])]

    def _channel(self, name: str, links: Mapping[str, LinkStatus], now: Stamp) -> ChannelStatus:
        reading = self._readings.get(name)
        unit = reading.unit if reading is not None else ""
        expected = self._channels.get(name, ExpectedChannel(name, unit, "", "signal", 0.0))
        last, age_s = (None, None) if reading is None else (reading.status.value, _age_s(reading.stamp, now))
        status = present_status(last, age_s, expected.timeout_s, *_open(links.get(expected.link)))
        return ChannelStatus(
            name=name,
            unit=expected.unit,
            value=reading.value if reading is not None and is_present(status) else None,
            status=status,
            age_s=age_s,
            last_status=last,
            link=expected.link,
            kind=expected.kind,
            is_silent=self._is_silent(last, age_s, expected.timeout_s, links.get(expected.link), now),
        )

    def _explained(
        self,
        channel: ChannelStatus,
        links: Mapping[str, LinkStatus],
        frames: Sequence[FrameStatus],
        events: Sequence[EventStatus],
    ) -> ChannelStatus:
        """Return the channel's state with the reason of its silence, if its node shows one."""
        expected = self._channels.get(channel.name)
        if not channel.is_silent or expected is None or expected.node is None:
            return channel
        place = expected.link, expected.node
        names = [other.name for other in self._channels.values() if (other.link, other.node) == place]
        since_s = _open(links.get(expected.link))[1] if channel.age_s is None else channel.age_s
        return replace(channel, silence=why_silent(channel, expected.node, names, since_s, frames, events))

    def _station(self, name: str, links: Mapping[str, LinkStatus], now: Stamp) -> StationStatus:
        fix, good = self._fixes.get(name), self._good_fixes.get(name)
        expected = self._stations.get(name, ExpectedStation(name, 0.0))
        last, age_s = (None, None) if fix is None else (fix.status.value, _age_s(fix.stamp, now))
        status = present_status(last, age_s, expected.timeout_s, *_open(links.get(name)))
        last_lock, reason = ("", "") if fix is None else (fix.lock.value, fix.reason)
        is_silent = self._is_silent(last, age_s, expected.timeout_s, links.get(name), now)
        is_late = status == SILENT and not is_silent
        return StationStatus(
            name=name,
            status=status,
            lock=last_lock if is_present(status) else LockState.UNKNOWN.value,
            reason=reason,
            age_s=age_s,
            fixes=self._fix_counts[name],
            last_status=last or "",
            last_lock=last_lock,
            good_age_s=None if good is None else _age_s(good.stamp, now),
            tilt_ok=None if fix is None else fix.tilt_ok,
            sentence=station_sentence(status, age_s, last_lock, last or "", reason, is_late=is_late),
            is_silent=is_silent,
        )

    def _is_silent(
        self, last: str | None, age_s: float | None, timeout_s: float, link: LinkStatus | None, now: Stamp
    ) -> bool:
        """Return True if a device was silent when the newest capture that has been decoded was received."""
        if self._decoded_until is None:
            return False
        undecoded_s = max(0.0, _age_s(self._decoded_until, now))
        link_up, since_s = _open(link)
        then_s = None if age_s is None else age_s - undecoded_s
        return present_status(last, then_s, timeout_s, link_up, since_s - undecoded_s) == SILENT

    def _per_s(self, link: str, now: Stamp) -> float:
        """Return a link's recent captures per second, up to now: while all links are silent there are no batches."""
        if not self._history:
            return 0.0
        since_ns = now.monotonic_ns - self._rate_window_ns
        before_ns, before = next((one for one in reversed(self._history) if one[0] <= since_ns), self._history[0])
        passed_ns = now.monotonic_ns - max(before_ns, since_ns)
        return (self._totals[link] - before[link]) * NS_PER_S / max(passed_ns, 1)

    def _link(
        self, intake: LinkIntake, heard: CanSummary | None, decoder_failed: Stamp | None, now: Stamp
    ) -> LinkStatus:
        name = intake.name
        link = self._links.setdefault(name, _Link(self._started))
        if link.up is None and self._totals[name]:
            link.up = True  # a log that is played back contains no report of a port
        if intake.dropped > link.dropped:
            link.dropped, link.dropped_at = intake.dropped, now
        if intake.restarts > link.restarts:
            link.restarts, link.restarted_at = intake.restarts, now
        return LinkStatus(
            name=name,
            up=link.up,
            captures=self._totals[name],
            captures_per_s=self._per_s(name, now),
            dropped=intake.dropped,
            queued=intake.queued,
            restarts=intake.restarts,
            error_frames=None if heard is None else heard.error_frames,
            unlisted_frames=None if heard is None else heard.unlisted_frames,
            since_s=_age_s(link.since, now),
            reason=link.reason,
            dropped_age_s=None if link.dropped_at is None else _age_s(link.dropped_at, now),
            restarted_age_s=None if link.restarted_at is None else _age_s(link.restarted_at, now),
            decoder_failed_age_s=None if decoder_failed is None else _age_s(decoder_failed, now),
        )


def _age_s(stamp: Stamp, now: Stamp) -> float:
    return now.since(stamp) / NS_PER_S


def _open(link: LinkStatus | None) -> tuple[bool | None, float]:
    """Return whether a link is open, and for how long its state has lasted; unknown for a missing link."""
    return (None, 0.0) if link is None else (link.up, link.since_s)


def _gap(gap: Gap, now: Stamp) -> GapStatus:
    return GapStatus(gap.channel, gap.reason.value, gap.start.utc_ns, _age_s(gap.start, now))


def _event(number: int, event: DeviceEvent, now: Stamp) -> EventStatus:
    return EventStatus(
        event.device,
        event.kind.value,
        event.text,
        event.code,
        event.stamp.utc_ns,
        _age_s(event.stamp, now),
        number,
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
