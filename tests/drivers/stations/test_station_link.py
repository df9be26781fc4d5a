"""The station's link on real pseudo-terminals, with real threads."""

from __future__ import annotations

import itertools
import threading
import time
from pathlib import Path

import pytest

from drivers.clock import NS_PER_S, ScaledClock, SystemClock
from drivers.outage import BACKOFF_MAX_S
from drivers.readings import DeviceEvent, EventKind, Fix, Gap, GapReason, LinkItem, SerialCapture, Status
from drivers.stations.config import StationConfig
from drivers.stations.decoder import StationDecoder
from drivers.stations.link import StationLink
from tests.drivers.serial_support import (
    ACK_FRAME,
    DEADLINE_S,
    SET_REPLY,
    SLOPE_MM,
    Collected,
    Instrument,
    plugged_in,
    running,
    tracking_record,
)
from tests.drivers.stopped_clock import StoppedClock

T34 = b"T34083\x03\r\n"
C11 = b"C11067\x03\r\n"


def config(path: Path, **settings: object) -> StationConfig:
    return StationConfig.model_validate({"serial": {"path": str(path)}, "poll_interval_s": 0.01, **settings})


def track(instrument: Instrument) -> None:
    """Acknowledge the set-up."""
    instrument.expect(T34)
    instrument.send(ACK_FRAME)


def test_a_tracking_station_is_polled_and_every_byte_is_captured_in_both_directions(tmp_path: Path) -> None:
    with plugged_in(tmp_path / "tty") as instrument, running(config(instrument.path)) as collected:
        collected.wait_for_event(EventKind.LINK_UP)
        track(instrument)
        answer = ACK_FRAME + tracking_record()
        for _ in range(3):
            instrument.expect(C11)
            instrument.send(answer)
        collected.wait_for_bytes(len(ACK_FRAME) + 3 * len(answer))
        assert collected.received_bytes() == ACK_FRAME + 3 * answer
        sent = b"".join(capture.data for capture in collected.captures() if capture.is_transmitted)
        assert sent.startswith(T34 + 3 * C11)
        assert collected.events(EventKind.CONFIGURED)[0].text == "station acknowledged T34"
        stamps = [capture.stamp.monotonic_ns for capture in collected.captures()]
        assert stamps == sorted(stamps)


def test_the_captures_decode_to_fixes(tmp_path: Path) -> None:
    with plugged_in(tmp_path / "tty") as instrument, running(config(instrument.path)) as collected:
        track(instrument)
        instrument.expect(C11)
        instrument.send(ACK_FRAME)
        instrument.send(tracking_record())
        collected.wait_for_bytes(2 * len(ACK_FRAME) + len(tracking_record()))
    decoder = StationDecoder(config(tmp_path))
    (fix,) = [record for capture in collected.captures() for record in decoder.feed(capture) if isinstance(record, Fix)]
    assert fix.status is Status.OK
    assert fix.slope_distance_m == pytest.approx(10.0)


def test_a_port_counts_as_read_up_to_its_last_read_and_not_while_it_is_gone(tmp_path: Path) -> None:
    collected, stop = Collected(), threading.Event()
    with plugged_in(tmp_path / "tty") as instrument:
        link = StationLink(config(instrument.path), SystemClock())
        assert link.read_until is None
        thread = threading.Thread(target=link.run, args=(collected.emit, stop))
        thread.start()
        try:
            collected.wait_for_event(EventKind.LINK_UP)
            assert link.read_until is not None
            instrument.send(ACK_FRAME)
            collected.wait_for_bytes(len(ACK_FRAME))
            heard = collected.captures()[-1].stamp
            deadline = time.monotonic() + DEADLINE_S  # it waits for more, and finds nothing
            while link.read_until is None or link.read_until.since(heard) <= 0:
                assert time.monotonic() < deadline
                time.sleep(0.01)
            instrument.unplug()
            collected.wait_for_event(EventKind.LINK_LOST, 2)  # and cannot be opened again
            assert link.read_until is None
        finally:
            stop.set()
            thread.join(DEADLINE_S)


