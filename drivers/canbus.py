"""The CAN link: one loop that owns one bus, stamps every frame as it arrives and hands it on undecoded."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from drivers.attendance import CLOCK_WAS_SET, NOT_READ_IN_TIME, Attendance, DoubtReport
from drivers.can_ports import OVERFLOW, Batch, CanPort, Interface, PortSettings, open_port
from drivers.can_stamps import ReceiveStamps
from drivers.can_sync import SyncProducer
from drivers.can_transmit import TransmitPermission
from drivers.canframe import Frame
from drivers.canopen_setup import NodeSetup, SetupConversation
from drivers.clock import NS_PER_S, Clock, Stamp
from drivers.device_watch import DeviceWatch, no_watch, watch_interface, watch_path
from drivers.errors import DeviceError, LinkError
from drivers.readings import CanCapture, Capture, DeviceEvent, EventKind, Gap, GapReason

POLL_S = 0.05  # how long a stop or a set-up request may go unnoticed
LOSS_CHECK_NS = NS_PER_S
BACKOFF_FIRST_S = 0.5
BACKOFF_MAX_S = 2.0  # a device that is back is found within this, even where nothing tells that it is

Emit = Callable[[Capture | DeviceEvent | Gap], None]


@dataclass(frozen=True, kw_only=True)
class CanLinkConfig:
    """A CAN link.

    Attributes:
        name: of the link, as channels name it.
        interface: `socketcan`, `slcan`, `udp_multicast` (between processes) or `virtual` (within one).
        channel: interface name (`can0`), serial port (`/dev/ttyACM0`), multicast group or any name.
        bitrate: of the bus, bit/s; set on slcan adapters, a SocketCAN interface is set up by the system.
        allow_transmit: the link may send at all; without it slcan adapters are opened listen-only.
        transmit_nodes: nodes that may be addressed.
        own_identifiers: 11-bit identifiers that `publish` may send.
        sync_period_ms: send SYNC at this period; None: do not.
        sync_counter: SYNC carries a counter 1 to 240 (nodes whose object 1019h is 240).
        receive_buffer_bytes: of the socket; 4 MiB, doubled by the kernel for its overhead, hold over a second of a
            saturated 1 Mbit/s bus.
        options: further arguments of python-can's bus (`port` and `hop_limit` of udp_multicast, ...).
    """

    name: str
    interface: Interface
    channel: str
    bitrate: int | None = None
    allow_transmit: bool = False
    transmit_nodes: tuple[int, ...] = ()
    own_identifiers: tuple[int, ...] = ()
    sync_period_ms: float | None = None
    sync_counter: bool = False
    receive_buffer_bytes: int = 4 << 20
    options: Mapping[str, Any] = field(default_factory=dict)


class Backoff:
    """Waiting times between attempts: doubling from BACKOFF_FIRST_S to BACKOFF_MAX_S, the same every time."""

    def __init__(self) -> None:
        self._next_s = BACKOFF_FIRST_S

    def next_s(self) -> float:
        """How long to wait now."""
        wait_s, self._next_s = self._next_s, min(2 * self._next_s, BACKOFF_MAX_S)
        return wait_s

    def reset(self) -> None:
        """All is well again."""
        self._next_s = BACKOFF_FIRST_S


class CanLink:
    """Owns one CAN bus: receives, survives its loss, and sends only what the configuration allows (default: nothing).

    Args:
        config: see CanLinkConfig.
        clock: stamps the frames and paces SYNC and repetitions.
        setups: what `request_setup` knows how to set up.
        configure_at_start: set all of them up when the bus is opened for the first time, and only then. For simulated
            machines, which are always parked; on a real one an operator has to say so each time.

    Raises:
        TransmitForbiddenError: SYNC, own identifiers or a set-up at the start are asked for where not allowed.
    """

    def __init__(
        self,
        config: CanLinkConfig,
        clock: Clock,
        setups: Iterable[NodeSetup] = (),
        *,
        configure_at_start: bool = False,
    ) -> None:
        self.name = config.name
        self._config = config
        self._clock = clock
        self._permission = TransmitPermission(
            config.name, config.allow_transmit, config.transmit_nodes, config.own_identifiers
        )
        self._published: deque[Sequence[Frame]] = deque(maxlen=1)
        if config.sync_period_ms is not None:
            self._permission.check_link()
            if config.sync_period_ms <= 0:
                raise ValueError(f"{config.name}: sync_period_ms must be positive, got {config.sync_period_ms}")
        self._setups = {setup.node: setup for setup in setups}
        self._requests = _SetupRequests()
        self._at_start: list[NodeSetup] = []
        if configure_at_start and self._setups:
            self._at_start = self._permitted(self._setups)

    @property
    def has_setups(self) -> bool:
        """Whether any CANopen node of this link can be set up."""
        return bool(self._setups)

    def check_setup(self, nodes: Iterable[int] | None = None) -> None:
        """Raise what `request_setup` would raise now, and do nothing else."""
        self._wanted(nodes)

    def request_setup(self, nodes: Iterable[int] | None = None) -> None:
        """Ask the running loop to identify, check, configure and start nodes; may be called from any thread.

        What comes of it are DeviceEvents: CONFIGURED, WARNING, ALARM. The caller has made sure that the machine is
        parked now. A request therefore never waits for the bus to be opened, and what is not done when the bus is lost
        is given up, with an ALARM for each node.

        Args:
            nodes: node numbers; None: all that the link knows.

        Raises:
            TransmitForbiddenError: the link is listen-only, or a node is not listed. Nothing is sent to any node then.
            DeviceError: no set-up is known for a node, or the bus is not open. Nothing is queued then.
        """
        if not self._requests.put(self._wanted(nodes)):
            raise self._not_open()

    def publish(self, frames: Sequence[Frame]) -> None:
        """Send rigcal's own frames soon; may be called from any thread.

        Frames that are still waiting are replaced: what is late is never sent in a burst.

        Raises:
            TransmitForbiddenError: the link is listen-only, or an identifier is none of its own. Nothing is sent then.
        """
        for frame in frames:
            self._permission.check(frame)
        self._published.append(tuple(frames))

    def _wanted(self, nodes: Iterable[int] | None) -> list[NodeSetup]:
        wanted = self._permitted(self._setups if nodes is None else nodes)
        if not self._requests.is_open:
            raise self._not_open()
        return wanted

    def _permitted(self, nodes: Iterable[int]) -> list[NodeSetup]:
        self._permission.check_link()
        wanted = []
        for node in nodes:
            if node not in self._setups:
                raise DeviceError(self.name, f"no channel of the rig file is on node {node}")
            self._permission.check_node(node)
            wanted.append(self._setups[node])
        return wanted

    def _not_open(self) -> DeviceError:
        return DeviceError(self.name, "nothing can be set up: the link is not open; ask again when it is up")

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Receive until `stop` is set, opening the bus again whenever it is lost."""
        backoff = Backoff()
        outage = _Outage(self.name, emit, self._clock.now())
        with contextlib.closing(_watch(self._config)) as watch:
            while not stop.is_set():
                try:
                    self._serve(emit, stop, outage, backoff, watch)
                except LinkError as error:
                    outage.begin(str(error), self._clock.now())
                    wait_s = backoff.next_s()
                    # Of real seconds, for devices are plugged in by people; fewer where time is made to run faster
                    watch.wait(stop, min(wait_s, self._clock.real_seconds(wait_s)))

    def _serve(self, emit: Emit, stop: threading.Event, outage: _Outage, backoff: Backoff, watch: DeviceWatch) -> None:
        """One life of the bus, from opening to `stop` or LinkError."""
        config = self._config
        settings = PortSettings(
            interface=config.interface,
            channel=config.channel,
            bitrate=config.bitrate,
            is_listen_only=not config.allow_transmit,
            receive_buffer_bytes=config.receive_buffer_bytes,
            options=config.options,
        )
        opened = self._clock.host.now()
        with contextlib.closing(open_port(self.name, settings)) as port:
            session = _Session(self.name, config, self._clock, self._permission, port, emit, opened)
            # An interface that is down opens all the same, and fails at the first read
            read = session.read(0.0)
            watch.close()
            at_start, self._at_start = self._at_start, []
            self._requests.open(at_start)
            try:
                outage.end(self._clock.now())
                while True:
                    session.take(read)
                    if read.batch.received:
                        backoff.reset()
                    session.serve(self._requests.take(), self._take_published())
                    if stop.is_set():
                        return
                    read = session.read(session.patience_s())
            finally:
                cause = "rigcal was stopped" if stop.is_set() else "the link was lost"
                session.close(self._requests.close(), cause)
                outage.last_good = session.last_frame

    def _take_published(self) -> Sequence[Frame]:
        try:
            return self._published.popleft()
        except IndexError:
            return ()


