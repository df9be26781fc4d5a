from __future__ import annotations

import errno
import os
import threading
import time
from typing import NoReturn

import can
import pytest

from drivers import outage
from drivers.can import slcan_port
from drivers.can.frame import Frame
from drivers.can.port import BATCH_MAX
from drivers.can.ports import ADAPTER_READY_S, CanLinkConfig, Interface, open_port
from drivers.can_link import LOSS_CHECK_NS, CanLink
from drivers.canopen.sync import SyncProducer
from drivers.clock import ManualClock, ScaledClock, Stamp, SystemClock
from drivers.errors import LinkError, TransmitForbiddenError
from drivers.outage import BACKOFF_MAX_S, Backoff
from drivers.readings import CanCapture, DeviceEvent, EventKind, Gap, GapReason
from tests.drivers.can_support import (
    DEADLINE_S,
    Adapter,
    Heard,
    adapter_config,
    message,
    running,
    slcan_link,
    unused_channel,
    virtual_bus,
    virtual_link,
)
from tests.drivers.multicast import GROUP, multicast_bus, multicast_link, unused_port

# Receiving


def test_every_frame_is_captured_with_its_flags() -> None:
    channel = unused_channel()
    with virtual_bus(channel) as bus, running(virtual_link(channel)) as heard:
        heard.wait_for(EventKind.LINK_UP)
        bus.send(message("1A0 4E 61 BC 00"))
        bus.send(message("0CFE3021 7D"))
        bus.send(can.Message(arbitration_id=0x1A0, is_remote_frame=True, is_extended_id=False, dlc=4))
        bus.send(can.Message(arbitration_id=0x204, is_error_frame=True, data=bytes(8)))
        heard.wait(lambda: len(heard.received) == 4, "4 frames")
        assert [(c.arbitration_id, c.data, c.is_extended, c.is_remote, c.is_error) for c in heard.received] == [
            (0x1A0, bytes.fromhex("4E61BC00"), False, False, False),
            (0x0CFE3021, b"\x7d", True, False, False),
            (0x1A0, b"", False, True, False),
            (0x204, bytes(8), False, False, True),
        ]
        assert {c.link for c in heard.captures} == {"boom"}
        assert not any(c.is_transmitted for c in heard.captures)


def test_a_burst_is_received_whole_and_in_order() -> None:
    channel = unused_channel()
    with virtual_bus(channel) as bus, running(virtual_link(channel)) as heard:
        heard.wait_for(EventKind.LINK_UP)
        count = 3 * BATCH_MAX
        for number in range(count):
            bus.send(can.Message(arbitration_id=0x1A0, data=number.to_bytes(4, "little"), is_extended_id=False))
        heard.wait(lambda: len(heard.received) == count, "all frames")
        assert [int.from_bytes(c.data, "little") for c in heard.received] == list(range(count))


def test_frames_are_stamped_by_the_clock_that_was_given() -> None:
    clock = ManualClock()
    channel = unused_channel()
    with virtual_bus(channel) as bus, running(virtual_link(channel, clock)) as heard:
        heard.wait_for(EventKind.LINK_UP)
        bus.send(message("1A0 01"))
        heard.wait(lambda: len(heard.received) == 1, "a frame")
        clock.advance(5.0)
        bus.send(message("1A0 02"))
        heard.wait(lambda: len(heard.received) == 2, "another frame")
    first, second = heard.received
    assert second.stamp.since(first.stamp) == 5_000_000_000


def test_can_fd_frames_are_counted_as_lost_and_not_captured() -> None:
    channel = unused_channel()
    clock = ManualClock()
    with virtual_bus(channel) as bus, running(virtual_link(channel, clock)) as heard:
        heard.wait_for(EventKind.LINK_UP)
        bus.send(can.Message(arbitration_id=0x1A0, data=bytes(12), is_fd=True, is_extended_id=False))
        bus.send(message("1A0 01"))
        heard.wait(lambda: len(heard.received) == 1, "a frame")
        clock.advance(2.0)
        event = heard.wait_for(EventKind.FRAMES_DROPPED)
    assert (event.text, event.code) == ("boom: 1 frames lost: not a classic CAN frame", 1)
    up = heard.events(EventKind.LINK_UP)[0].stamp
    assert heard.gaps == [Gap("boom", GapReason.FRAMES_LOST, up, event.stamp, 1)]


