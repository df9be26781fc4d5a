"""Ports to a CAN bus. python-can opens, configures, sends and closes; received frames are read from its descriptor.

A port never waits to send, because frames would not be read in the meantime.

python-can's own `recv` computes its timeout on the wall clock, builds and logs an object for every frame and hides the
kernel's count of lost frames. A port therefore waits on the file descriptor that `fileno()` returns (duplicated, so
that each side closes its own) and parses what arrives: SocketCAN's `can_frame`, the datagrams of `udp_multicast`, the
lines of slcan. The in-process bus `virtual` has no descriptor; its public queue is read instead.
"""

from __future__ import annotations

import abc
import contextlib
import errno
import fcntl
import itertools
import os
import queue
import select
import socket
import struct
import termios
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import can
from can.interfaces.slcan import slcanBus
from can.interfaces.virtual import VirtualBus

from drivers.can.frame import DATA_MAX, Frame, SlcanLines, parse_can_frame, parse_multicast, slcan_line
from drivers.clock import NS_PER_S
from drivers.errors import LinkError
from drivers.last_reads import more_may_wait

Interface = Literal["socketcan", "virtual", "udp_multicast", "slcan"]

ADAPTER_READY_S = 1.2  # wait after opening the port, as some slcan adapters restart then; opening takes under 2 s
BATCH_MAX = 512  # frames per read, so that a flooded bus cannot keep the loop from its other duties
CLOSE_WRITE_S = 1.0  # longest wait for an slcan adapter to accept the command that closes its channel
OUTDATED_S = 0.05  # frames that the terminal of an slcan adapter has held for longer are discarded
GATHER_S = 0.005  # frames this soon after the first are read together with it, as each wake-up costs as much as a few

# Linux, include/uapi/asm-generic/socket.h; Python's socket module does not name them
SO_RCVBUFFORCE = 33
SO_TIMESTAMPNS = 35
SO_RXQ_OVFL = 40

_TIMESPEC = struct.Struct("@qq")
_DROPS = struct.Struct("@I")
_ANCILLARY_BYTES = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_DROPS.size)

OVERFLOW = "the kernel's receive buffer was full"
NOT_A_FRAME = "not a classic CAN frame"
ADAPTER_LINE = "the adapter sent a line that is not a frame"
INTERFACE_DROPS = "the interface's statistics show losses"


class Received(NamedTuple):
    """A frame and the kernel's receive time (nanoseconds UTC), or None if the kernel gives none."""

    frame: Frame
    kernel_utc_ns: int | None


class Batch(NamedTuple):
    """Frames of one read.

    Attributes:
        received: the frames, in order.
        is_last: nothing was left to read.
    """

    received: list[Received]
    is_last: bool


@dataclass(frozen=True, kw_only=True)
class CanLinkConfig:
    """Configuration of a CAN link.

    Attributes:
        name: name of the link, by which channels refer to it.
        interface: `socketcan`, `slcan`, `udp_multicast` (between processes) or `virtual` (within one).
        channel: interface name (`can0`), serial port (`/dev/ttyACM0`), multicast group or any name.
        bitrate: bit rate of the bus in bit/s; set on slcan adapters only, as the system sets up SocketCAN interfaces.
        allow_transmit: the link may send; without it slcan adapters are opened listen-only.
        transmit_nodes: node IDs that may be addressed.
        own_identifiers: 11-bit identifiers that `publish` may send.
        sync_period_ms: period at which to send SYNC; None for no SYNC.
        receive_buffer_bytes: receive buffer of the socket; 4 MiB, doubled by the kernel for its overhead, hold over a
            second of traffic on a saturated 1 Mbit/s bus.
        options: further arguments of python-can's bus (`port` and `hop_limit` of udp_multicast, `sleep_after_open` of
            slcan, ...).
    """

    name: str
    interface: Interface
    channel: str
    bitrate: int | None = None
    allow_transmit: bool = False
    transmit_nodes: tuple[int, ...] = ()
    own_identifiers: tuple[int, ...] = ()
    sync_period_ms: float | None = None
    receive_buffer_bytes: int = 4 << 20
    options: Mapping[str, Any] = field(default_factory=dict)


def open_port(config: CanLinkConfig) -> CanPort:
    """Open the port of a link.

    A link that may not transmit opens an slcan adapter listen-only: it does not even acknowledge frames.

    Raises:
        LinkError: the port cannot be opened; the message states what the operator can do.
    """
    arguments = dict(config.options)
    if config.interface == "slcan":
        arguments = {"sleep_after_open": ADAPTER_READY_S} | arguments
        arguments |= {"bitrate": config.bitrate, "listen_only": not config.allow_transmit}
    with contextlib.ExitStack() as on_failure:
        try:
            bus = can.Bus(config.channel, config.interface, ignore_config=True, **arguments)
            on_failure.callback(bus.shutdown)
            port = _port(bus, config)
        except (can.CanError, OSError, ValueError, TypeError) as error:
            what = f"{config.interface} {config.channel!r}"
            raise LinkError(config.name, f"cannot open {what}: {_message_of(error)}; {_hint(config, error)}") from error
        on_failure.pop_all()
        return port


