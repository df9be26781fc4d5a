"""When frames arrived: the kernel's time wherever it can be right, a mark where nothing tells."""

from __future__ import annotations

import socket
import struct
import threading
import time
from pathlib import Path

import can
import pytest

from drivers.can.frame import Frame
from drivers.can.port import BATCH_MAX, Batch, Received
from drivers.can.ports import CanLinkConfig, MulticastPort, SocketCanPort
from drivers.can.stamps import ReceiveStamps
from drivers.can_link import CanLink
from drivers.clock import NS_PER_S, Stamp, SystemClock
from drivers.readings import CanCapture, EventKind, GapReason
from drivers.stall_detector import LATE_S
from tests.drivers.can_support import (
    DEADLINE_S,
    Adapter,
    Heard,
    message,
    plugged_adapter,
    running,
    slcan_link,
    unused_channel,
    virtual_bus,
    virtual_link,
)
from tests.drivers.multicast import GROUP, multicast_bus, unused_port
from tests.drivers.stopped_clock import AWAY_S, StoppedClock

MS = 1_000_000
CLOCK = SystemClock()
AHEAD_NS = 1_700_000_000 * NS_PER_S
HOUR_NS = 3600 * NS_PER_S


def at(ms: float, ahead_ns: int = AHEAD_NS) -> Stamp:
    """An instant of the host, whose wall clock is so much ahead of its monotonic one."""
    monotonic_ns = 50 * NS_PER_S + round(ms * MS)
    return Stamp(monotonic_ns + ahead_ns, monotonic_ns, "boot")


def batch(*kernel: Stamp | None, is_last: bool = True) -> Batch:
    """Frames that the kernel has stamped so."""
    frame = Frame(0x1A0, b"")
    return Batch([Received(frame, None if stamp is None else stamp.utc_ns) for stamp in kernel], is_last)


def of(
    stamps: ReceiveStamps, frames: Batch, began: Stamp, ended: Stamp, *, is_late: bool = False
) -> list[tuple[float, bool]]:
    """The stamps as milliseconds, and whether they are marked."""
    found = stamps.of(frames, began, ended, is_late=is_late)
    return [((s.monotonic_ns - at(0).monotonic_ns) / MS, s.is_doubtful) for s in found]


def test_a_frame_has_the_time_that_the_kernel_gave_it_however_late_it_is_read() -> None:
    stamps = ReceiveStamps(CLOCK, at(0))
    assert of(stamps, batch(at(3)), at(0), at(4)) == [(3, False)]
    assert of(stamps, batch(at(5), at(2000)), at(5000), at(5001), is_late=True) == [(5, False), (2000, False)]
    # Interrupted between the empty read and the clock behind it: what comes in between is read at the next read
    assert of(stamps, batch(), at(5002), at(9000), is_late=True) == []
    assert of(stamps, batch(at(5500), at(8999)), at(9001), at(9002)) == [(5500, False), (8999, False)]
    # Interrupted between the clock and the read that follows it
    assert of(stamps, batch(at(11_000)), at(9003), at(12_000), is_late=True) == [(11_000, False)]


def test_stamps_carry_the_time_that_the_wall_clock_showed() -> None:
    stamps = ReceiveStamps(CLOCK, at(0))
    assert stamps.of(batch(at(3)), at(2), at(4), is_late=False) == [at(3)]
    assert stamps.latest == at(3)


def test_frames_of_a_full_batch_s_rest_may_be_older_than_the_read_before() -> None:
    stamps = ReceiveStamps(CLOCK, at(0))
    assert of(stamps, batch(at(1), at(2), is_last=False), at(900), at(901)) == [(1, False), (2, False)]
    assert of(stamps, batch(at(3), at(4)), at(902), at(903)) == [(3, False), (4, False)]


@pytest.mark.parametrize("step_ns", [-HOUR_NS, -NS_PER_S, NS_PER_S, HOUR_NS])
def test_frames_on_both_sides_of_a_step_of_the_wall_clock_are_where_they_were(step_ns: int) -> None:
    set_to = AHEAD_NS + step_ns
    stamps = ReceiveStamps(CLOCK, at(0))
    frames = batch(at(3), at(9), at(12, set_to), at(20, set_to))
    assert of(stamps, frames, at(2), at(21, set_to)) == [(3, False), (9, False), (12, False), (20, False)]
    assert of(stamps, batch(at(23, set_to)), at(22, set_to), at(24, set_to)) == [(23, False)]