def test_every_loss_is_a_gap_of_its_own_since_losses_were_last_looked_for() -> None:
    channel = unused_channel()
    clock = ManualClock()
    with virtual_bus(channel) as bus, running(virtual_link(channel, clock)) as heard:
        heard.wait_for(EventKind.LINK_UP)
        for count in (1, 3):
            for _ in range(count):
                bus.send(can.Message(arbitration_id=0x1A0, data=bytes(12), is_fd=True, is_extended_id=False))
            before = len(heard.received)
            bus.send(message("1A0 01"))
            heard.wait(lambda before=before: len(heard.received) > before, "a frame")
            clock.advance(2.0)
            heard.wait_for(EventKind.FRAMES_DROPPED, 1 if count == 1 else 2)
    first, second = heard.gaps
    assert (first.missed, second.missed) == (1, 3)
    assert second.start == first.end


def test_frames_that_the_kernel_dropped_while_the_link_was_held_up_are_a_gap_around_them() -> None:
    port = unused_port()
    clock = SystemClock()
    go_on = threading.Event()
    heard, stop = Heard(), threading.Event()
    held_up: list[CanCapture] = []

    def emit(item: CanCapture | DeviceEvent | Gap) -> None:
        heard(item)
        if isinstance(item, CanCapture) and not held_up:
            held_up.append(item)
            go_on.wait(DEADLINE_S)

    def lost() -> list[Gap]:
        return [gap for gap in heard.gaps if gap.reason is GapReason.FRAMES_LOST]

    with multicast_bus(port) as bus:
        thread = threading.Thread(target=multicast_link(port, receive_buffer_bytes=4096).run, args=(emit, stop))
        thread.start()
        try:
            heard.wait_for(EventKind.LINK_UP)
            sent = 200
            bus.send(message("1A0 00"))
            heard.wait(lambda: held_up, "the first frame")
            for _ in range(sent - 2):
                bus.send(message("1A0 01"))
            # So long that losses are looked for once after the kept frames, before the kernel can tell of any
            up = heard.events(EventKind.LINK_UP)[0].stamp
            heard.wait(lambda: clock.now().since(up) > 1.05 * LOSS_CHECK_NS, "the time to look for losses")
            go_on.set()
            quiet = len(heard.received)
            heard.wait(lambda: len(heard.received) > quiet, "what the kernel kept")
            bus.send(message("1A0 FF"))
            heard.wait(lambda: heard.received[-1].data == b"\xff", "the last frame")
            heard.wait(lost, "a gap")
        finally:
            go_on.set()
            stop.set()
            thread.join(DEADLINE_S)
    assert not thread.is_alive()
    (gap,) = lost()  # a busy computer may also make times doubtful
    assert gap.channel == "boom"
    assert gap.missed == sent - len(heard.received) > 0
    assert gap.start.since(heard.received[-2].stamp) <= 0, "they were lost after the last frame that was kept"
    assert gap.end is not None
    assert gap.end.since(heard.received[-1].stamp) >= 0


# Nothing is sent


def test_by_default_nothing_is_ever_sent() -> None:
    channel = unused_channel()
    with virtual_bus(channel) as bus:
        link = virtual_link(channel, ManualClock())
        with pytest.raises(TransmitForbiddenError):
            link.request_setup()
        with running(link) as heard:
            heard.wait_for(EventKind.LINK_UP)
            for frame in ("720 00", "5A0 43 00 10 00 96 01 02 00", "000 01 20", "080", "7E5 04 00"):
                bus.send(message(frame))
            heard.wait(lambda: len(heard.received) == 5, "5 frames")
        assert heard.sent == []
        assert bus.recv(0.0) is None


def test_sync_on_a_listen_only_link_is_refused_before_anything_is_opened() -> None:
    with pytest.raises(TransmitForbiddenError, match="boom: the link is listen-only"):
        virtual_link(unused_channel(), sync_period_ms=20.0)
    with pytest.raises(ValueError, match="sync_period_ms must be positive"):
        virtual_link(unused_channel(), allow_transmit=True, sync_period_ms=0.0)


# SYNC