def _watch(config: CanLinkConfig) -> DeviceWatch:
    """What tells that the link's device is back."""
    if config.interface == "socketcan":
        return watch_interface(config.channel)
    if config.interface == "slcan":
        return watch_path(config.channel.partition("@")[0])  # python-can's slcan takes PORT@BAUD
    return no_watch()


class _SetupRequests:
    """Set-ups asked for from other threads. None is taken while the bus is closed, and none survives its loss."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: list[NodeSetup] = []
        self.is_open = False

    def open(self, at_start: list[NodeSetup]) -> None:
        with self._lock:
            self._waiting = at_start
            self.is_open = True

    def put(self, setups: list[NodeSetup]) -> bool:
        """Queue them, if the bus is open; else False."""
        with self._lock:
            if self.is_open:
                self._waiting += setups
            return self.is_open

    def take(self) -> list[NodeSetup]:
        with self._lock:
            setups, self._waiting = self._waiting, []
        return setups

    def close(self) -> list[NodeSetup]:
        """No more from now on; those that nobody has taken."""
        with self._lock:
            self.is_open = False
            setups, self._waiting = self._waiting, []
        return setups


class _Outage:
    """Says once that the link is lost, again when the reason changes, and once that it is back."""

    def __init__(self, link: str, emit: Emit, start: Stamp) -> None:
        self._link = link
        self._emit = emit
        self.last_good = start
        self._reason: str | None = None

    def begin(self, reason: str, now: Stamp) -> None:
        if self._reason is None:
            self._emit(Gap(self._link, GapReason.LINK_DOWN, self.last_good))
        if reason != self._reason:
            self._emit(DeviceEvent(self._link, now, EventKind.LINK_LOST, reason))
            self._reason = reason

    def end(self, now: Stamp) -> None:
        self._emit(DeviceEvent(self._link, now, EventKind.LINK_UP, f"{self._link}: the bus is open"))
        if self._reason is not None:
            self._emit(Gap(self._link, GapReason.LINK_DOWN, self.last_good, now))
            self._reason = None


@dataclass(frozen=True, slots=True)
class _Read:
    """What one read gave, and the host's time just before and just after it."""

    batch: Batch
    began: Stamp
    ended: Stamp