def _port(bus: can.BusABC, config: CanLinkConfig) -> CanPort:
    where = config.name
    if isinstance(bus, slcanBus):
        return SlcanPort(where, bus)
    if isinstance(bus, VirtualBus):
        return VirtualPort(where, bus)
    descriptor = socket.socket(fileno=os.dup(bus.fileno()))
    if config.interface == "socketcan":
        statistics = Path("/sys/class/net") / config.channel / "statistics"
        return SocketCanPort(where, bus, descriptor, config.receive_buffer_bytes, statistics)
    return MulticastPort(where, bus, descriptor, config.receive_buffer_bytes)


def _message_of(error: BaseException) -> str:
    """Return the system's error text if there is one, without the repeated paths that libraries add to it."""
    cause = error.__cause__ or error
    if isinstance(cause, OSError) and cause.errno is not None and cause.errno > 0:
        return os.strerror(cause.errno)
    return str(error).strip().rstrip(".") or type(error).__name__


def _hint(config: CanLinkConfig, error: BaseException) -> str:
    if isinstance(error, OSError) and error.errno == errno.EAFNOSUPPORT:
        return "the kernel has no CAN support loaded: run `modprobe can_raw` (in a container: on its host)"
    if config.interface == "socketcan":
        mode = f"bitrate {config.bitrate or 250_000} listen-only {'off' if config.allow_transmit else 'on'}"
        return f"try: ip link set {config.channel} up type can {mode} restart-ms 100"
    if config.interface == "slcan":
        return "check that the adapter is plugged in, that this user may access the port, and that the bitrate is right"
    return "check the channel and the options of the link"


