from __future__ import annotations

import os
import select
import threading
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.devices.can.bus import Frame
from simulators.devices.can.slcan_adapter import Channel, SlcanAdapter
from simulators.pty_port import PtyPort

FRAME = Frame(0x1A0, bytes.fromhex("4E61BC00"))


def test_a_conversation_with_the_adapter() -> None:
    adapter = SlcanAdapter()
    conversation: list[tuple[bytes, bytes, list[Frame]]] = [
        (b"\r\r", b"\r\r", []),
        (b"V\r", b"V1013\r", []),
        (b"N\r", b"NSIM1\r", []),
        (b"t1000\r", b"\a", []),  # closed
        (b"S6\r", b"\r", []),
        (b"s031C\r", b"\r", []),
        (b"O\r", b"\r", []),
        (b"O\r", b"\a", []),  # open already
        (b"S6\r", b"\a", []),  # not while open
        (b"F\r", b"F00\r", []),
        (b"Z0\r", b"\r", []),
        (b"Z1\r", b"\a", []),
        (b"t1A044E61BC00\r", b"z\r", [FRAME]),
        (b"T18FF00218FFFFFFFFFFFFFFFF\r", b"Z\r", [Frame(0x18FF0021, b"\xff" * 8, is_extended=True)]),
        (b"r1A04\r", b"z\r", [Frame(0x1A0, bytes(4), is_remote=True)]),
        (b"R000001A00\r", b"Z\r", [Frame(0x1A0, b"", is_extended=True, is_remote=True)]),
        (b"t8000\r", b"\a", []),  # identifier beyond 11 bits
        (b"t1A09\r", b"\a", []),
        (b"t1A02FF\r", b"\a", []),
        (b"t1A0\r", b"\a", []),
        (b"tXYZ0\r", b"\a", []),
        (b"C\r", b"\r", []),
        (b"C\r", b"\a", []),
        (b"Q\r", b"\a", []),
    ]
    for sent, received, frames in conversation:
        assert adapter.feed(sent) == (received, frames), sent


def test_listen_only_refuses_to_send_and_hears_all() -> None:
    adapter = SlcanAdapter()
    assert adapter.encode(FRAME) == b""
    adapter.feed(b"L\r")
    assert adapter.channel is Channel.LISTEN_ONLY
    assert adapter.feed(b"t1A044E61BC00\r") == (b"\a", [])
    assert adapter.refused == 1
    assert adapter.encode(FRAME) == b"t1A044E61BC00\r"


def test_the_wrong_bit_rate_hears_nothing_and_sends_nothing() -> None:
    adapter = SlcanAdapter(250_000)
    adapter.feed(b"S6\rO\r")
    assert adapter.encode(FRAME) == b""
    assert adapter.feed(b"t1000\r") == (b"\a", [])
    adapter.feed(b"C\rS5\rO\r")
    assert adapter.encode(FRAME) != b""


def test_errors_on_the_bus_are_told_in_lines_of_their_own() -> None:
    adapter = SlcanAdapter()
    bus_off = Frame(0x040, bytes(8), is_error=True)
    assert adapter.encode(bus_off) == b""  # closed
    adapter.feed(b"O\r")
    assert adapter.encode(bus_off) == b"sb000000\r"
    assert adapter.encode(Frame(0x004, bytes([0, 0x10, 0, 0, 0, 0, 0, 0]), is_error=True)) == b"sp000000\r"
    assert adapter.encode(Frame(0x020, bytes(8), is_error=True)) == b"e1a\r"
    assert adapter.encode(Frame(0x200, bytes(8), is_error=True)) == b""  # none that adapters tell of


@given(st.lists(st.binary(max_size=30), max_size=20))
def test_no_bytes_upset_the_adapter(pieces: list[bytes]) -> None:
    adapter = SlcanAdapter()
    for piece in pieces:
        for command in (piece, b"O\rt" + piece + b"\r"):
            _, frames = adapter.feed(command)
            assert all(len(f.data) <= 8 for f in frames)


