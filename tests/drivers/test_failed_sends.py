"""What a link cannot send costs none of what it receives."""

from __future__ import annotations

import errno
import os
import socket
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
import serial
from can.interfaces.virtual import VirtualBus

from drivers.can.frame import Frame
from drivers.can.port import CanPort
from drivers.can.ports import CanLinkConfig, SocketCanPort, open_port
from drivers.can_link import CanLink
from drivers.clock import ScaledClock, SystemClock
from drivers.errors import LinkError
from drivers.readings import DeviceEvent, EventKind, LinkItem, SerialCapture
from drivers.stations.config import StationConfig
from drivers.stations.link import StationLink
from tests.drivers.can_support import DEADLINE_S, Adapter, running, slcan_link, unused_channel
from tests.drivers.canopen.test_can_setup_requests import BOTH
from tests.drivers.serial_support import Collected, plugged_in

WAITING = 5  # frames; some kernels let no more than ten datagrams wait
BUFFER_FULL = can.CanOperationError("Transmit buffer full")  # python-can, after its wait
NO_BUFFER_SPACE = can.CanOperationError(f"Failed to transmit: {os.strerror(errno.ENOBUFS)}", errno.ENOBUFS)
NO_BUFFER_SPACE.__cause__ = OSError(errno.ENOBUFS, os.strerror(errno.ENOBUFS))
NETWORK_DOWN = can.CanOperationError(f"Failed to transmit: {os.strerror(errno.ENETDOWN)}", errno.ENETDOWN)
NETWORK_DOWN.__cause__ = OSError(errno.ENETDOWN, os.strerror(errno.ENETDOWN))


class FailingBus(VirtualBus):
    """A bus that fails to send while `failure` is set; meanwhile frames arrive in the socket of its port."""

    def __init__(self) -> None:
        super().__init__(unused_channel())
        self.ours, self._theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.failure: can.CanError | None = None
        self.arriving = WAITING
        self.timeout: float | None = None  # of the last failed send

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.failure is None:
            return
        self.timeout = timeout
        for number in range(self.arriving):
            self._theirs.send(struct.pack("=IB3x8s", 0x1A0, 8, number.to_bytes(8, "little")))
        self.arriving = 0
        raise self.failure

    def shutdown(self) -> None:
        super().shutdown()
        self._theirs.close()


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[FailingBus]:
    """The bus of the first port that a link opens; no second port can be opened."""
    failing = FailingBus()
    ports: list[CanPort] = [SocketCanPort("boom", failing, failing.ours, 1 << 20, tmp_path)]

    def opened(_config: CanLinkConfig) -> CanPort:
        if not ports:
            raise LinkError("boom", "cannot be opened again")
        return ports.pop()

    monkeypatch.setattr("drivers.can_link.open_port", opened)
    yield failing
    for port in ports:
        port.close()


def sending_link() -> CanLink:
    config = CanLinkConfig(name="boom", interface="socketcan", channel="can0", allow_transmit=True, sync_period_ms=10.0)
    return CanLink(config, SystemClock())


@pytest.mark.parametrize("failure", [BUFFER_FULL, NO_BUFFER_SPACE], ids=["no room", "ENOBUFS"])
def test_a_full_transmit_queue_is_one_warning_and_the_link_goes_on_reading(
    bus: FailingBus, failure: can.CanError
) -> None:
    bus.failure = failure
    with running(sending_link()) as heard:
        heard.wait(lambda: len(heard.received) == WAITING, "the frames that arrived meanwhile")
        begun = heard.wait_for(EventKind.WARNING)
        refused = "boom: the transmit queue is full or the adapter refuses frames, so they are not sent: check that "
        assert begun.text.startswith(refused)
        assert begun.code is None
        assert heard.sent == []
        assert bus.timeout == 0.0, "nothing is read while it waits to send"
        bus.failure = None
        heard.wait(lambda: heard.sent, "a SYNC")
        ended = heard.wait_for(EventKind.WARNING, 2)
        assert ended.code == 0, "withdraws the warning"
        assert "frames were not sent as the queue was full or the adapter refused" in ended.text
    assert len(heard.events(EventKind.WARNING)) == 2
    assert heard.events(EventKind.LINK_LOST) == heard.gaps == []


def test_frames_that_wait_when_a_send_fails_are_read_before_the_link_is_lost(bus: FailingBus) -> None:
    bus.failure = NETWORK_DOWN
    with running(sending_link()) as heard:
        lost = heard.wait_for(EventKind.LINK_LOST)
        assert lost.text == f"boom: connection to the bus lost: {os.strerror(errno.ENETDOWN)}"
        assert [int.from_bytes(capture.data, "little") for capture in heard.received] == list(range(WAITING))
        assert heard.gaps[0].start == heard.received[-1].stamp
    assert heard.events(EventKind.WARNING) == heard.sent == []


