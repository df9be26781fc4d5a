"""Ways to a CAN bus. python-can opens, configures, sends and closes; received frames are read from where it gets them.

python-can's own `recv` computes its time-out on the wall clock, builds and logs an object for every frame and hides the
kernel's count of lost frames. A port therefore waits on the file descriptor that `fileno()` gives (duplicated, so that
each side closes its own) and parses what arrives: SocketCAN's `can_frame`, the datagrams of `udp_multicast`, the lines
of slcan. The in-process bus `virtual` has no descriptor; its public queue is read.
"""

from __future__ import annotations

import abc
import contextlib
import fcntl
import itertools
import os
import queue
import select
import socket
import struct
import termios
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import can
from can.interfaces.slcan import slcanBus
from can.interfaces.virtual import VirtualBus

from drivers.can_wire import SlcanLines, parse_can_frame, parse_multicast
from drivers.canframe import DATA_MAX, Frame
from drivers.clock import NS_PER_S
from drivers.errors import LinkError

Interface = Literal["socketcan", "virtual", "udp_multicast", "slcan"]

BATCH_MAX = 512  # frames per read, so that a flooded bus cannot keep the loop from its other duties

# Linux, include/uapi/asm-generic/socket.h; Python's socket module does not name them
SO_RCVBUFFORCE = 33
SO_TIMESTAMPNS = 35
SO_RXQ_OVFL = 40

_TIMESPEC = struct.Struct("@qq")
_DROPS = struct.Struct("@I")
_ANCILLARY_BYTES = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_DROPS.size)

OVERFLOW = "the kernel's receive buffer was full"
NOT_A_FRAME = "not a classic CAN frame"
ADAPTER_LINE = "the adapter sent a line that is no frame"
INTERFACE_DROPS = "the interface's statistics show losses"


class Received(NamedTuple):
    """A frame, and when the kernel received it (nanoseconds UTC) where the kernel says so."""

    frame: Frame
    kernel_utc_ns: int | None


class Batch(NamedTuple):
    """What one read gave.

    Attributes:
        received: the frames, in order.
        is_last: nothing was left to be read.
    """

    received: list[Received]
    is_last: bool


class CanPort(Protocol):
    """An open way to a bus. Any failure of the bus or its adapter is a LinkError."""

    def receive(self, timeout_s: float) -> Batch:
        """Wait for a frame for at most `timeout_s` real seconds; all frames that are there, up to BATCH_MAX."""

    def send(self, frame: Frame) -> None:
        """Send one frame."""

    def losses(self) -> dict[str, int]:
        """How many frames were lost since the port was opened, by reason."""

    def close(self) -> None:
        """Let go of the bus. Never raises."""


@dataclass(frozen=True, kw_only=True)
class PortSettings:
    """How to open a port.

    Attributes:
        interface: python-can's name of the kind of bus.
        channel: interface name (`can0`), virtual channel, multicast group or serial port.
        bitrate: of the bus, for adapters that set it; a SocketCAN interface has its own.
        is_listen_only: the adapter itself shall not even acknowledge frames (slcan).
        receive_buffer_bytes: of the socket.
        options: further arguments of python-can's bus.
    """

    interface: Interface
    channel: str
    bitrate: int | None
    is_listen_only: bool
    receive_buffer_bytes: int
    options: Mapping[str, Any]


def open_port(where: str, settings: PortSettings) -> CanPort:
    """Open the way to a bus.

    Args:
        where: name of the link, for messages.
        settings: see PortSettings.

    Raises:
        LinkError: with what the operator can do.
    """
    arguments = dict(settings.options)
    if settings.interface == "slcan":
        arguments |= {"bitrate": settings.bitrate, "listen_only": settings.is_listen_only}
    with contextlib.ExitStack() as on_failure:
        try:
            bus = can.Bus(settings.channel, settings.interface, ignore_config=True, **arguments)
            on_failure.callback(bus.shutdown)
            port = _port(where, bus, settings)
        except (can.CanError, OSError, ValueError, TypeError) as error:
            what = f"{settings.interface} {settings.channel!r}"
            raise LinkError(where, f"cannot open {what}: {_said(error)}; {_hint(settings)}") from error
        on_failure.pop_all()
        return port


