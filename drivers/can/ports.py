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
import itertools
import os
import queue
import select
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import can
from can.interfaces.slcan import slcanBus
from can.interfaces.virtual import VirtualBus

from drivers.can.frame import DATA_MAX, Frame, parse_can_frame, parse_multicast
from drivers.can.port import (
    BATCH_MAX,
    INTERFACE_DROPS,
    NOT_A_FRAME,
    OVERFLOW,
    Batch,
    CanPort,
    Received,
    frame_of,
    message_of,
)
from drivers.can.slcan_port import SlcanPort
from drivers.clock import NS_PER_S
from drivers.errors import LinkError

Interface = Literal["socketcan", "virtual", "udp_multicast", "slcan"]

ADAPTER_READY_S = 1.2  # wait after opening the port, as some slcan adapters restart then; opening takes under 2 s
GATHER_S = 0.005  # frames this soon after the first are read together with it, as each wake-up costs as much as a few

# Linux, include/uapi/asm-generic/socket.h; Python's socket module does not name them
SO_RCVBUFFORCE = 33
SO_TIMESTAMPNS = 35
SO_RXQ_OVFL = 40

_TIMESPEC = struct.Struct("@qq")
_DROPS = struct.Struct("@I")
_ANCILLARY_BYTES = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_DROPS.size)


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
            raise LinkError(config.name, f"cannot open {what}: {message_of(error)}; {_hint(config, error)}") from error
        on_failure.pop_all()
        return port


def _port(bus: can.BusABC, config: CanLinkConfig) -> CanPort:
    where = config.name
    if isinstance(bus, slcanBus):
        return SlcanPort(where, bus, is_listen_only=not config.allow_transmit)
    if isinstance(bus, VirtualBus):
        return VirtualPort(where, bus)
    descriptor = socket.socket(fileno=os.dup(bus.fileno()))
    if config.interface == "socketcan":
        statistics = Path("/sys/class/net") / config.channel / "statistics"
        return SocketCanPort(where, bus, descriptor, config.receive_buffer_bytes, statistics)
    return MulticastPort(where, bus, descriptor, config.receive_buffer_bytes)


def _hint(config: CanLinkConfig, error: BaseException) -> str:
    if isinstance(error, OSError) and error.errno == errno.EAFNOSUPPORT:
        return "the kernel has no CAN support loaded: run `modprobe can_raw` (in a container: on its host)"
    if config.interface == "socketcan":
        mode = f"bitrate {config.bitrate or 250_000} listen-only {'off' if config.allow_transmit else 'on'}"
        return f"try: ip link set {config.channel} up type can {mode} restart-ms 100"
    if config.interface == "slcan":
        return "check that the adapter is plugged in, that this user may access the port, and that the bitrate is right"
    return "check the channel and the options of the link"


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
                    received.append(Received(frame_of(message), None))
                if len(received) >= BATCH_MAX:
                    is_last = False
                    break
                message = take()
        return Batch(received, is_last)