def test_a_frame_that_may_have_come_on_either_side_of_a_step_is_marked_and_holds_up_none_behind_it() -> None:
    back = AHEAD_NS - 5 * MS
    stamps = ReceiveStamps(CLOCK, at(0))
    # 8 ms by the clock as it was before, 13 ms by the clock as it was after; it was set at some time from 0 to 20 ms
    assert of(stamps, batch(at(8)), at(0), at(20, back)) == [(0, True)]
    assert of(stamps, batch(at(40, back)), at(39, back), at(41, back)) == [(40, False)]


def test_a_frame_of_a_time_that_cannot_be_is_marked() -> None:
    stamps = ReceiveStamps(CLOCK, at(0))
    # The clock was set forward and back again between two looks
    assert of(stamps, batch(at(5), at(6, AHEAD_NS + HOUR_NS), at(7)), at(1), at(8)) == [
        (5, False),
        (5, True),
        (7, False),
    ]
    # Older than the last read that left nothing
    assert of(stamps, batch(), at(100), at(101)) == []
    assert of(stamps, batch(at(50), at(102)), at(101), at(103)) == [(100, True), (102, False)]


def test_stamps_never_go_back() -> None:
    stamps = ReceiveStamps(CLOCK, at(0))
    assert of(stamps, batch(at(5), at(4.5), at(6)), at(1), at(7)) == [(5, False), (5, False), (6, False)]
    assert of(stamps, batch(at(8), at(5.5)), at(7), at(9)) == [(8, False), (8, True)]


def test_what_the_kernel_does_not_stamp_has_the_time_of_reading_and_a_mark_if_nobody_read() -> None:
    stamps = ReceiveStamps(CLOCK, at(0))
    assert of(stamps, batch(None), at(1), at(2)) == [(2, False)]
    assert of(stamps, batch(None, None), at(3000), at(3001), is_late=True) == [(3001, True)] * 2


def test_what_the_kernel_stamps_at_reading_alone_is_not_believed_after_a_while_in_which_nobody_read() -> None:
    stamps = ReceiveStamps(CLOCK, at(0))
    assert of(stamps, batch(at(2)), at(1), at(3)) == [(2, False)]
    # As old as the read itself, although it began long after the last one
    assert of(stamps, batch(at(3000.1), at(3000.2)), at(3000), at(3001), is_late=True) == [(2, True)] * 2
    # Once an older one has shown that this socket is stamped at arrival, such a frame has just come
    assert of(stamps, batch(at(3010)), at(3020), at(3021)) == [(3010, False)]
    assert of(stamps, batch(at(6000.5)), at(6000), at(6001), is_late=True) == [(6000.5, False)]


# On real sockets


class HeldClock(SystemClock):
    """The host's clock, whose reader can be interrupted for as long as a test likes."""

    def __init__(self) -> None:
        super().__init__()
        self._go_on = threading.Event()
        self._go_on.set()
        self.is_held = threading.Event()

    def now(self) -> Stamp:
        if not self._go_on.is_set():
            self.is_held.set()
            assert self._go_on.wait(DEADLINE_S)
        return super().now()

    def hold(self) -> None:
        """Hold whoever reads the clock next, and wait until someone does."""
        self.is_held.clear()
        self._go_on.clear()
        assert self.is_held.wait(DEADLINE_S)

    def release(self) -> None:
        self._go_on.set()


def multicast_link(port: int, clock: SystemClock, **settings: object) -> CanLink:
    options = {"port": port, "hop_limit": 0}
    config = CanLinkConfig(name="boom", interface="udp_multicast", channel=GROUP, options=options, **settings)
    return CanLink(config, clock)