def _port(where: str, bus: can.BusABC, settings: PortSettings) -> CanPort:
    if isinstance(bus, slcanBus):
        return SlcanPort(where, bus)
    if isinstance(bus, VirtualBus):
        return VirtualPort(where, bus)
    descriptor = socket.socket(fileno=os.dup(bus.fileno()))
    if settings.interface == "socketcan":
        statistics = Path("/sys/class/net") / settings.channel / "statistics"
        return SocketCanPort(where, bus, descriptor, settings.receive_buffer_bytes, statistics)
    return MulticastPort(where, bus, descriptor, settings.receive_buffer_bytes)


def _said(error: BaseException) -> str:
    return str(error).strip().rstrip(".") or type(error).__name__


def _hint(settings: PortSettings) -> str:
    if settings.interface == "socketcan":
        mode = f"bitrate {settings.bitrate or 250_000} listen-only {'on' if settings.is_listen_only else 'off'}"
        return f"try: ip link set {settings.channel} up type can {mode} restart-ms 100"
    if settings.interface == "slcan":
        return "check that the adapter is plugged in, that this user may use the port, and the bitrate"
    return "check the channel and the options of the link"


def _message(frame: Frame) -> can.Message:
    return can.Message(
        arbitration_id=frame.arbitration_id,
        data=frame.data,
        is_extended_id=frame.is_extended,
        is_remote_frame=frame.is_remote,
    )


class _BusPort:
    """Sending and closing, which python-can does for every port."""

    def __init__(self, where: str, bus: can.BusABC) -> None:
        self._where = where
        self._bus = bus
        self._losses: dict[str, int] = {}

    def send(self, frame: Frame) -> None:
        try:
            self._send(_message(frame))
        except (can.CanError, OSError) as error:
            raise self._lost(error) from error

    def losses(self) -> dict[str, int]:
        return dict(self._losses)

    def close(self) -> None:
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()

    def _send(self, message: can.Message) -> None:
        self._bus.send(message, timeout=1.0)

    def _lose(self, reason: str, count: int = 1) -> None:
        self._losses[reason] = self._losses.get(reason, 0) + count

    def _lost(self, error: BaseException) -> LinkError:
        return LinkError(self._where, f"the bus went away: {_said(error)}")


class _DatagramPort(_BusPort, abc.ABC):
    """A socket on which every datagram is a frame."""

    def __init__(self, where: str, bus: can.BusABC, descriptor: socket.socket, receive_buffer_bytes: int) -> None:
        super().__init__(where, bus)
        self._socket = descriptor
        self._failure: LinkError | None = None
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer_bytes)
        with contextlib.suppress(PermissionError):  # beyond net.core.rmem_max, with CAP_NET_ADMIN
            self._socket.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, receive_buffer_bytes)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        self._overflows = 0

    def receive(self, timeout_s: float) -> Batch:
        received: list[Received] = []
        receive_message = self._socket.recvmsg
        is_last = True
        try:
            ready = self._failure is None and select.select([self._socket], [], [], timeout_s)[0]
            for _ in range(BATCH_MAX if ready else 0):
                datagram, ancillary, _flags, _sender = receive_message(4096, _ANCILLARY_BYTES, socket.MSG_DONTWAIT)
                kernel_utc_ns = None
                for _level, kind, value in ancillary:
                    if kind == SO_TIMESTAMPNS:
                        seconds, nanoseconds = _TIMESPEC.unpack(value)
                        kernel_utc_ns = seconds * NS_PER_S + nanoseconds
                    elif kind == SO_RXQ_OVFL:
                        self._count_overflows(_DROPS.unpack(value)[0])
                frame = self._parse(datagram)
                if frame is not None:
                    received.append(Received(frame, kernel_utc_ns))
            is_last = not ready
        except BlockingIOError:
            pass  # all read
        except OSError as error:
            self._failure = self._lost(error)
        # The kernel reports a failure once, and what came before it is given first
        if self._failure is not None and not received:
            raise self._failure
        return Batch(received, is_last)

    def close(self) -> None:
        super().close()
        self._socket.close()

    @abc.abstractmethod
    def _parse(self, datagram: bytes) -> Frame | None:
        """The frame of a datagram; None, and counted, if it is none."""

    def _count_overflows(self, total: int) -> None:
        if total != self._overflows:
            self._lose(OVERFLOW, (total - self._overflows) & 0xFFFFFFFF)
            self._overflows = total