class _Session:
    """What happens while the bus is open."""

    def __init__(
        self,
        name: str,
        config: CanLinkConfig,
        clock: Clock,
        permission: TransmitPermission,
        port: CanPort,
        emit: Emit,
        opened: Stamp,
    ) -> None:
        self._name = name
        self._clock = clock
        self._permission = permission
        self._port = port
        self._emit = emit
        self._setup = SetupConversation()
        self._losses: dict[str, int] = {}
        self._stamps = ReceiveStamps(clock, opened)
        self._attendance = Attendance(clock)
        self._sent: deque[CanCapture] = deque()  # what was received before it may still have to be read
        now = clock.now()
        self._doubts = DoubtReport(name, "frames", now)
        self._check_losses_ns = now.monotonic_ns + LOSS_CHECK_NS
        self._checked = self._heard_then = now  # when losses were last looked for, and the last frame before that
        self._sync: SyncProducer | None = None
        if config.sync_period_ms is not None:
            period_ns = round(config.sync_period_ms * 1e6)
            self._sync = SyncProducer(period_ns, now.monotonic_ns, config.sync_counter)

    @property
    def last_frame(self) -> Stamp:
        """When the last frame was received; when the bus was opened if there was none."""
        return self._stamps.latest

    def read(self, timeout_s: float) -> _Read:
        """Wait for frames, at most `timeout_s` real seconds."""
        host = self._clock.host
        began = host.now()
        batch = self._port.receive(timeout_s)
        return _Read(batch, began, host.now())

    def take(self, read: _Read) -> None:
        """Stamp and emit what one read gave; what may have waited unread, and was not stamped before, is marked."""
        now = self._clock.of_host(read.ended)
        is_late = self._attendance.is_late(now, POLL_S)
        stamps = self._stamps.of(read.batch, read.began, read.ended, is_late=is_late)
        name, emit, sent, doubtful = self._name, self._emit, self._sent, 0
        for (frame, _), stamp in zip(read.batch.received, stamps, strict=True):
            while sent and sent[0].stamp.monotonic_ns <= stamp.monotonic_ns:
                emit(sent.popleft())
            doubtful += stamp.is_doubtful
            arbitration_id, data, is_extended, is_remote, is_error = frame
            emit(CanCapture(name, stamp, arbitration_id, data, is_extended, is_remote, is_error))
        if sent and read.batch.is_last:
            self._emit_sent(self._clock.of_host(read.began))
        if doubtful:
            self._doubts.doubt(doubtful, NOT_READ_IN_TIME if is_late else CLOCK_WAS_SET)
        elif not is_late:
            for item in self._doubts.trust(now):
                emit(item)
        if self._setup.is_active:
            for (frame, _), stamp in zip(read.batch.received, stamps, strict=True):
                self._setup.feed(frame, stamp)

    def _emit_sent(self, until: Stamp) -> None:
        """Emit what was sent until then; what is still to be read was received later."""
        while self._sent and self._sent[0].stamp.monotonic_ns <= until.monotonic_ns:
            self._emit(self._sent.popleft())

    def serve(self, requests: Iterable[NodeSetup], published: Iterable[Frame]) -> None:
        """Send what is due; look after lost frames.

        Args:
            requests: set-ups that were asked for since the last call.
            published: own frames to send.
        """
        monotonic_ns = self._clock.monotonic_ns()
        if self._sync is not None:
            sync = self._sync.due(monotonic_ns)
            if sync is not None:
                self._send(sync)
        for frame in published:
            self._send(frame)
        for request in requests:
            self._setup.add(request)
        if self._setup.is_active:
            self._setup.advance(self._clock.now())
        # The last node's start and its event are left when it is done
        for frame in self._setup.take_frames():
            self._send(frame)
        self._emit_setup_events()
        if monotonic_ns >= self._check_losses_ns:
            self._check_losses_ns = monotonic_ns + LOSS_CHECK_NS
            self._report_losses()

    def patience_s(self) -> float:
        """How long the next read may wait, real seconds."""
        patience_s = POLL_S
        for deadline_ns in (self._sync.next_ns if self._sync else None, self._setup.deadline_ns):
            if deadline_ns is not None:
                left_s = max(deadline_ns - self._clock.monotonic_ns(), 0) / NS_PER_S
                patience_s = min(patience_s, self._clock.real_seconds(left_s))
        return patience_s

    def close(self, requests: Iterable[NodeSetup], cause: str) -> None:
        """The bus is given up because of `cause`: say what is left to say."""
        self._emit_sent(self._clock.now())
        self._report_losses()
        for item in self._doubts.end(self._clock.now()):
            self._emit(item)
        for request in requests:
            self._setup.add(request)
        self._setup.abort(self._clock.now(), cause)
        self._emit_setup_events()

    def _send(self, frame: Frame) -> None:
        self._permission.check(frame)
        stamp = self._clock.now()
        self._port.send(frame)
        self._sent.append(CanCapture(self._name, stamp, frame.arbitration_id, frame.data, is_transmitted=True))

    def _emit_setup_events(self) -> None:
        for event in self._setup.take_events():
            self._emit(event)

    def _report_losses(self) -> None:
        now, losses = self._clock.now(), self._port.losses()
        start, missed = self._checked, 0
        for reason, total in losses.items():
            lost = total - self._losses.get(reason, 0)
            if lost > 0:
                missed += lost
                text = f"{self._name}: {lost} frames lost, {reason}"
                self._emit(DeviceEvent(self._name, now, EventKind.FRAMES_DROPPED, text, lost))
                if reason == OVERFLOW:
                    # Told only with the next frame that finds room, so it may lie as far back as the frame before
                    start = self._heard_then
        if missed:
            self._emit(Gap(self._name, GapReason.FRAMES_LOST, start, now, missed))
        self._losses, self._checked, self._heard_then = losses, now, self._stamps.latest