def test_frames_that_come_while_the_loop_is_interrupted_after_an_empty_read_keep_the_kernel_s_time() -> None:
    port, clock = unused_port(), HeldClock()
    count, interrupted_s = 40, 0.6
    with multicast_bus(port) as bus, running(multicast_link(port, clock)) as heard:
        heard.wait_for(EventKind.LINK_UP)
        clock.hold()
        began_ns = time.monotonic_ns()
        for number in range(count):
            bus.send(can.Message(arbitration_id=0x1A0, data=bytes((number,)), is_extended_id=False))
        sent_ns = time.monotonic_ns()
        time.sleep(interrupted_s)  # more than LATE_S: this is what is tested
        clock.release()
        heard.wait(lambda: len(heard.received) == count, "every frame")
    assert [frame.data[0] for frame in heard.received] == list(range(count))
    assert not any(frame.stamp.is_doubtful for frame in heard.received)
    stamps = [frame.stamp.monotonic_ns for frame in heard.received]
    assert stamps == sorted(stamps)
    assert began_ns - MS <= stamps[0]
    assert stamps[-1] <= sent_ns + MS
    assert heard.gaps == []
    assert [event.kind for event in heard.events()] == [EventKind.LINK_UP]


def test_frames_that_the_kernel_stamped_before_the_wall_clock_was_set_keep_their_place() -> None:
    port, shift_ns = unused_port(), [0]
    clock = HeldClock()
    clock._utc_ns = lambda: time.time_ns() + shift_ns[0]
    with multicast_bus(port) as bus, running(multicast_link(port, clock)) as heard:
        heard.wait_for(EventKind.LINK_UP)
        clock.hold()
        before_ns = time.monotonic_ns()
        bus.send(message("1A0 01"))
        after_ns = time.monotonic_ns()
        shift_ns[0] = -HOUR_NS
        clock.release()
        heard.wait(lambda: heard.received, "a frame")
    (frame,) = heard.received
    assert not frame.stamp.is_doubtful
    assert before_ns - MS <= frame.stamp.monotonic_ns <= after_ns + MS


def test_what_is_sent_and_what_is_received_is_captured_in_the_order_of_its_instants() -> None:
    port, clock = unused_port(), SystemClock()
    heard, stop, go_on, held = Heard(), threading.Event(), threading.Event(), threading.Event()

    def emit(item: object) -> None:
        heard(item)
        if isinstance(item, CanCapture) and not item.is_transmitted and not held.is_set():
            held.set()
            go_on.wait(DEADLINE_S)

    count = 4 * BATCH_MAX
    link = multicast_link(port, clock, allow_transmit=True, sync_period_ms=1.0)
    thread = threading.Thread(target=link.run, args=(emit, stop))
    with multicast_bus(port) as bus:
        thread.start()
        try:
            heard.wait_for(EventKind.LINK_UP)
            bus.send(message("1A0 00"))
            assert held.wait(DEADLINE_S)
            for _ in range(count - 1):
                bus.send(message("1A0 01"))
            go_on.set()
            heard.wait(lambda: len(heard.received) == count, "every frame")
            sent = len(heard.sent)
            heard.wait(lambda: len(heard.sent) > sent, "another SYNC")
        finally:
            go_on.set()
            stop.set()
            thread.join(DEADLINE_S)
    stamps = [capture.stamp.monotonic_ns for capture in heard.captures]
    assert stamps == sorted(stamps)