class CanPort(abc.ABC):
    """An open port to a bus; python-can sends and closes. Every failure of the bus or its adapter raises LinkError."""

    def __init__(self, where: str, bus: can.BusABC) -> None:
        self._where = where
        self._bus = bus
        self._losses: dict[str, int] = {}

    @abc.abstractmethod
    def receive(self, timeout_s: float) -> Batch:
        """Return up to BATCH_MAX frames; wait for at most `timeout_s` real seconds for the first."""

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when a frame arrives; LinkError if there is none (`virtual`)."""
        raise LinkError(self._where, "an in-process bus has no descriptor")

    def send(self, frame: Frame) -> bool:
        """Send one frame without waiting; return False if it was not sent because the transmit queue is full."""
        message = can.Message(
            arbitration_id=frame.arbitration_id,
            data=frame.data,
            is_extended_id=frame.is_extended,
            is_remote_frame=frame.is_remote,
        )
        try:
            self._send(message)
        except (can.CanError, OSError) as error:
            if _is_queue_full(error):
                return False
            raise self._gone(error) from error
        return True

    def losses(self) -> dict[str, int]:
        """Return the number of frames lost since the port was opened, by reason."""
        return dict(self._losses)

    def close(self) -> None:
        """Close the port. Never raises."""
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()

    def _send(self, message: can.Message) -> None:
        self._bus.send(message, timeout=0.0)

    def _count_lost(self, reason: str, count: int = 1) -> None:
        self._losses[reason] = self._losses.get(reason, 0) + count

    def _gone(self, error: BaseException) -> LinkError:
        return LinkError(self._where, f"connection to the bus lost: {_message_of(error)}")


def _is_queue_full(error: BaseException) -> bool:
    """Return True if a frame was not sent only because the transmit queue is full."""
    code = getattr(error.__cause__ or error, "errno", None)
    return code in (errno.ENOBUFS, errno.EAGAIN) or str(error) == "Transmit buffer full"  # python-can's, without a code


class _DatagramPort(CanPort):
    """Base of the ports on a socket, where every datagram is a frame, timestamped by the kernel on arrival."""

    def __init__(self, where: str, bus: can.BusABC, descriptor: socket.socket, receive_buffer_bytes: int) -> None:
        super().__init__(where, bus)
        self._socket = descriptor
        self._failure: LinkError | None = None
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer_bytes)
        with contextlib.suppress(PermissionError):  # may exceed net.core.rmem_max, but needs CAP_NET_ADMIN
            self._socket.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, receive_buffer_bytes)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        self._overflows = 0

    def fileno(self) -> int:
        return self._socket.fileno()

    def receive(self, timeout_s: float) -> Batch:
        received: list[Received] = []
        receive_message = self._socket.recvmsg
        is_last = True
        until_s = time.monotonic() + timeout_s
        try:
            ready = self._failure is not None or select.select([self._socket], [], [], timeout_s)[0]
        except OSError as error:
            raise self._gone(error) from error
        if ready and self._failure is None:
            time.sleep(min(GATHER_S, max(0.0, until_s - time.monotonic())))
        for _ in range(BATCH_MAX if ready else 0):
            try:
                datagram, ancillary, _flags, _sender = receive_message(4096, _ANCILLARY_BYTES, socket.MSG_DONTWAIT)
            except BlockingIOError:
                break  # all read
            except OSError as error:
                if self._failure is not None:
                    break
                self._failure = self._gone(error)
                continue
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
        else:
            is_last = not ready
        # The kernel reports a failure once, ahead of the frames that arrived before it; return those frames first
        if self._failure is not None and not received:
            raise self._failure
        return Batch(received, is_last)

    def close(self) -> None:
        super().close()
        self._socket.close()

    @abc.abstractmethod
    def _parse(self, datagram: bytes) -> Frame | None:
        """Return the frame of a datagram; if it is not a frame, count it as lost and return None."""

    def _count_overflows(self, total: int) -> None:
        if total != self._overflows:
            self._count_lost(OVERFLOW, (total - self._overflows) & 0xFFFFFFFF)
            self._overflows = total


class SocketCanPort(_DatagramPort):
    """A SocketCAN interface: a raw socket that also receives error frames."""

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
            self._count_lost(NOT_A_FRAME)
        return frame


def interface_drops(statistics: Path) -> int:
    """Return the number of frames that the interface itself lost.

    Args:
        statistics: directory /sys/class/net/<interface>/statistics; counters that are missing there count as 0.
    """
    total = 0
    for name in ("rx_dropped", "rx_fifo_errors", "rx_missed_errors", "rx_over_errors"):
        with contextlib.suppress(OSError, ValueError):
            total += int((statistics / name).read_text(encoding="ascii"))
    return total


class MulticastPort(_DatagramPort):
    """python-can's `udp_multicast`: a bus between processes, for simulators.

    The kernel delivers a sender's datagrams back to it. They are recognized by the message's timestamp, which receivers
    do not use otherwise.
    """

    _serial = itertools.count(1)

    def __init__(self, where: str, bus: can.BusABC, descriptor: socket.socket, receive_buffer_bytes: int) -> None:
        super().__init__(where, bus, descriptor, receive_buffer_bytes)
        self._sent: deque[float] = deque(maxlen=1024)

    def _send(self, message: can.Message) -> None:
        # Negative, so that it cannot be a real time, and unique to this process: process IDs have at most 22 bits
        message.timestamp = -(next(self._serial) + os.getpid() / (1 << 22))
        self._sent.append(message.timestamp)
        super()._send(message)

    def _parse(self, datagram: bytes) -> Frame | None:
        parsed = parse_multicast(datagram)
        if parsed is None:
            self._count_lost(NOT_A_FRAME)
            return None
        frame, timestamp = parsed
        return None if timestamp < 0 and timestamp in self._sent else frame


class SlcanPort(CanPort):
    """A serial adapter that speaks slcan (LAWICEL)."""

    def __init__(self, where: str, bus: slcanBus) -> None:
        super().__init__(where, bus)
        self._serial = bus.serialPortOrig
        self._serial.write_timeout = CLOSE_WRITE_S
        self._fd = bus.fileno()
        # Exclusive access: two readers on one port would each get half of the bytes
        fcntl.ioctl(self._fd, termios.TIOCEXCL)
        self._lines = SlcanLines()
        self._unwritten = b""  # end of a line that the terminal has accepted only in part
        self._emptied_s = time.monotonic()  # when the adapter was last seen to have taken all lines

    def fileno(self) -> int:
        return self._fd

    def receive(self, timeout_s: float) -> Batch:
        try:
            if not select.select([self._fd], [], [], timeout_s)[0]:
                return Batch([], True)
            data = os.read(self._fd, 65536)
        except OSError as error:
            raise self._gone(error) from error
        if not data:
            raise LinkError(self._where, "connection to the bus lost: the adapter was unplugged; plug it in again")
        frames = self._lines.feed(data)
        if self._lines.malformed:
            self._count_lost(ADAPTER_LINE, self._lines.malformed)
            self._lines.malformed = 0
        return Batch([Received(frame, None) for frame in frames], not more_may_wait(data))

    def _send(self, message: can.Message) -> None:
        """Write the frame's line without waiting; python-can waits, however long, until the adapter has taken it.

        Lines that the adapter has not taken in time are discarded, as they would be outdated when it goes on.
        """
        if not self._serial.out_waiting:
            self._emptied_s = time.monotonic()
        elif time.monotonic() - self._emptied_s > OUTDATED_S:
            fcntl.ioctl(self._fd, termios.TCFLSH, termios.TCOFLUSH)
            self._unwritten = b"\r"  # ends a line of which the adapter has taken a part
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        self._unwritten = self._unwritten[os.write(self._fd, self._unwritten) :]
        if self._unwritten:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        line = slcan_line(_frame(message))
        self._unwritten = line[os.write(self._fd, line) :]

    def close(self) -> None:
        super().close()
        with contextlib.suppress(OSError):
            self._serial.close()  # python-can leaves it open when the adapter is gone


class VirtualPort(CanPort):
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
                    self._count_lost(NOT_A_FRAME)
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
