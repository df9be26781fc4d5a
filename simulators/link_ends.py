"""The rig's ends of its two links: pseudo-terminals that it makes itself, or real interfaces and devices.

An end is plugged in or not; what is sent meanwhile is lost. A LinkError says that a real interface or device is gone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from drivers.can import frame as drivers_frame
from drivers.can.ports import CanLinkConfig, CanPort, Interface, open_port
from drivers.errors import LinkError
from drivers.stations.serial_port import SerialConfig, SerialPort
from simulators.devices.can.bus import Frame
from simulators.devices.can.slcan_adapter import Channel, SlcanAdapter
from simulators.pty_port import Backlog, PtyPort

Port = TypeVar("Port", CanPort, SerialPort)


class LinkEnd(Protocol):
    """The rig's end of a link."""

    @property
    def name(self) -> str:
        """Path or channel, for people."""

    @property
    def plugged(self) -> bool:
        """True if it is there."""

    def fileno(self) -> int:
        """Return the descriptor for `select`, while it is plugged in."""

    def plug(self) -> None:
        """Make it appear; LinkError or OSError where that is not possible at present."""

    def unplug(self) -> None:
        """Make it vanish; does nothing when it is gone."""


class CanEnd(LinkEnd, Protocol):
    """The rig's end of the bus."""

    def receive(self) -> list[Frame]:
        """Return the frames that the host sent since the last call."""

    def send(self, frames: Iterable[Frame]) -> None:
        """Send frames."""


class StationEnd(LinkEnd, Protocol):
    """The station's end of its line."""

    def read(self) -> bytes:
        """Return the bytes that the host wrote since the last call."""

    def write(self, data: bytes) -> None:
        """Send; never blocks."""


class SlcanEnd:
    """An slcan adapter on a pseudo-terminal.

    Args:
        path: where the port appears.
    """

    def __init__(self, path: Path) -> None:
        self._adapter = SlcanAdapter()
        self._port = PtyPort(path)

    @property
    def name(self) -> str:
        return self._port.name

    @property
    def plugged(self) -> bool:
        return self._port.plugged

    def fileno(self) -> int:
        return self._port.fileno()

    def plug(self) -> None:
        self._adapter = SlcanAdapter()
        self._port.plug()

    def unplug(self) -> None:
        self._port.unplug()

    def receive(self) -> list[Frame]:
        data = self._port.read()
        if not data:
            return []
        was = self._adapter.channel
        answers, frames = self._adapter.feed(data)
        if was is Channel.CLOSED and self._adapter.channel is not Channel.CLOSED:
            self._port.discard()  # what an earlier host left unread
        self._port.write(answers)
        return frames

    def send(self, frames: Iterable[Frame]) -> None:
        self._port.write(b"".join(self._adapter.encode(frame) for frame in frames))


class _DeviceEnd(Generic[Port]):
    """An end at a real interface or device, whose port is open while it is plugged in."""

    _port: Port | None = None

    @property
    def plugged(self) -> bool:
        return self._port is not None

    def fileno(self) -> int:
        return -1 if self._port is None else self._port.fileno()

    def unplug(self) -> None:
        if self._port is not None:
            self._port.close()
        self._port = None


class BusEnd(_DeviceEnd[CanPort]):
    """A real interface of python-can.

    Error frames are a controller's own: none are sent here.

    Args:
        interface, channel: as python-can has them.
        options: further arguments of its bus.

    Raises:
        LinkError: it cannot be opened.
    """

    def __init__(self, interface: Interface, channel: str, options: Mapping[str, Any]) -> None:
        self.name = f"{interface}:{channel}"
        self._config = CanLinkConfig(
            name=self.name, interface=interface, channel=channel, allow_transmit=True, options=options
        )
        self.plug()

    def plug(self) -> None:
        if self._port is None:
            self._port = open_port(self._config)

    def receive(self) -> list[Frame]:
        received = [] if self._port is None else self._port.receive(0.0).received
        return [Frame(*one.frame) for one in received if not one.frame.is_error]

    def send(self, frames: Iterable[Frame]) -> None:
        for frame in frames:
            if self._port is not None and not frame.is_error:
                self._port.send(drivers_frame.Frame(*frame))


class SerialEnd(_DeviceEnd[SerialPort]):
    """A real serial device.

    Args:
        path: the device.
        baud: bits per second; 8 data bits, no parity, 1 stop bit.

    Raises:
        LinkError: it cannot be opened.
    """

    def __init__(self, path: str, baud: int) -> None:
        self.name = path
        self._config = SerialConfig(path=path, baud=baud)
        self._backlog = Backlog()
        self.plug()

    def plug(self) -> None:
        if self._port is None:
            self._port = SerialPort(self._config, "simulator")

    def unplug(self) -> None:
        super().unplug()
        self._backlog.clear()

    def read(self) -> bytes:
        return b"" if self._port is None else self._port.read(0.0)

    def write(self, data: bytes) -> None:
        if self._port is not None:
            try:
                self._backlog.write(self._port.fileno(), data)
            except OSError as error:
                raise LinkError(self.name, f"writing failed: {error.strerror}") from error