def test_a_read_of_frames_and_noise_that_filled_its_batch_has_not_read_everything() -> None:
    port = unused_port()
    with multicast_bus(port) as bus:
        other = multicast_bus(port)
        with other as listener, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as noise:
            multicast = MulticastPort("boom", listener, socket.socket(fileno=_duplicate(listener)), 1 << 22)
            noise.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            for number in range(BATCH_MAX + 1):
                if number % 2:
                    noise.sendto(b"\xc1 not msgpack", (GROUP, port))
                else:
                    bus.send(message("1A0 01"))
            first = multicast.receive(1.0)
            rest = multicast.receive(1.0)
            multicast.close()
    assert (len(first.received), first.is_last) == (BATCH_MAX // 2, False)
    assert (len(rest.received), rest.is_last) == (1, True)


def _duplicate(bus: can.BusABC) -> int:
    return socket.dup(bus.fileno())


def test_a_socket_that_is_stamped_at_reading_alone_never_seems_to_have_waited(tmp_path: Path) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    port = SocketCanPort("boom", can.Bus(unused_channel(), "virtual", ignore_config=True), ours, 1 << 20, tmp_path)
    stamps = ReceiveStamps(CLOCK, CLOCK.now())
    theirs.send(struct.pack("=IB3x8s", 0x1A0, 1, b"\x01"))
    began = CLOCK.now()
    frames = port.receive(1.0)
    (stamp,) = stamps.of(frames, began, CLOCK.now(), is_late=True)
    port.close()
    theirs.close()
    assert stamp.is_doubtful


def test_frames_of_an_adapter_that_nobody_read_in_time_are_stored_and_marked(tmp_path: Path) -> None:
    clock = StoppedClock()
    with plugged_adapter(tmp_path / "slcan") as adapter, running(slcan_link(adapter, clock=clock)) as heard:
        _late_frame_is_marked(heard, clock, lambda text: _send_line(adapter, text))


def test_frames_that_an_adapter_sent_while_its_port_was_being_opened_are_stored_and_marked(tmp_path: Path) -> None:
    """A killed rigcal leaves its adapter open, and it sends on while the next one gives it time to start."""
    with plugged_adapter(tmp_path / "slcan") as adapter:
        link = slcan_link(adapter, options={"sleep_after_open": 2 * LATE_S})
        with running(link) as heard:
            sent = threading.Event()

            def go_on_sending() -> None:
                while not sent.wait(0.02):
                    _send_line(adapter, "1A0 01")

            sender = threading.Thread(target=go_on_sending)
            sender.start()
            heard.wait_for(EventKind.LINK_UP)
            sent.set()
            sender.join()
            told = heard.wait_for(EventKind.TIME_DOUBTFUL)

            def heard_in_time() -> bool:
                _send_line(adapter, "1A0 02")
                return bool(heard.received) and not heard.received[-1].stamp.is_doubtful

            heard.wait(heard_in_time, "a frame that is read in time")
    assert heard.received[0].stamp.is_doubtful
    assert not any(frame.stamp.is_doubtful for frame in heard.received if frame.stamp.since(told.stamp) > 0)
    (gap,) = heard.gaps
    assert gap.reason is GapReason.TIME_DOUBTFUL
    assert heard.received[0].stamp.since(gap.start) >= 2 * LATE_S * NS_PER_S


def test_the_first_frames_of_an_adapter_that_was_silent_while_it_was_opened_are_in_time(tmp_path: Path) -> None:
    with plugged_adapter(tmp_path / "slcan") as adapter:
        link = slcan_link(adapter, options={"sleep_after_open": 2 * LATE_S})
        with running(link) as heard:
            heard.wait_for(EventKind.LINK_UP)
            _send_line(adapter, "1A0 01")
            heard.wait(lambda: heard.received, "a frame")
    assert not heard.received[0].stamp.is_doubtful
    assert heard.events(EventKind.TIME_DOUBTFUL) == []


def test_frames_of_a_bus_within_the_process_that_nobody_read_in_time_are_stored_and_marked() -> None:
    channel, clock = unused_channel(), StoppedClock()
    with virtual_bus(channel) as bus, running(virtual_link(channel, clock)) as heard:
        _late_frame_is_marked(heard, clock, lambda text: bus.send(message(text)))


def _send_line(adapter: Adapter, text: str) -> None:
    identifier, data = text.split()
    adapter.send(f"t{identifier}1{data}\r".encode())


def _late_frame_is_marked(heard: Heard, clock: StoppedClock, send: object) -> None:
    assert callable(send)
    heard.wait_for(EventKind.LINK_UP)
    send("1A0 01")
    heard.wait(lambda: len(heard.received) == 1, "a frame")
    clock.stop()
    send("1A0 02")

    def heard_in_time() -> bool:
        send("1A0 03")
        return not heard.received[-1].stamp.is_doubtful and heard.received[-1].data == b"\x03"

    heard.wait(heard_in_time, "a frame that is read in time")
    told = heard.wait_for(EventKind.TIME_DOUBTFUL)
    marked = [frame.data for frame in heard.received if frame.stamp.is_doubtful]
    assert marked[0] == b"\x02"
    assert heard.received[0].data == b"\x01"
    assert not heard.received[0].stamp.is_doubtful
    assert told.text == (
        f"boom: {len(marked)} frames are stored but not used for calibration, as their time is doubtful: "
        "the port was not read for a while, because rigcal was stopped or the computer was too busy"
    )
    assert told.code == len(marked)
    assert heard.events(EventKind.FRAMES_DROPPED) == []
    (gap,) = heard.gaps
    assert gap.reason is GapReason.TIME_DOUBTFUL
    assert gap.end is not None
    assert gap.end.since(gap.start) > AWAY_S * NS_PER_S
