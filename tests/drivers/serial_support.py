"""Real pseudo-terminals and the frames of docs/reference/protocols.md, for tests of serial drivers."""

from __future__ import annotations

import os
import pty
import select
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from drivers.clock import Clock, Stamp, SystemClock
from drivers.readings import DeviceEvent, EventKind, Gap, LinkItem, SerialCapture
from drivers.stations.config import StationConfig
from drivers.stations.link import StationLink

DEADLINE_S = 5.0

# Samples of docs/reference/protocols.md 1.5, BCC included.
SLOPE_MM = b"?+00001060m0905356+3545105d+00001060t60+00+00096"
SLOPE_FINE = b"(+000021760m26822425+34706355d+000021751t00+0000+000**070"
ANGLES = b"<0905356+3545105-0032d080"
COORDINATES = b"U+1234566148-00023344-00029912m+2515656d101"
TRACKING = b"Q+011784812m08520300+12030400d+011745724t15+0000+025000r121"
SAMPLES = (SLOPE_MM, SLOPE_FINE, ANGLES, COORDINATES, TRACKING)
SET_REPLY = b"0006662 0804806 0394324 97"
ACK_FRAME = b"\x06006\x03\r\n"

START = Stamp(1_700_000_000_000_000_000, 1_000_000_000, "boot")


def framed(data: bytes) -> bytes:
    """`data` with a BCC computed here, not by the code under test, ETX and CR LF."""
    bcc = 0
    for byte in data:
        bcc ^= byte
    return data + f"{bcc:03d}".encode() + b"\x03\r\n"


def tracking_record(
    slope_mm: float = 10_000.0,
    hz_deg_int: int = 0,
    flag: int = 1,
    tilt: str = "t",
    zenith: str = "09000000",
    horizontal_mm: float | None = None,
) -> bytes:
    """A `Q` frame as a station sends it, at whole degrees of the horizontal circle."""
    horizontal = slope_mm if horizontal_mm is None else horizontal_mm
    return framed(
        f"Q{round(slope_mm * 10):+010d}m{zenith}+{hz_deg_int:03d}00000d{round(horizontal * 10):+010d}"
        f"{tilt}15+0000+02500{flag}r".encode()
    )


def at(seconds: float) -> Stamp:
    """The instant `seconds` after START."""
    return START.shifted(round(seconds * 1e9))


def received(data: bytes, seconds: float = 0.0, link: str = "station") -> SerialCapture:
    """A capture of `data`, complete at `seconds`."""
    return SerialCapture(link, at(seconds), data)


class Instrument:
    """The far end of a pseudo-terminal behind a link, as an adapter's device path is behind a udev link.

    Args:
        path: the link to make.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._master = self._slave = -1
        self.plug_in()

    def plug_in(self) -> None:
        """A new pseudo-terminal under the same path."""
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        """The device goes away, and its path with it."""
        self.path.unlink()
        os.close(self._slave)
        os.close(self._master)
        self._master = self._slave = -1

    def close(self) -> None:
        if self._master >= 0:
            self.unplug()

    def accept(self, *, nothing: bool) -> None:
        """Stop to accept what rigcal writes, or go on; as an adapter whose own buffer is full."""
        termios.tcflow(self._slave, termios.TCOOFF if nothing else termios.TCOON)

    def send(self, data: bytes) -> None:
        os.write(self._master, data)

    def receive(self, count: int) -> bytes:
        """Exactly `count` bytes that the host sent."""
        data = b""
        deadline = time.monotonic() + DEADLINE_S
        while len(data) < count:
            ready, _, _ = select.select([self._master], [], [], max(0.0, deadline - time.monotonic()))
            assert ready, f"host sent {data!r} and no more within {DEADLINE_S} s"
            data += os.read(self._master, count - len(data))
        return data

    def expect(self, data: bytes) -> None:
        """The host sends `data` next."""
        assert self.receive(len(data)) == data

    def has_received(self) -> bool:
        """Whether the host has sent anything that was not fetched."""
        return bool(select.select([self._master], [], [], 0)[0])


@contextmanager
def plugged_in(path: Path) -> Iterator[Instrument]:
    """An instrument, unplugged at the end."""
    instrument = Instrument(path)
    try:
        yield instrument
    finally:
        instrument.close()


class Collected:
    """What a link emits, with waiting for more."""

    def __init__(self) -> None:
        self.items: list[LinkItem] = []
        self._more = threading.Condition()

    def emit(self, item: LinkItem) -> None:
        with self._more:
            self.items.append(item)
            self._more.notify_all()

    def wait_for(self, condition: Callable[[], bool]) -> None:
        with self._more:
            assert self._more.wait_for(condition, DEADLINE_S), f"not within {DEADLINE_S} s; so far: {self.items}"

    def events(self, kind: EventKind) -> list[DeviceEvent]:
        return [item for item in self.items if isinstance(item, DeviceEvent) and item.kind is kind]

    def wait_for_event(self, kind: EventKind, count: int = 1) -> DeviceEvent:
        self.wait_for(lambda: len(self.events(kind)) >= count)
        return self.events(kind)[count - 1]

    def captures(self) -> list[SerialCapture]:
        return [item for item in self.items if isinstance(item, SerialCapture)]

    def gaps(self) -> list[Gap]:
        return [item for item in self.items if isinstance(item, Gap)]

    def wait_for_bytes(self, count: int) -> None:
        self.wait_for(lambda: len(self.received_bytes()) >= count)

    def received_bytes(self) -> bytes:
        return b"".join(capture.data for capture in self.captures() if not capture.is_transmitted)


@contextmanager
def running(config: StationConfig, clock: Clock | None = None) -> Iterator[Collected]:
    """A station's link in a thread of its own, stopped and joined at the end."""
    collected, stop = Collected(), threading.Event()
    link = StationLink(config, clock or SystemClock())
    thread = threading.Thread(target=link.run, args=(collected.emit, stop))
    thread.start()
    try:
        yield collected
    finally:
        stop.set()
        thread.join(DEADLINE_S)
        assert not thread.is_alive(), "the link did not stop"