class Bench:
    """An adapter behind a pty, served by a thread; what the host sends is collected and echoed one identifier up."""

    def __init__(self, path: Path) -> None:
        self.adapter, self.port = SlcanAdapter(), PtyPort(path)
        self.sent: list[Frame] = []
        self._stop_read, self._stop_write = os.pipe()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            ready, _, _ = select.select([self.port.fileno(), self._stop_read], [], [])
            if self._stop_read in ready:
                return
            answers, frames = self.adapter.feed(self.port.read())
            self.port.write(answers)
            self.sent += frames
            for frame in frames:
                self.port.write(self.adapter.encode(frame._replace(arbitration_id=frame.arbitration_id + 1)))

    def close(self) -> None:
        os.write(self._stop_write, b"x")
        self._thread.join()
        os.close(self._stop_read)
        os.close(self._stop_write)
        self.port.unplug()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path / "can")
    yield bench
    bench.close()


@pytest.mark.parametrize("extended", [False, True])
def test_python_can_talks_to_the_adapter(bench: Bench, extended: bool) -> None:
    with can.Bus(interface="slcan", channel=str(bench.port.path), bitrate=500_000, sleep_after_open=0) as bus:
        out = can.Message(arbitration_id=0x123, is_extended_id=extended, data=b"\x01\x02\x03")
        bus.send(out)
        got = None
        for _ in range(200):
            got = bus.recv(0.05)
            if got is not None:
                break
        assert got is not None
        assert (got.arbitration_id, bytes(got.data), got.is_extended_id) == (0x124, b"\x01\x02\x03", extended)
    assert bench.sent == [Frame(0x123, b"\x01\x02\x03", is_extended=extended)]


def test_python_can_in_listen_only_puts_nothing_on_the_bus(bench: Bench) -> None:
    with can.Bus(
        interface="slcan", channel=str(bench.port.path), bitrate=500_000, listen_only=True, sleep_after_open=0
    ) as bus:
        bus.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\x01"))
        bus.send(can.Message(arbitration_id=0x124, is_extended_id=False, data=b"\x01"))
        assert bus.recv(0.2) is None
    assert bench.sent == []
    assert bench.adapter.refused == 2


class TestPtyPort:
    def test_unplugging_takes_link_and_device_away_and_plugging_brings_them_back(self, tmp_path: Path) -> None:
        port = PtyPort(tmp_path / "port")
        device = os.readlink(tmp_path / "port")
        host = os.open(device, os.O_RDWR | os.O_NOCTTY)
        port.write(b"hello")
        assert os.read(host, 10) == b"hello"
        os.write(host, b"\x03\x11raw\r\n")
        assert port.read() == b"\x03\x11raw\r\n"
        port.unplug()
        port.unplug()
        assert not (tmp_path / "port").is_symlink()
        assert port.read() == b""
        port.write(b"nobody hears")
        with pytest.raises(OSError, match="Input/output error"):
            os.write(host, b"x")
        os.close(host)
        port.plug()
        host = os.open(tmp_path / "port", os.O_RDWR | os.O_NOCTTY)
        port.write(b"again")
        assert os.read(host, 10) == b"again"
        os.close(host)
        port.unplug()

    def test_a_host_that_does_not_read_loses_bytes_but_never_blocks(self, tmp_path: Path) -> None:
        port = PtyPort(tmp_path / "port")
        for _ in range(300):
            port.write(b"x" * 1000)
        assert port.lost > 0
        port.discard()
        host = os.open(tmp_path / "port", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        with pytest.raises(BlockingIOError):
            os.read(host, 10)
        port.write(b"fresh")
        assert os.read(host, 10) == b"fresh"
        os.close(host)
        port.unplug()

    def test_nothing_to_read_is_no_bytes(self, tmp_path: Path) -> None:
        port = PtyPort(tmp_path / "port")
        assert port.read() == b""
        port.unplug()

    def test_a_link_that_cannot_be_made_is_an_os_error(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError):
            PtyPort(tmp_path / "nowhere" / "port")

    def test_a_stale_link_is_replaced_and_someone_elses_is_left_alone(self, tmp_path: Path) -> None:
        path = tmp_path / "port"
        path.symlink_to("/dev/null")
        first = PtyPort(path)
        second = PtyPort(path)
        first.unplug()
        assert path.is_symlink()
        second.unplug()
        assert not path.is_symlink()
