"""SocketCAN frames over a socket pair, and `udp_multicast` for real."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from drivers.can.frame import Frame
from drivers.can.port import INTERFACE_DROPS, NOT_A_FRAME, OVERFLOW
from drivers.can.ports import CanLinkConfig, MulticastPort, SocketCanPort, interface_drops, open_port
from drivers.can_link import CanLink
from drivers.clock import ScaledClock, SystemClock
from drivers.errors import LinkError
from drivers.readings import EventKind
from tests.drivers.can_support import (
    Adapter,
    adapter_config,
    message,
    running,
    unused_channel,
)
from tests.drivers.multicast import GROUP, multicast_bus, multicast_link, unused_port


@contextlib.contextmanager
def socketcan_port(statistics: Path) -> Iterator[tuple[SocketCanPort, socket.socket]]:
    """A port whose socket is one end of a pair; what SocketCAN would deliver is written to the other."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    bus = can.Bus(unused_channel(), "virtual", ignore_config=True)
    port = SocketCanPort("boom", bus, ours, 1 << 20, statistics)
    try:
        yield port, theirs
    finally:
        port.close()
        theirs.close()


def can_frame(identifier: int, data: bytes) -> bytes:
    return struct.pack("=IB3x8s", identifier, len(data), data)


def test_frames_of_a_can_socket_are_read_all_at_once(tmp_path: Path) -> None:
    with socketcan_port(tmp_path) as (port, kernel):
        assert port.receive(0.0).received == []
        kernel.send(can_frame(0x1A0, b"\x01"))
        kernel.send(can_frame(0x20000204, bytes(8)))
        kernel.send(bytes(72))
        assert [received.frame for received in port.receive(1.0).received] == [
            Frame(0x1A0, b"\x01"),
            Frame(0x204, bytes(8), is_error=True),
        ]
        assert port.losses() == {NOT_A_FRAME: 1}


def test_a_socket_that_fails_is_a_link_error_every_time() -> None:
    # The network stack's own failure, as an interface that goes down is: nobody listens where this socket sent to
    ours, theirs = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    theirs.bind(("127.0.0.1", 0))
    ours.connect(theirs.getsockname())
    theirs.close()
    ours.send(b"x")
    port = SocketCanPort("boom", can.Bus(unused_channel(), "virtual", ignore_config=True), ours, 1 << 20, Path("/none"))
    try:
        for _ in range(2):
            with pytest.raises(LinkError, match=r"boom: connection to the bus lost: .*Connection refused"):
                port.receive(1.0)
    finally:
        port.close()


def test_frames_that_came_before_a_socket_failed_are_read_before_the_failure_is_told() -> None:
    ours, theirs = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    for each in (ours, theirs):
        each.bind(("127.0.0.1", 0))
    ours.connect(theirs.getsockname())
    theirs.sendto(can_frame(0x1A0, b"\x01"), ours.getsockname())
    theirs.close()
    ours.send(b"x")  # refused: the next call on this socket fails, whatever waits in it
    port = SocketCanPort("boom", can.Bus(unused_channel(), "virtual", ignore_config=True), ours, 1 << 20, Path("/none"))
    try:
        assert [received.frame for received in port.receive(1.0).received] == [Frame(0x1A0, b"\x01")]
        with pytest.raises(LinkError, match="Connection refused"):
            port.receive(1.0)
    finally:
        port.close()


def test_sending_to_an_adapter_that_is_gone_is_a_link_error(adapter: Adapter) -> None:
    port = open_port(adapter_config("slcan", str(adapter.path), {"sleep_after_open": 0.0}))
    adapter.unplug()
    try:
        with pytest.raises(LinkError, match="boom: connection to the bus lost"):
            port.send(Frame(0x080, b""))
    finally:
        port.close()


@pytest.mark.skipif(not Path("/sys/class/net/vcan0").exists(), reason="there is no interface vcan0")
def test_a_socketcan_interface_is_received_from() -> None:
    link = CanLink(CanLinkConfig(name="boom", interface="socketcan", channel="vcan0"), SystemClock())
    with can.Bus("vcan0", "socketcan", ignore_config=True) as bus, running(link) as heard:
        heard.wait_for(EventKind.LINK_UP)
        bus.send(message("1A0 4E 61 BC 00"))
        heard.wait(lambda: heard.received, "a frame")
        assert heard.received[0].data == bytes.fromhex("4E61BC00")


