"""Captures that were not read in time are stored and marked."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from drivers.clock import NS_PER_S, ScaledClock, Stamp, SystemClock
from drivers.readings import DeviceEvent, EventKind, Fix, Gap, GapReason, LinkItem, SerialCapture, Status
from drivers.stall_detector import CLOCK_WAS_SET, LATE_S, NOT_READ_IN_TIME, LateReport, StallDetector
from drivers.stations.decoder import StationDecoder
from drivers.stations.link import StationLink
from drivers.stations.survey import position_mm
from tests.drivers.can_support import DEADLINE_S, START
from tests.drivers.serial_support import ACK_FRAME, plugged_in, running, tracking_record
from tests.drivers.stations.test_station_link import config
from tests.drivers.stopped_clock import AWAY_S, StoppedClock


@pytest.mark.parametrize("rate", [1.0, 25.0])
def test_a_loop_was_away_if_it_took_longer_than_it_may_have_waited(rate: float) -> None:
    clock = ScaledClock(rate, START)

    stalls = StallDetector(clock)
    began = clock.now()

    def at(real_s: float) -> Stamp:
        return began.shifted(round(real_s * rate * NS_PER_S))

    assert not stalls.is_late(at(0.5), waited_s=0.5)
    assert not stalls.is_late(at(0.9), waited_s=0.2)
    back_s = 0.9 + 0.2 + LATE_S + 0.01
    back = at(back_s)
    assert stalls.is_late(back, waited_s=0.2)
    assert stalls.is_late(back.shifted(round(0.9 * LATE_S * rate * NS_PER_S)), waited_s=0.2)
    assert not stalls.is_late(back.shifted(round(1.1 * LATE_S * rate * NS_PER_S)), waited_s=0.2)


def test_what_waited_in_a_port_that_took_long_to_open_may_be_old_and_what_did_not_wait_is_new() -> None:
    clock = ScaledClock(1.0, START)
    opened = clock.now()
    first = opened.shifted(2 * NS_PER_S)
    soon = first.shifted(round(0.9 * LATE_S * NS_PER_S))
    assert StallDetector(clock, opened).is_late(first, waited_s=0.05)
    emptied = StallDetector(clock, opened)
    emptied.found_nothing(first)
    assert not emptied.is_late(first, waited_s=0.05)
    assert not emptied.is_late(soon, waited_s=0.05)


def test_bytes_of_a_station_that_nobody_read_in_time_are_stored_and_marked(tmp_path: Path) -> None:
    clock = StoppedClock()
    passive = config(tmp_path / "tty", profile="passive")
    with plugged_in(tmp_path / "tty") as instrument, running(passive, clock) as collected:
        collected.wait_for_event(EventKind.LINK_UP)
        instrument.send(b"in time")
        collected.wait_for_bytes(7)
        clock.stop()
        instrument.send(b"late")
        told = collected.wait_for_event(EventKind.TIME_DOUBTFUL)
        instrument.send(b"again")
        collected.wait_for_bytes(16)
    assert collected.received_bytes() == b"in timelateagain"
    assert [c.data for c in collected.captures() if c.stamp.is_doubtful] == [b"late"]
    assert told.text.startswith(
        "station: 4 bytes are stored but not used for calibration, as their time is doubtful: the port"
    )
    assert collected.events(EventKind.FRAMES_DROPPED) == []
    (gap,) = collected.gaps()
    assert gap.reason is GapReason.TIME_DOUBTFUL
    assert gap.end is not None
    assert gap.end.since(gap.start) > AWAY_S * NS_PER_S


def test_a_fix_whose_record_nobody_read_in_time_is_not_used(tmp_path: Path) -> None:
    clock = StoppedClock()
    passive = config(tmp_path / "tty", profile="passive")
    record = tracking_record()
    with plugged_in(tmp_path / "tty") as instrument, running(passive, clock) as collected:
        collected.wait_for_event(EventKind.LINK_UP)
        instrument.send(record)
        collected.wait_for_bytes(len(record))
        clock.stop()
        instrument.send(tracking_record(30_000.0))
        collected.wait_for_event(EventKind.TIME_DOUBTFUL)
        instrument.send(record)
        collected.wait_for_bytes(3 * len(record))
    decoder = StationDecoder(passive)
    records = [record for capture in collected.captures() for record in decoder.feed(capture)]
    fixes = [record for record in records if isinstance(record, Fix)]
    assert [fix.status for fix in fixes] == [Status.OK, Status.TIME_DOUBTFUL, Status.OK]
    assert fixes[1].slope_distance_m == pytest.approx(30.0)  # what was measured is kept
    assert fixes[1].reason == (
        "its time is doubtful: the port was not read for a while, because rigcal was stopped or the computer was "
        "too busy"
    )
    assert position_mm(fixes[1]) is None
    assert not any(isinstance(r, DeviceEvent) and r.kind is EventKind.PRISM_JUMP for r in records)


def test_a_station_goes_on_answering_when_nobody_read_for_a_while(tmp_path: Path) -> None:
    clock = StoppedClock()
    with plugged_in(tmp_path / "tty") as instrument, running(config(instrument.path), clock) as collected:
        instrument.expect(b"T34083\x03\r\n")
        clock.stop()
        instrument.send(ACK_FRAME)
        collected.wait_for_event(EventKind.CONFIGURED)


def test_doubts_are_told_once_a_second_at_most_and_once_more_at_the_end() -> None:
    report = LateReport("boom", "frames", START)

    def at(seconds: float) -> Stamp:
        return START.shifted(round(seconds * NS_PER_S))

    assert report.in_time(at(10.0)) == []
    assert report.add(at(10.2), 2, NOT_READ_IN_TIME) == []
    assert report.in_time(at(10.5)) == []
    assert report.add(at(10.9), 3, CLOCK_WAS_SET) == []
    event, gap = report.in_time(at(11.1))
    assert isinstance(event, DeviceEvent)
    assert event.code == 5
    assert gap == Gap("boom", GapReason.TIME_DOUBTFUL, at(10.0), at(11.1))
    assert report.in_time(at(20.0)) == report.end(at(20.5)) == []
    assert report.add(at(20.7), 1, NOT_READ_IN_TIME) == []
    assert report.end(at(21.0))[1] == Gap("boom", GapReason.TIME_DOUBTFUL, at(20.5), at(21.0))


def test_a_link_that_is_never_read_in_time_is_told_while_that_lasts(tmp_path: Path) -> None:
    path = tmp_path / "tty"
    stop, reported = threading.Event(), threading.Event()
    items: list[LinkItem] = []

    def emit(item: LinkItem) -> None:
        items.append(item)
        if isinstance(item, DeviceEvent) and item.kind is EventKind.TIME_DOUBTFUL:
            reported.set()
        if isinstance(item, SerialCapture):
            stop.wait(0.9)  # as a thread that gets no processor time meanwhile

    with plugged_in(path) as instrument:
        link = threading.Thread(
            target=StationLink(config(path, profile="passive"), SystemClock()).run, args=(emit, stop)
        )
        link.start()
        try:
            until = time.monotonic() + 4 * DEADLINE_S
            while not reported.wait(0.1) and time.monotonic() < until:
                instrument.send(tracking_record())
        finally:
            stop.set()
            link.join()
    assert reported.is_set()
    captures = [item for item in items if isinstance(item, SerialCapture)]
    assert all(capture.stamp.is_doubtful for capture in captures[1:]), "the link was read in time"


def test_the_report_of_what_is_late_comes_with_what_is_late_a_second_after_its_first() -> None:
    report = LateReport("boom", "frames", START)
    assert report.add(START.shifted(5 * NS_PER_S), 0, NOT_READ_IN_TIME) == []
    assert report.add(START.shifted(6 * NS_PER_S), 4, NOT_READ_IN_TIME) == []
    now = START.shifted(7 * NS_PER_S)
    event, gap = report.add(now, 5, NOT_READ_IN_TIME)
    assert isinstance(event, DeviceEvent)
    assert (event.code, gap) == (9, Gap("boom", GapReason.TIME_DOUBTFUL, START, now))
    assert report.add(now.shifted(NS_PER_S // 2), 1, NOT_READ_IN_TIME) == []
