"""What was not read in time has no time of its own, and is given up."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.attendance import LATE_S, Attendance
from drivers.clock import NS_PER_S, ScaledClock, Stamp, SystemClock
from drivers.readings import EventKind, GapReason
from tests.drivers import can_support
from tests.drivers.can_support import START, message, unused_channel, virtual_bus, virtual_link
from tests.drivers.serial_support import ACK_FRAME, plugged_in, running
from tests.drivers.test_station_link import config

AWAY_S = 10.0


class StoppedClock(SystemClock):
    """The host's clock in a program that can be stopped for AWAY_S at once."""

    def __init__(self) -> None:
        super().__init__()
        self._away_ns = 0

    def stop(self) -> None:
        """As SIGSTOP and, later, SIGCONT do."""
        self._away_ns += round(AWAY_S * NS_PER_S)

    def now(self) -> Stamp:
        return super().now().shifted(self._away_ns)

    def monotonic_ns(self) -> int:
        return super().monotonic_ns() + self._away_ns


@pytest.mark.parametrize("rate", [1.0, 25.0])
def test_a_loop_was_away_if_it_took_longer_than_it_may_have_waited(rate: float) -> None:
    clock = ScaledClock(rate, START)

    def at(real_s: float) -> Stamp:
        return attendance.left.shifted(round(real_s * rate * NS_PER_S))

    attendance = Attendance(clock)
    assert not attendance.is_late(at(0.5), waited_s=0.5)
    assert not attendance.is_late(at(0.9), waited_s=0.2)
    assert attendance.left == at(0.0)
    left, back_s = at(0.9), 0.9 + 0.2 + LATE_S + 0.01
    back = at(back_s)
    assert attendance.is_late(back, waited_s=0.2)
    assert attendance.left == left
    assert attendance.is_late(back.shifted(round(0.9 * LATE_S * rate * NS_PER_S)), waited_s=0.2)
    assert not attendance.is_late(back.shifted(round(1.1 * LATE_S * rate * NS_PER_S)), waited_s=0.2)


def test_bytes_of_a_station_that_nobody_read_in_time_are_lost_and_told(tmp_path: Path) -> None:
    clock = StoppedClock()
    passive = config(tmp_path / "tty", profile="passive")
    with plugged_in(tmp_path / "tty") as instrument, running(passive, clock) as collected:
        collected.wait_for_event(EventKind.LINK_UP)
        instrument.send(b"in time")
        collected.wait_for_bytes(7)
        clock.stop()
        instrument.send(b"late")
        told = collected.wait_for_event(EventKind.FRAMES_DROPPED)
        instrument.send(b"again")
        collected.wait_for_bytes(12)
    assert collected.received_bytes() == b"in timeagain"
    assert told.text.startswith("4 bytes lost, nobody read for a while")
    (gap,) = collected.gaps()
    assert gap.reason is GapReason.FRAMES_LOST
    assert gap.end is not None
    assert gap.end.since(gap.start) > AWAY_S * NS_PER_S


def test_a_station_goes_on_answering_when_nobody_read_for_a_while(tmp_path: Path) -> None:
    clock = StoppedClock()
    with plugged_in(tmp_path / "tty") as instrument, running(config(instrument.path), clock) as collected:
        instrument.expect(b"T34083\x03\r\n")
        clock.stop()
        instrument.send(ACK_FRAME)
        collected.wait_for_event(EventKind.CONFIGURED)


def test_frames_that_nobody_read_in_time_and_the_kernel_did_not_stamp_are_lost_and_told() -> None:
    channel, clock = unused_channel(), StoppedClock()
    with virtual_bus(channel) as bus, can_support.running(virtual_link(channel, clock)) as heard:
        heard.wait_for(EventKind.LINK_UP)
        bus.send(message("1A0 01"))
        heard.wait(lambda: len(heard.received) == 1, "a frame")
        clock.stop()
        bus.send(message("1A0 02"))
        told = heard.wait_for(EventKind.FRAMES_DROPPED)

        def heard_another() -> bool:
            bus.send(message("1A0 03"))
            return len(heard.received) > 1

        heard.wait(heard_another, "a frame that is read in time")
    assert {frame.data for frame in heard.received} == {b"\x01", b"\x03"}
    assert "nobody read for a while" in told.text