def test_losses_of_the_interface_are_read_from_its_statistics(tmp_path: Path) -> None:
    names = ("rx_dropped", "rx_fifo_errors", "rx_missed_errors", "rx_over_errors")
    for name in names:
        (tmp_path / name).write_text("7\n")
    with socketcan_port(tmp_path) as (port, _):
        assert port.losses() == {}
        (tmp_path / "rx_over_errors").write_text("12\n")
        assert port.losses() == {INTERFACE_DROPS: 5}
    (tmp_path / "rx_dropped").write_text("nonsense")
    assert interface_drops(tmp_path) == 7 + 7 + 12
    assert interface_drops(tmp_path / "none") == 0


def test_frames_cross_processes_by_multicast_with_the_kernel_s_time() -> None:
    port = unused_port()
    with multicast_bus(port) as bus, running(multicast_link(port)) as heard:
        heard.wait_for(EventKind.LINK_UP)
        before = time.time_ns()
        bus.send(message("1A0 4E 61 BC 00"))
        heard.wait(lambda: heard.received, "a frame")
        (frame,) = heard.received
        assert frame.data == bytes.fromhex("4E61BC00")
        assert before <= frame.stamp.utc_ns <= time.time_ns()
        offset_ns = time.time_ns() - time.monotonic_ns()
        assert abs(frame.stamp.utc_ns - frame.stamp.monotonic_ns - offset_ns) < 50_000_000


def test_a_sender_does_not_hear_itself_and_others_hear_it() -> None:
    port = unused_port()
    with (
        multicast_bus(port) as bus,
        running(multicast_link(port, allow_transmit=True, sync_period_ms=5.0)) as heard,
    ):
        heard.wait(lambda: len(heard.sent) >= 10, "10 SYNCs")
        bus.send(message("080"))
        heard.wait(lambda: heard.received, "the other's SYNC")
        assert len(heard.received) == 1
        assert bus.recv(1.0) is not None


def test_what_is_no_message_on_the_group_is_counted() -> None:
    port = unused_port()
    with multicast_bus(port) as bus:
        descriptor = socket.socket(fileno=os.dup(bus.fileno()))
        other = can.Bus(GROUP, "udp_multicast", port=port, hop_limit=0, ignore_config=True)
        multicast = MulticastPort("boom", other, socket.socket(fileno=os.dup(other.fileno())), 1 << 20)
        try:
            descriptor.sendto(b"\xc1 not msgpack", (GROUP, port))
            assert multicast.receive(1.0).received == []
            assert multicast.losses() == {NOT_A_FRAME: 1}
        finally:
            multicast.close()
            descriptor.close()


def test_frames_that_the_kernel_dropped_are_counted() -> None:
    port = unused_port()
    with multicast_bus(port) as bus:
        other = can.Bus(GROUP, "udp_multicast", port=port, hop_limit=0, ignore_config=True)
        small = MulticastPort("boom", other, socket.socket(fileno=os.dup(other.fileno())), 4096)
        try:
            sent, received = 200, 0
            for number in range(sent):
                bus.send(can.Message(arbitration_id=0x1A0, data=bytes((number,)), is_extended_id=False))
            while batch := small.receive(0.1).received:
                received += len(batch)
            bus.send(message("1A0 FF"))
            received += len(small.receive(1.0).received)
            assert received < sent
            assert small.losses() == {OVERFLOW: sent + 1 - received}
        finally:
            small.close()


def test_a_scaled_clock_is_not_mixed_with_the_kernel_s_time() -> None:
    port = unused_port()
    origin = SystemClock().now()
    clock = ScaledClock(50.0, origin.shifted(-60_000_000_000))
    config = CanLinkConfig(
        name="boom", interface="udp_multicast", channel=GROUP, options={"port": port, "hop_limit": 0}
    )
    with multicast_bus(port) as bus, running(CanLink(config, clock)) as heard:
        heard.wait_for(EventKind.LINK_UP)
        before = clock.now()
        bus.send(message("1A0 01"))
        heard.wait(lambda: heard.received, "a frame")
        assert heard.received[0].stamp.since(before) >= 0