def test_all_that_a_terminal_holds_is_read_before_a_link_stops(tmp_path: Path) -> None:
    """A read of a terminal returns 4 KiB at most, however much waits."""
    collected, stop, go_on = Collected(), threading.Event(), threading.Event()

    def emit(item: LinkItem) -> None:
        collected.emit(item)
        if isinstance(item, SerialCapture) and not item.is_transmitted:
            go_on.wait(DEADLINE_S)

    with plugged_in(tmp_path / "tty") as instrument:
        link = StationLink(config(instrument.path), SystemClock())
        thread = threading.Thread(target=link.run, args=(emit, stop))
        thread.start()
        collected.wait_for_event(EventKind.LINK_UP)
        sent = [b"%06d\r\n" % number for number in range(1500)]
        instrument.send(sent[0])
        collected.wait_for_bytes(len(sent[0]))
        instrument.send(b"".join(sent[1:]))
        stop.set()
        go_on.set()
        thread.join(DEADLINE_S)
    assert collected.received_bytes() == b"".join(sent)


def test_the_link_survives_unplugging_and_plugging_in_again(tmp_path: Path) -> None:
    with plugged_in(tmp_path / "tty") as instrument, running(config(instrument.path)) as collected:
        track(instrument)
        instrument.unplug()
        lost = collected.wait_for_event(EventKind.LINK_LOST)
        assert "check that the adapter is plugged in" in lost.text
        collected.wait_for_event(EventKind.LINK_LOST, 2)  # and cannot be opened again
        assert "no such port" in collected.events(EventKind.LINK_LOST)[1].text
        instrument.plug_in()
        collected.wait_for_event(EventKind.LINK_UP, 2)
        track(instrument)  # a new port is a new conversation
        opened, closed = collected.gaps()
        assert (opened.reason, opened.end) == (GapReason.LINK_DOWN, None)
        assert (closed.reason, closed.start) == (GapReason.LINK_DOWN, opened.start)
        assert closed.end is not None
        assert closed.end.monotonic_ns > closed.start.monotonic_ns


def test_a_station_that_is_plugged_in_after_the_start_is_found(tmp_path: Path) -> None:
    clock = ScaledClock(100.0, SystemClock().now())
    with plugged_in(tmp_path / "tty") as instrument:
        instrument.unplug()
        with running(config(instrument.path), clock) as collected:
            collected.wait_for_event(EventKind.LINK_LOST)
            clock.sleep(30.0)  # several attempts
            instrument.plug_in()
            instrument.expect(T34)
            assert len(collected.events(EventKind.LINK_LOST)) == 1  # once a cause, not once an attempt


def test_a_passive_listener_never_writes(tmp_path: Path) -> None:
    passive = config(tmp_path / "tty", profile="passive")
    with plugged_in(tmp_path / "tty") as instrument, running(passive) as collected:
        collected.wait_for_event(EventKind.LINK_UP)
        answer = SLOPE_MM + b"\x03\r\n"
        for count in range(1, 4):
            instrument.send(answer)
            collected.wait_for_bytes(count * len(answer))
        assert not instrument.has_received()
        assert not any(capture.is_transmitted for capture in collected.captures())
    with plugged_in(tmp_path / "tty") as instrument:
        with running(passive, ScaledClock(1000.0, SystemClock().now())) as collected:
            collected.wait_for_event(EventKind.LINK_UP)
            instrument.send(b"x")
            collected.wait_for(lambda: collected.received_bytes() == b"x")
        assert not instrument.has_received()  # nor when it stops


def test_a_streaming_set_station_is_stopped_when_the_link_stops(tmp_path: Path) -> None:
    sokkia = config(tmp_path / "tty", profile="sokkia_set", init=["Xe"])
    with plugged_in(tmp_path / "tty") as instrument:
        with running(sokkia, ScaledClock(10.0, SystemClock().now())) as collected:
            instrument.expect(b"\x12\r\nXe\r\n")
            instrument.send(b"\x06")
            instrument.expect(b"\x11\r\n")
            instrument.send(SET_REPLY + b"\r\n")
            collected.wait_for(lambda: collected.received_bytes() == b"\x06" + SET_REPLY + b"\r\n")
        instrument.expect(b"\x12\r\n")


def test_a_classic_station_gets_its_acknowledgement(tmp_path: Path) -> None:
    classic = config(tmp_path / "tty", profile="topcon_classic", measure="coordinates")
    with plugged_in(tmp_path / "tty") as instrument, running(classic):
        instrument.expect(b"Z64088\x03\r\n")
        instrument.send(ACK_FRAME)
        instrument.expect(b"C067\x03\r\n")
        instrument.send(ACK_FRAME + SLOPE_MM + b"\x03\r\n")
        instrument.expect(ACK_FRAME + b"C067\x03\r\n")