class SocketCanPort(_DatagramPort):
    """A SocketCAN interface: raw socket, error frames on."""

    def __init__(
        self,
        where: str,
        bus: can.BusABC,
        descriptor: socket.socket,
        receive_buffer_bytes: int,
        statistics: Path,
    ) -> None:
        super().__init__(where, bus, descriptor, receive_buffer_bytes)
        self._statistics = statistics
        self._drops_at_start = interface_drops(statistics)

    def losses(self) -> dict[str, int]:
        drops = interface_drops(self._statistics) - self._drops_at_start
        return super().losses() | ({INTERFACE_DROPS: drops} if drops > 0 else {})

    def _parse(self, datagram: bytes) -> Frame | None:
        frame = parse_can_frame(datagram)
        if frame is None:
            self._lose(NOT_A_FRAME)
        return frame


def interface_drops(statistics: Path) -> int:
    """Frames that the interface itself lost, from /sys/class/net/<interface>/statistics; 0 where there is none."""
    total = 0
    for name in ("rx_dropped", "rx_fifo_errors", "rx_missed_errors", "rx_over_errors"):
        with contextlib.suppress(OSError, ValueError):
            total += int((statistics / name).read_text(encoding="ascii"))
    return total


class MulticastPort(_DatagramPort):
    """python-can's `udp_multicast`: a bus between processes, for simulators.

    The kernel gives a sender its own datagrams back. A message's timestamp, which receivers do not use, marks them.
    """

    _serial = itertools.count(1)

    def __init__(self, where: str, bus: can.BusABC, descriptor: socket.socket, receive_buffer_bytes: int) -> None:
        super().__init__(where, bus, descriptor, receive_buffer_bytes)
        self._sent: deque[float] = deque(maxlen=1024)

    def _send(self, message: can.Message) -> None:
        # Negative, which no time is, and of this process: process identifiers have at most 22 bits
        message.timestamp = -(next(self._serial) + os.getpid() / (1 << 22))
        self._sent.append(message.timestamp)
        super()._send(message)

    def _parse(self, datagram: bytes) -> Frame | None:
        parsed = parse_multicast(datagram)
        if parsed is None:
            self._lose(NOT_A_FRAME)
            return None
        frame, timestamp = parsed
        return None if timestamp < 0 and timestamp in self._sent else frame


class SlcanPort(_BusPort):
    """A serial adapter that speaks slcan (LAWICEL)."""

    def __init__(self, where: str, bus: slcanBus) -> None:
        super().__init__(where, bus)
        self._serial = bus.serialPortOrig
        self._fd = bus.fileno()
        # Two readers on one port get half of the bytes each
        fcntl.ioctl(self._fd, termios.TIOCEXCL)
        self._lines = SlcanLines()

    def receive(self, timeout_s: float) -> Batch:
        try:
            if not select.select([self._fd], [], [], timeout_s)[0]:
                return Batch([], True)
            data = os.read(self._fd, 65536)
        except OSError as error:
            raise self._lost(error) from error
        if not data:
            raise LinkError(self._where, "the bus went away: the adapter was unplugged")
        frames = self._lines.feed(data)
        if self._lines.malformed:
            self._lose(ADAPTER_LINE, self._lines.malformed)
            self._lines.malformed = 0
        return Batch([Received(frame, None) for frame in frames], True)

    def close(self) -> None:
        super().close()
        with contextlib.suppress(OSError):
            self._serial.close()  # python-can leaves it open when the adapter is gone


class VirtualPort(_BusPort):
    """python-can's in-process bus, for tests and for simulators in the same process."""

    def __init__(self, where: str, bus: VirtualBus) -> None:
        super().__init__(where, bus)
        self._queue = bus.queue

    def receive(self, timeout_s: float) -> Batch:
        received: list[Received] = []
        is_last = True
        take: Callable[[], can.Message] = self._queue.get_nowait
        with contextlib.suppress(queue.Empty):
            message = self._queue.get(timeout=timeout_s) if timeout_s > 0 else take()
            while True:
                if message.is_fd or len(message.data) > DATA_MAX:
                    self._lose(NOT_A_FRAME)
                else:
                    received.append(Received(_frame(message), None))
                if len(received) >= BATCH_MAX:
                    is_last = False
                    break
                message = take()
        return Batch(received, is_last)


def _frame(message: can.Message) -> Frame:
    return Frame(
        message.arbitration_id,
        bytes(message.data),
        message.is_extended_id and not message.is_error_frame,
        message.is_remote_frame,
        message.is_error_frame,
    )
