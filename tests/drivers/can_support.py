"""Buses, captures and nodes for tests of CAN drivers."""

from __future__ import annotations

import contextlib
import itertools
import os
import pty
import select
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import can

from drivers.can.ports import CanLinkConfig, Interface
from drivers.can_link import CanLink
from drivers.clock import Clock, Stamp, SystemClock
from drivers.readings import CanCapture, DeviceEvent, EventKind, Gap, Reading, Record

RIGS = Path(__file__).parents[2] / "calibration" / "rigs"
EDS = RIGS / "cia406.eds"
DBC = RIGS / "machine.dbc"
DEADLINE_S = 5.0
START = Stamp(1_700_000_000_000_000_000, 1_000_000_000, "boot")

_channels = itertools.count(1)


def unused_channel() -> str:
    """A virtual bus of its own for every test."""
    return f"test-bus-{next(_channels)}"


def at(seconds: float) -> Stamp:
    """The instant `seconds` after START."""
    return START.shifted(round(seconds * 1e9))


def capture(text: str, seconds: float = 0.0, **flags: bool) -> CanCapture:
    """Make a capture from its notation: `1A0 4E 61 BC 00`; an identifier of 8 digits is extended."""
    identifier, *data = text.split()
    return CanCapture(
        "boom", at(seconds), int(identifier, 16), bytes.fromhex("".join(data)), len(identifier) == 8, **flags
    )


def late(text: str, seconds: float = 0.0, **flags: bool) -> CanCapture:
    """The same, of doubtful time."""
    captured = capture(text, seconds, **flags)
    return replace(captured, stamp=captured.stamp.doubted())


def the_reading(records: object) -> Reading:
    """The only reading among records."""
    (reading,) = [r for r in records if isinstance(r, Reading)]
    return reading


def events(records: object) -> list[DeviceEvent]:
    """The device events among records."""
    return [r for r in records if isinstance(r, DeviceEvent)]


class Heard:
    """Items that a link emitted; waits for conditions instead of sleeping."""

    def __init__(self) -> None:
        self._items: list[CanCapture | DeviceEvent | Gap | Record] = []
        self._changed = threading.Condition()

    def __call__(self, item: object) -> None:
        with self._changed:
            self._items.append(item)
            self._changed.notify_all()

    @property
    def captures(self) -> list[CanCapture]:
        with self._changed:
            return [item for item in self._items if isinstance(item, CanCapture)]

    @property
    def received(self) -> list[CanCapture]:
        return [item for item in self.captures if not item.is_transmitted]

    @property
    def sent(self) -> list[CanCapture]:
        return [item for item in self.captures if item.is_transmitted]

    @property
    def gaps(self) -> list[Gap]:
        with self._changed:
            return [item for item in self._items if isinstance(item, Gap)]

    def events(self, kind: EventKind | None = None) -> list[DeviceEvent]:
        with self._changed:
            found = [item for item in self._items if isinstance(item, DeviceEvent)]
        return [event for event in found if kind in (None, event.kind)]

    def wait(self, condition: Callable[[], object], what: str) -> None:
        """Until `condition` holds; fails the test after DEADLINE_S."""
        deadline = time.monotonic() + DEADLINE_S
        with self._changed:
            while not condition():
                left = deadline - time.monotonic()
                assert left > 0, f"{what} did not happen within {DEADLINE_S} s; heard {self._items[-5:]}"
                self._changed.wait(min(left, 0.05))

    def wait_for(self, kind: EventKind, count: int = 1) -> DeviceEvent:
        self.wait(lambda: len(self.events(kind)) >= count, f"{count} x {kind}")
        return self.events(kind)[count - 1]


@contextmanager
def running(link: CanLink) -> Iterator[Heard]:
    """Run a link in a thread; it must end soon after it is told to."""
    heard, stop = Heard(), threading.Event()
    thread = threading.Thread(target=link.run, args=(heard, stop))
    thread.start()
    try:
        yield heard
    finally:
        stop.set()
        thread.join(DEADLINE_S)
        assert not thread.is_alive(), "the link did not stop"


def virtual_link(channel: str, clock: Clock | None = None, **settings: object) -> CanLink:
    """A link on a virtual bus."""
    return _link("virtual", channel, clock or SystemClock(), settings)


def slcan_link(adapter: Adapter, clock: Clock | None = None, **settings: object) -> CanLink:
    """A link behind an slcan adapter."""
    options = {"bitrate": 250_000, "options": {"sleep_after_open": 0.0}}
    return _link("slcan", str(adapter.path), clock or SystemClock(), options | settings)


def _link(interface: str, channel: str, clock: Clock, settings: dict[str, object]) -> CanLink:
    of_link = {key: settings.pop(key) for key in ("setups", "configure_at_start") if key in settings}
    return CanLink(CanLinkConfig(name="boom", interface=interface, channel=channel, **settings), clock, **of_link)


def adapter_config(interface: Interface, channel: str, options: dict[str, object]) -> CanLinkConfig:
    return CanLinkConfig(name="boom", interface=interface, channel=channel, bitrate=250_000, options=options)


@contextmanager
def virtual_bus(channel: str) -> Iterator[can.BusABC]:
    """Another participant of a virtual bus."""
    bus = can.Bus(channel, "virtual", ignore_config=True)
    try:
        yield bus
    finally:
        bus.shutdown()


def message(text: str) -> can.Message:
    """A message in the notation of `capture`."""
    item = capture(text)
    return can.Message(arbitration_id=item.arbitration_id, data=item.data, is_extended_id=item.is_extended)


class Adapter:
    """The other end of an slcan adapter's serial port, on a pty that can be unplugged and plugged in again."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._master = -1
        self.plug_in()

    def plug_in(self) -> None:
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(slave))
        self._slave = slave

    def unplug(self) -> None:
        self.path.unlink()
        os.close(self._slave)
        os.close(self._master)

    def accept(self, *, nothing: bool) -> None:
        """Stop to accept what rigcal writes, or go on; as an adapter whose own buffer is full."""
        termios.tcflow(self._slave, termios.TCOOFF if nothing else termios.TCOON)

    def send(self, data: bytes) -> None:
        os.write(self._master, data)

    def waiting(self) -> bytes:
        """Return what rigcal has written and nobody has fetched, up to 64 KiB."""
        return os.read(self._master, 65536) if select.select([self._master], [], [], 0.05)[0] else b""

    def commands(self, until: bytes) -> bytes:
        """Return the frames that rigcal sent, up to and with `until`."""
        data = b""
        deadline = time.monotonic() + DEADLINE_S
        while not data.endswith(until):
            left = deadline - time.monotonic()
            assert left > 0, f"the adapter got {data!r} and no {until!r}"
            if select.select([self._master], [], [], left)[0]:
                data += os.read(self._master, 4096)
        return data


@contextmanager
def plugged_adapter(path: Path) -> Iterator[Adapter]:
    """An adapter that is plugged in at `path`."""
    adapter = Adapter(path)
    try:
        yield adapter
    finally:
        with contextlib.suppress(OSError):
            adapter.unplug()