def test_sync_keeps_to_its_grid_and_skips_what_it_missed() -> None:
    producer = SyncProducer(20_000_000, 1_000_000_000)
    assert producer.due(999_999_999) is None
    assert producer.due(1_000_000_000) == Frame(0x080, b"")
    assert producer.due(1_019_999_999) is None
    assert producer.due(1_025_000_000) == Frame(0x080, b"")
    assert producer.next_ns == 1_040_000_000
    assert producer.due(1_170_000_000) == Frame(0x080, b"")
    assert producer.next_ns == 1_180_000_000


def test_sync_is_sent_at_its_period_without_drift_and_captured_as_sent() -> None:
    channel = unused_channel()
    link = virtual_link(channel, allow_transmit=True, sync_period_ms=10.0)
    with virtual_bus(channel) as bus, running(link) as heard:
        heard.wait(lambda: len(heard.sent) >= 50, "50 SYNCs")
        received = [bus.recv(0.0) for _ in range(50)]
    assert all(m is not None and m.arbitration_id == 0x080 and not m.data for m in received)
    stamps = [capture.stamp.monotonic_ns for capture in heard.sent]
    # On a busy machine single ones are late, or a period is left out; the grid stays
    phases = sorted((stamp - stamps[0]) % 10_000_000 for stamp in stamps[1:])
    assert phases[0] < 3_000_000 or phases[-1] > 7_000_000
    assert stamps[49] - stamps[0] >= 485_000_000


# Losing the bus and finding it again


def test_waiting_times_double_to_a_limit_and_are_the_same_every_time() -> None:
    backoff = Backoff()
    waits = [backoff.next_s() for _ in range(5)]
    assert waits == [0.5, 0.7, 0.7, 0.7, 0.7]
    assert BACKOFF_MAX_S + ADAPTER_READY_S < 2.0, "an adapter whose return nothing signals"
    backoff.reset()
    assert backoff.next_s() == 0.5


@pytest.mark.parametrize(("allow_transmit", "listen_only"), [(False, "on"), (True, "off")])
def test_a_bus_that_cannot_be_opened_is_told_once_with_what_to_do(allow_transmit: bool, listen_only: str) -> None:
    config = CanLinkConfig(
        name="boom", interface="socketcan", channel="can-none", bitrate=125_000, allow_transmit=allow_transmit
    )
    clock = ScaledClock(200.0, SystemClock().now())
    heard, stop = Heard(), threading.Event()
    thread = threading.Thread(target=CanLink(config, clock).run, args=(heard, stop))
    start = clock.now()
    thread.start()
    try:
        heard.wait(lambda: clock.now().since(start) > 100e9, "many attempts")
    finally:
        stop.set()
        thread.join(DEADLINE_S)
    assert not thread.is_alive()
    (event,) = heard.events()
    assert event.kind is EventKind.LINK_LOST
    assert event.text.startswith("boom: cannot open socketcan 'can-none': ")
    hint = f"try: ip link set can-none up type can bitrate 125000 listen-only {listen_only} restart-ms 100"
    assert event.text.endswith(hint) or "the kernel has no CAN support loaded" in event.text
    (gap,) = heard.gaps
    assert (gap.channel, gap.reason, gap.end) == ("boom", GapReason.LINK_DOWN, None)
    assert 0 <= gap.start.since(start) <= event.stamp.since(start)


@pytest.mark.parametrize(
    ("interface", "channel", "options", "text"),
    [
        ("slcan", "/dev/no-such-adapter", {}, "check that the adapter is plugged in"),
        ("udp_multicast", "10.0.0.1", {}, "check the channel and the options"),
        ("udp_multicast", GROUP, {"port": "x"}, "check the channel and the options"),
    ],
)
def test_settings_that_open_nothing_are_a_link_error(
    interface: Interface, channel: str, options: dict[str, object], text: str
) -> None:
    with pytest.raises(LinkError, match=rf"^boom: cannot open {interface} .*{text}"):
        open_port(adapter_config(interface, channel, options))


def test_what_the_system_said_of_a_missing_adapter_is_told_once() -> None:
    with pytest.raises(LinkError) as refused:
        open_port(adapter_config("slcan", "/dev/no-such-adapter", {}))
    assert str(refused.value) == (
        "boom: cannot open slcan '/dev/no-such-adapter': No such file or directory; check that the adapter is plugged "
        "in, that this user may access the port, and that the bitrate is right"
    )


