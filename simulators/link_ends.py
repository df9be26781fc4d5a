"""The rig's ends of its two links: pseudo-terminals that it creates itself, or real interfaces and devices.

An end is plugged in or unplugged; data sent while it is unplugged is lost. A LinkError reports that a real interface or
device was lost.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from drivers.can import frame as drivers_frame
from drivers.can.port import CanPort
from drivers.can.ports import CanLinkConfig, Interface, open_port
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
        """Path or channel, for messages."""

    @property
    def plugged(self) -> bool:
        """True if the end is plugged in."""

    def fileno(self) -> int:
        """Return the descriptor for `select`, while it is plugged in."""

    def plug(self) -> None:
        """Plug the end in; LinkError or OSError if that is not possible at present."""

    def unplug(self) -> None:
        """Unplug the end; does nothing if it is unplugged."""


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
        """Send bytes; never blocks."""


class SlcanEnd:
    """An slcan adapter on a pseudo-terminal.

    Args:
        path: path of the port's symbolic link.
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
            self._port.discard()  # data that an earlier host left unread
        self._port.write(answers)
        return frames

    def send(self, frames: Iterable[Frame]) -> None:
        self._port.write(b"".join(self._adapter.encode(frame) for frame in frames))


class _DeviceEnd(Generic[Port]):
    """An end at a real interface or device; its port is open while the end is plugged in."""

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

    Error frames come from a controller and are never sent here.

    Args:
        interface, channel: interface and channel in python-can's notation.
        options: further arguments of python-can's bus.

    Raises:
        LinkError: the interface cannot be opened.
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
        LinkError: the device cannot be opened.
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