def test_an_slcan_adapter_that_accepts_nothing_is_still_read(adapter: Adapter) -> None:
    with running(slcan_link(adapter, allow_transmit=True, sync_period_ms=10.0)) as heard:
        heard.wait(lambda: heard.sent, "a SYNC")
        adapter.accept(nothing=True)
        heard.wait_for(EventKind.WARNING)
        adapter.send(b"t1A01AA\r")
        heard.wait(lambda: heard.received, "a frame")
        assert not heard.received[0].stamp.is_doubtful, "it was read in time"
        sent = len(heard.sent)
        adapter.accept(nothing=False)
        heard.wait(lambda: len(heard.sent) > sent, "a SYNC again")
    assert heard.events(EventKind.LINK_LOST) == []


def sending_port(adapter: Adapter) -> CanPort:
    return open_port(
        CanLinkConfig(
            name="boom",
            interface="slcan",
            channel=str(adapter.path),
            allow_transmit=True,
            options={"sleep_after_open": 0},
        )
    )


def test_an_slcan_adapter_that_accepts_lines_only_in_part_gets_their_ends_before_the_next_line(
    adapter: Adapter,
) -> None:
    port = sending_port(adapter)
    try:
        sent = 0
        while port.send(Frame(0x6A0, b"\x01\x02")):
            sent += 1
        lines = adapter.waiting()
        while not port.send(Frame(0x080, b"")):
            lines += adapter.waiting()
        lines += adapter.commands(b"t0800\r")
    finally:
        port.close()
    assert lines.removeprefix(b"O\r") == sent * b"t6A020102\r" + b"t0800\r"


def test_frames_that_an_slcan_adapter_does_not_take_are_discarded_and_not_sent_when_it_goes_on(
    adapter: Adapter, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The kernel counts the bytes that a real adapter has not taken; it counts none for a pseudo-terminal
    untaken = 0
    monkeypatch.setattr(serial.Serial, "out_waiting", property(lambda _port: untaken))
    port = sending_port(adapter)
    try:
        deadline_s = time.monotonic() + DEADLINE_S
        assert port.send(Frame(0x680, b"\x01"))
        untaken = 1
        assert port.send(Frame(0x681, b"\x01")), "the adapter has had no time yet"
        while port.send(Frame(0x681, b"\x02")):
            adapter.waiting()
            assert time.monotonic() < deadline_s, "lines pile up in the terminal"
        assert not port.send(Frame(0x680, b"\x03"))
        untaken = 0
        assert port.send(Frame(0x680, b"\x04"))
        assert port.send(Frame(0x681, b"\x04"))
        before = adapter.commands(b"t681104\r").removesuffix(b"t680104\rt681104\r")
        assert before == b"\r" or before.endswith(b"\r\r"), "a line end for the line that may have been cut"
    finally:
        port.close()


def test_a_set_up_that_cannot_be_sent_is_cancelled_and_not_sent_later(adapter: Adapter) -> None:
    link = slcan_link(adapter, **BOTH)
    with running(link) as heard:
        heard.wait_for(EventKind.LINK_UP)
        adapter.commands(b"O\r")
        adapter.accept(nothing=True)
        link.request_setup()
        alarms = [heard.wait_for(EventKind.ALARM, count) for count in (1, 2)]
        why = "because the transmit queue was full or the adapter refused; request it again"
        assert all(why in alarm.text for alarm in alarms)
        adapter.accept(nothing=False)
        link.request_setup([33])
        assert adapter.commands(b"t62184000100000000000\r") == b"t62184000100000000000\r"
    assert heard.events(EventKind.LINK_LOST) == []


def test_a_set_up_requested_while_the_bus_goes_down_is_reported(bus: FailingBus) -> None:
    setups = BOTH["setups"]
    config = CanLinkConfig(
        name="boom",
        interface="socketcan",
        channel="can0",
        allow_transmit=True,
        sync_period_ms=10.0,
        transmit_nodes=BOTH["transmit_nodes"],
    )
    link = CanLink(config, SystemClock(), setups)
    with running(link) as heard:
        heard.wait_for(EventKind.LINK_UP)
        with link._requests_lock:  # so that the next SYNC, which fails, comes before the request is taken
            link._requests = [*(link._requests or ()), *setups]
            bus.failure = NETWORK_DOWN
        heard.wait_for(EventKind.LINK_LOST)
        heard.wait_for(EventKind.ALARM, len(setups))


def test_bytes_that_wait_when_a_poll_cannot_be_written_are_read_before_the_link_is_lost(tmp_path: Path) -> None:
    collected, stop = Collected(), threading.Event()
    with plugged_in(tmp_path / "tty") as instrument:

        def emit(item: LinkItem) -> None:
            collected.emit(item)
            if isinstance(item, DeviceEvent) and item.kind is EventKind.LINK_UP:
                instrument.send(b"waiting")  # while the first poll is being written

        instrument.accept(nothing=True)
        config = StationConfig.model_validate({"serial": {"path": str(instrument.path)}})
        link = StationLink(config, ScaledClock(50.0, SystemClock().now()))
        thread = threading.Thread(target=link.run, args=(emit, stop))
        thread.start()
        try:
            lost = collected.wait_for_event(EventKind.LINK_LOST)
            until = collected.items.index(lost)
            (read,) = [item for item in collected.items[:until] if isinstance(item, SerialCapture)]
            assert (read.data, read.is_transmitted) == (b"waiting", False)
            assert "writing failed" in lost.text
        finally:
            stop.set()
            thread.join(DEADLINE_S)