@pytest.mark.parametrize(
    ("code", "hint"), [(errno.EAFNOSUPPORT, "`modprobe can_raw`"), (errno.ENODEV, "try: ip link set can0 up ")]
)
def test_an_interface_that_a_kernel_without_can_refuses_is_not_said_to_be_down(
    monkeypatch: pytest.MonkeyPatch, code: int, hint: str
) -> None:
    def refusing(*_arguments: object, **_options: object) -> NoReturn:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(can, "Bus", refusing)  # which of the two a kernel says is not the test's to choose
    with pytest.raises(LinkError) as refused:
        open_port(adapter_config("socketcan", "can0", {}))
    assert f"cannot open socketcan 'can0': {os.strerror(code)}; " in str(refused.value)
    assert hint in str(refused.value)


def test_an_slcan_adapter_is_opened_listen_only_by_default(adapter: Adapter) -> None:
    with running(slcan_link(adapter)) as heard:
        heard.wait_for(EventKind.LINK_UP)
        assert adapter.commands(b"L\r") in (b"C\rS5\r\rL\r", b"C\rS5\r\rL\rL\r")
        adapter.send(b"t1A044E61BC00\rT0CFE302117D\rnoise\r")
        heard.wait(lambda: len(heard.received) == 2, "2 frames")
        event = heard.wait_for(EventKind.FRAMES_DROPPED)
    assert event.text == "boom: 1 frames lost: the adapter sent a line that is not a frame"
    assert [c.arbitration_id for c in heard.received] == [0x1A0, 0x0CFE3021]
    assert adapter.commands(b"C\r").replace(b"L\r", b"") == b"C\r", "closed, and nothing sent"


def test_an_slcan_adapter_that_comes_back_is_open_within_two_seconds_without_any_option(adapter: Adapter) -> None:
    with running(slcan_link(adapter, options={})) as heard:
        heard.wait_for(EventKind.LINK_UP)
        adapter.unplug()
        heard.wait_for(EventKind.LINK_LOST)
        adapter.plug_in()
        back = time.monotonic_ns()
        heard.wait_for(EventKind.LINK_UP, 2)
        assert time.monotonic_ns() - back < 2e9


def test_an_slcan_adapter_sends_what_it_may(adapter: Adapter) -> None:
    with running(slcan_link(adapter, allow_transmit=True, sync_period_ms=1000.0)) as heard:
        heard.wait(lambda: heard.sent, "a SYNC")
        assert b"O\r" in adapter.commands(b"t0800\r")


@pytest.mark.parametrize(("may_send", "command"), [(False, b"L\r"), (True, b"O\r")])
def test_a_channel_that_an_slcan_adapter_has_closed_is_opened_again_after_a_silence(
    adapter: Adapter, monkeypatch: pytest.MonkeyPatch, *, may_send: bool, command: bytes
) -> None:
    monkeypatch.setattr(slcan_port, "SILENT_S", 0.2)
    with running(slcan_link(adapter, allow_transmit=may_send)) as heard:
        heard.wait_for(EventKind.LINK_UP)
        adapter.commands(command)
        assert not adapter.commands(command).replace(command, b""), "opened again"
        adapter.send(b"\r")
        assert not adapter.commands(command).replace(command, b""), "and again, as it may have been refused unheard"
        adapter.send(b"\at1A01AA\r")
        heard.wait(lambda: heard.received, "a frame")
    assert not heard.events(EventKind.FRAMES_DROPPED)


def test_an_slcan_adapter_that_refuses_frames_is_told_to_open_its_channel_and_warned_about(adapter: Adapter) -> None:
    with running(slcan_link(adapter, allow_transmit=True, sync_period_ms=20.0)) as heard:
        heard.wait_for(EventKind.LINK_UP)
        adapter.waiting()
        told = b""
        while not heard.events(EventKind.WARNING) or b"O\r" not in told:
            told += (new := adapter.waiting())
            adapter.send(b"\a" * new.count(b"\r"))
        assert "the adapter refuses frames" in heard.wait_for(EventKind.WARNING).text
        adapter.send(b"\r")
        assert heard.wait_for(EventKind.WARNING, 2).code == 0, "it is withdrawn once nothing is refused"