def test_a_clock_that_runs_fast_shortens_the_time_outs(tmp_path: Path) -> None:
    # 2 s without acknowledgement and 20 s without an answer pass in a second.
    clock = ScaledClock(50.0, SystemClock().now())
    with (
        plugged_in(tmp_path / "tty") as instrument,
        running(config(instrument.path), clock) as collected,
    ):
        instrument.expect(T34 + T34)
        error = collected.wait_for_event(EventKind.INSTRUMENT_ERROR)
        assert "did not answer T34 within 20 s" in error.text


def test_a_port_that_is_unplugged_again_and_again_is_open_soon_each_time(tmp_path: Path) -> None:
    clock = ScaledClock(10.0, SystemClock().now())
    with (
        plugged_in(tmp_path / "tty") as instrument,
        running(config(instrument.path), clock) as collected,
    ):
        for count in (1, 2, 3):
            collected.wait_for_event(EventKind.LINK_UP, count)
            clock.sleep(3.0)
            instrument.unplug()
            collected.wait_for_event(EventKind.LINK_LOST, count)
            instrument.plug_in()
        collected.wait_for_event(EventKind.LINK_UP, 4)
        for opened, closed in zip(collected.gaps()[::2], collected.gaps()[1::2], strict=True):
            assert closed.end is not None
            assert closed.end.since(opened.start) < 10 * 2e9  # 2 real seconds


@pytest.mark.slow
def test_a_device_that_was_away_for_long_is_open_within_two_seconds_of_its_return(tmp_path: Path) -> None:
    """On real time: what tells is the directory, and not the longest pause, which 8 s without it have reached."""
    with plugged_in(tmp_path / "tty") as instrument, running(config(instrument.path)) as collected:
        collected.wait_for_event(EventKind.LINK_UP)
        instrument.unplug()
        collected.wait_for_event(EventKind.LINK_LOST, 2)
        time.sleep(4.0)  # attempts at 0.5, 1.5 and 3.5 s: the next would be at 5.5 s, and before at 7.5 s
        instrument.plug_in()
        back = time.monotonic_ns()
        collected.wait_for_event(EventKind.LINK_UP, 2)
        assert time.monotonic_ns() - back < 2e9


def test_a_port_that_fails_as_soon_as_it_is_open_is_not_tried_without_a_pause(tmp_path: Path) -> None:
    with plugged_in(tmp_path / "tty") as instrument:
        # A hung-up pseudo-terminal can be opened by its path as long as somebody holds it, and every read fails.
        with running(config(instrument.path)) as collected:
            for count in range(1, 4):
                collected.wait_for_event(EventKind.LINK_UP, count)
                instrument.unplug()
                instrument.plug_in()  # at once: a new entry in the directory each time
            opened = [event.stamp.monotonic_ns for event in collected.events(EventKind.LINK_UP)]
        pauses = [later - earlier for earlier, later in itertools.pairwise(opened)]
        assert all(pause >= min(0.5 * 2**k, BACKOFF_MAX_S) * NS_PER_S for k, pause in enumerate(pauses))


def test_the_port_is_free_when_the_link_has_stopped(tmp_path: Path) -> None:
    with plugged_in(tmp_path / "tty") as instrument:
        for _ in range(2):
            with running(config(instrument.path)) as collected:
                collected.wait_for_event(EventKind.LINK_UP)
            assert not collected.events(EventKind.LINK_LOST)


def test_what_came_while_the_program_was_stopped_and_the_adapter_pulled_lies_in_the_gap(tmp_path: Path) -> None:
    clock, stop, lost = StoppedClock(), threading.Event(), threading.Event()
    items: list[LinkItem] = []
    with plugged_in(tmp_path / "tty") as instrument:

        def emit(item: LinkItem) -> None:
            items.append(item)
            if isinstance(item, SerialCapture):
                clock.stop()
                instrument.unplug()
            elif isinstance(item, DeviceEvent) and item.kind is EventKind.LINK_LOST:
                lost.set()
            elif isinstance(item, DeviceEvent) and item.kind is EventKind.LINK_UP:
                instrument.send(tracking_record())

        link = StationLink(config(instrument.path, profile="passive"), clock)
        thread = threading.Thread(target=link.run, args=(emit, stop))
        thread.start()
        assert lost.wait(20.0)
        stop.set()
        thread.join()
    (capture,) = [item for item in items if isinstance(item, SerialCapture)]
    (gap,) = [item for item in items if isinstance(item, Gap)]
    assert (gap.reason, gap.start, gap.end) == (GapReason.LINK_DOWN, capture.stamp, None)