def test_an_adapter_that_is_unplugged_and_plugged_in_again_is_found_again(adapter: Adapter) -> None:
    with running(slcan_link(adapter)) as heard:
        heard.wait_for(EventKind.LINK_UP)
        adapter.send(b"t1A01AA\r")
        heard.wait(lambda: heard.received, "a frame")
        adapter.unplug()
        lost = heard.wait_for(EventKind.LINK_LOST)
        assert lost.text.startswith("boom: connection to the bus lost: ")
        adapter.plug_in()
        heard.wait_for(EventKind.LINK_UP, 2)
        adapter.send(b"t1A01BB\r")
        heard.wait(lambda: len(heard.received) == 2, "a frame after the return")
    opened, closed = heard.gaps
    assert (opened.reason, opened.start, opened.end) == (GapReason.LINK_DOWN, heard.received[0].stamp, None)
    assert closed.start == opened.start
    assert closed.end is not None
    assert closed.end.since(opened.start) > 0


def test_an_adapter_is_found_as_soon_as_its_path_is_there_again(
    adapter: Adapter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outage, "BACKOFF_FIRST_S", 10 * DEADLINE_S)
    with running(slcan_link(adapter)) as heard:
        heard.wait_for(EventKind.LINK_UP)
        adapter.unplug()
        heard.wait_for(EventKind.LINK_LOST)
        adapter.plug_in()
        heard.wait_for(EventKind.LINK_UP, 2)


def test_an_adapter_that_comes_back_is_found_in_real_time_however_slowly_the_clock_runs(adapter: Adapter) -> None:
    with running(slcan_link(adapter, ScaledClock(0.01, SystemClock().now()))) as heard:
        heard.wait_for(EventKind.LINK_UP)
        adapter.unplug()
        heard.wait_for(EventKind.LINK_LOST)
        adapter.plug_in()
        heard.wait_for(EventKind.LINK_UP, 2)


# What stays true whatever is plugged in


def test_what_waits_to_be_read_when_a_link_is_to_stop_is_still_read_and_nothing_more_is_sent() -> None:
    channel = unused_channel()
    heard, stop, go_on = Heard(), threading.Event(), threading.Event()
    link = virtual_link(channel, allow_transmit=True, sync_period_ms=1.0)

    def emit(item: CanCapture | DeviceEvent | Gap) -> None:
        heard(item)
        if isinstance(item, CanCapture) and not item.is_transmitted:
            go_on.wait(DEADLINE_S)

    with virtual_bus(channel) as bus:
        thread = threading.Thread(target=link.run, args=(emit, stop))
        thread.start()
        heard.wait_for(EventKind.LINK_UP)
        bus.send(message("1A0 00"))
        heard.wait(lambda: heard.received, "the first frame")
        for _ in range(2 * BATCH_MAX):
            bus.send(message("1A0 01"))
        stop.set()
        was_sent = {capture.stamp for capture in heard.sent}
        now = SystemClock().now()
        go_on.set()
        thread.join(DEADLINE_S)
    assert not thread.is_alive()
    assert len(heard.received) == 1 + 2 * BATCH_MAX
    late = [capture for capture in heard.sent if capture.stamp not in was_sent]  # sent before, and told after
    assert all(capture.stamp.since(now) < 0 for capture in late)


def test_frames_from_before_the_bus_was_open_are_not_sent() -> None:
    """What a machine would take for the present is minutes old."""
    channel = unused_channel()
    link = virtual_link(channel, allow_transmit=True, own_identifiers=(0x6A0,))
    heard, stop = Heard(), threading.Event()
    link.publish([Frame(0x6A0, b"old")])
    with virtual_bus(channel) as bus:
        thread = threading.Thread(target=link.run, args=(heard, stop))
        thread.start()
        heard.wait_for(EventKind.LINK_UP)
        link.publish([Frame(0x6A0, b"new")])
        received = bus.recv(DEADLINE_S)
        stop.set()
        thread.join(DEADLINE_S)
    assert received is not None
    assert received.data == b"new"


def test_a_link_stops_soon_and_its_last_words_are_kept() -> None:
    link = virtual_link(unused_channel())
    with running(link) as heard:
        heard.wait_for(EventKind.LINK_UP)
        start = time.monotonic()
    assert time.monotonic() - start < DEADLINE_S
    assert all(isinstance(item, CanCapture | DeviceEvent | Gap) for item in (*heard.captures, *heard.events()))
    assert isinstance(heard.events()[0].stamp, Stamp)
