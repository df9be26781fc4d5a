"""The CAN link: one loop that owns one bus, timestamps every frame on arrival and passes it on undecoded."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from drivers.can.bus_options import slcan_port
from drivers.can.frame import Frame
from drivers.can.port import OVERFLOW, Batch, CanPort
from drivers.can.ports import CanLinkConfig, open_port
from drivers.can.stamps import ReceiveStamps
from drivers.canopen.node_setup import NodeSetup, SetupRunner
from drivers.canopen.sync import SyncProducer
from drivers.canopen.transmit import TransmitPermission
from drivers.clock import NS_PER_S, Clock, Stamp
from drivers.device_watch import DeviceWatch, no_watch, watch_interface, watch_path
from drivers.errors import DeviceError, LinkError
from drivers.last_reads import LAST_READ_S, LastReads
from drivers.outage import Backoff, Outage
from drivers.readings import CanCapture, Capture, DeviceEvent, EventKind, Gap, GapReason
from drivers.stall_detector import CLOCK_WAS_SET, NOT_READ_IN_TIME, LateReport, StallDetector

POLL_S = 0.05  # longest delay until a stop or a set-up request is noticed
LOSS_CHECK_NS = NS_PER_S
QUEUE_FULL = (
    "the transmit queue is full or the adapter refuses frames, so they are not sent: check that other nodes are "
    "powered and use the same bit rate, and that the bus is not overloaded"
)

Emit = Callable[[Capture | DeviceEvent | Gap], None]


class CanLink:
    """Owns one CAN bus: receives, reopens it after a loss, and sends only what is configured (default: nothing).

    Args:
        config: see CanLinkConfig.
        clock: timestamps the frames and times SYNC and retries.
        setups: set-ups of the nodes that `request_setup` can set up.
        configure_at_start: set up all of these nodes when the bus is opened for the first time, and only then. This is
            for simulated machines, which are always parked; on a real machine an operator must request each set-up.

    Raises:
        TransmitForbiddenError: SYNC, own identifiers or a set-up at the start are configured but not allowed.
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
        self._session: _Session | None = None  # the latest session; None once its bus is lost
        self._permission = TransmitPermission(
            config.name, config.allow_transmit, config.transmit_nodes, config.own_identifiers
        )
        self._published: deque[Sequence[Frame]] = deque(maxlen=1)
        if config.sync_period_ms is not None:
            self._permission.check_link()
            if config.sync_period_ms <= 0:
                raise ValueError(f"{config.name}: sync_period_ms must be positive, got {config.sync_period_ms}")
        self._setups = {setup.node: setup for setup in setups}
        self._requests_lock = threading.Lock()
        self._requests: list[NodeSetup] | None = None  # requested set-ups; None while the bus is closed
        self._last_frame = clock.now()
        self._at_start: list[NodeSetup] = []
        if configure_at_start and self._setups:
            self._at_start = self._permitted(self._setups)

    @property
    def read_until(self) -> Stamp | None:
        return None if self._session is None else self._session.read_until

    @property
    def has_setups(self) -> bool:
        """True if any CANopen node of this link can be set up."""
        return bool(self._setups)

    def setup_nodes(self, *, permitted: bool) -> list[int]:
        """Return the numbers of the CANopen nodes that rigcal may set up, or else of those that it may not."""
        return [node for node in self._setups if self._permission.allows(node) is permitted]

    def check_setup(self, nodes: Iterable[int] | None = None) -> None:
        """Raise the error that `request_setup` would raise now, without requesting anything."""
        self._wanted(nodes)

    def request_setup(self, nodes: Iterable[int] | None = None) -> None:
        """Ask the running loop to identify, check, configure and start nodes; may be called from any thread.

        DeviceEvents report the result: CONFIGURED, WARNING, ALARM. The caller has made sure that the machine is parked
        now. A request therefore never waits for the bus to be opened, and set-ups that are unfinished when the bus is
        lost are cancelled, with an ALARM for each node.

        Args:
            nodes: node numbers; None for all nodes that the link can set up.

        Raises:
            TransmitForbiddenError: the link is listen-only, or a node is not listed. Nothing is sent to any node.
            DeviceError: no set-up is known for a node, or the bus is not open. Nothing is queued.
        """
        wanted = self._wanted(nodes)
        with self._requests_lock:
            if self._requests is None:
                raise self._not_open()
            self._requests += wanted

    def publish(self, frames: Sequence[Frame]) -> None:
        """Send rigcal's own frames at the next opportunity; may be called from any thread.

        Only the frames of the newest call are kept, and they are discarded when the bus is opened, so that no outdated
        frame is passed to the adapter. Frames that the adapter or the kernel holds while the bus is disturbed may be
        sent late, see docs/explanation/limits.md.

        Raises:
            TransmitForbiddenError: the link is listen-only, or an identifier is not one of its own. Nothing is sent.
        """
        for frame in frames:
            self._permission.check(frame)
        self._published.append(tuple(frames))

    def _wanted(self, nodes: Iterable[int] | None) -> list[NodeSetup]:
        wanted = self._permitted(self._setups if nodes is None else nodes)
        if self._requests is None:
            raise self._not_open()
        return wanted

    def _permitted(self, nodes: Iterable[int]) -> list[NodeSetup]:
        self._permission.check_link()
        wanted = []
        for node in nodes:
            if node not in self._setups:
                raise DeviceError(self.name, f"the rig file has no channel on node {node}")
            self._permission.check_node(node)
            wanted.append(self._setups[node])
        return wanted

    def _not_open(self) -> DeviceError:
        return DeviceError(self.name, "nodes cannot be set up while the link is not open; try again when it is up")

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Receive until `stop` is set; open the bus again whenever it is lost.

        After `stop`, frames that are already waiting are still read (`LastReads`), and nothing more is sent.
        """
        backoff = Backoff()
        outage = Outage(self.name, emit)
        self._last_frame = self._clock.now()
        with contextlib.closing(_watch(self._config)) as watch:
            while not stop.is_set():
                try:
                    self._serve(emit, stop, outage, backoff, watch)
                except LinkError as error:
                    outage.begin(str(error), self._clock.now(), self._last_frame)
                    self._session = None
                    wait_s = backoff.next_s()
                    # Real seconds, as people plug in devices; fewer if the clock runs faster than real time
                    watch.wait(stop, min(wait_s, self._clock.real_seconds(wait_s)))

    def _serve(self, emit: Emit, stop: threading.Event, outage: Outage, backoff: Backoff, watch: DeviceWatch) -> None:
        """Open the bus and receive until `stop` is set or a LinkError is raised."""
        opened = self._clock.host.now()
        with contextlib.closing(open_port(self._config)) as port:
            session = _Session(self._config, self._clock, self._permission, port, emit, opened)
            # An interface that is down can be opened, but the first read fails
            read = session.first_read()
            watch.close()
            at_start, self._at_start = self._at_start, []
            self._swap_requests(at_start)
            self._published.clear()
            last_reads = LastReads(stop)
            try:
                self._session = session
                outage.end(self._clock.now(), f"{self.name}: the bus is open")
                while True:
                    session.take(read)
                    if read.batch.received:
                        backoff.reset()
                    if last_reads.are_over(is_emptied=read.batch.is_last):
                        return
                    if not last_reads.have_begun():
                        try:
                            session.serve(self._swap_requests([]), self._take_published())
                        except LinkError as error:  # what the port has received is still read
                            last_reads.begin(error)
                    read = session.read(LAST_READ_S if last_reads.have_begun() else session.patience_s())
            finally:
                cause = "rigcal was stopped" if stop.is_set() else "the link was lost"
                session.close(self._swap_requests(None), cause)
                self._last_frame = session.last_frame

    def _swap_requests(self, requests: list[NodeSetup] | None) -> list[NodeSetup]:
        """Replace the requested set-ups by `requests` and return the previous ones."""
        with self._requests_lock:
            waiting, self._requests = self._requests, requests
        return waiting or []

    def _take_published(self) -> Sequence[Frame]:
        try:
            return self._published.popleft()
        except IndexError:
            return ()


def _watch(config: CanLinkConfig) -> DeviceWatch:
    """Return the watch that notices when the link's device is back."""
    if config.interface == "socketcan":
        return watch_interface(config.channel)
    if config.interface == "slcan":
        return watch_path(slcan_port(config.channel))
    return no_watch()


@dataclass(frozen=True, slots=True)
class _Read:
    """Frames of one read, and the host's time just before and just after it."""

    batch: Batch
    began: Stamp
    ended: Stamp


class _Session:
    """The time from opening the bus to its loss or a stop."""

    def __init__(
        self,
        config: CanLinkConfig,
        clock: Clock,
        permission: TransmitPermission,
        port: CanPort,
        emit: Emit,
        opened: Stamp,
    ) -> None:
        self._name = config.name
        self._clock = clock
        self._permission = permission
        self._port = port
        self._emit = emit
        self._setup = SetupRunner()
        self._unsent = self._unsent_checked = 0  # frames not sent since the transmit queue became full
        self._losses: dict[str, int] = {}
        self._stamps = ReceiveStamps(clock, opened)
        began = clock.of_host(opened)
        self._stalls = StallDetector(clock, began)
        # When the port was last found empty; `read_until` lags behind until the losses up to then are reported
        self.read_until = self._emptied = began
        self._sent: deque[CanCapture] = deque()  # held back: frames received earlier may still have to be read
        now = clock.now()
        self._late = LateReport(config.name, "frames", began)
        self._check_losses_ns = now.monotonic_ns + LOSS_CHECK_NS
        self._checked = self._heard_then = now  # time of the last check for losses, and the last frame before it
        self._sync: SyncProducer | None = None
        if config.sync_period_ms is not None:
            period_ns = round(config.sync_period_ms * 1e6)
            self._sync = SyncProducer(period_ns, now.monotonic_ns)

    @property
    def last_frame(self) -> Stamp:
        """Stamp of the last frame; if there was none, of the opening of the bus."""
        return self._stamps.latest

    def read(self, timeout_s: float) -> _Read:
        """Wait for frames, at most `timeout_s` real seconds."""
        host = self._clock.host
        began = host.now()
        batch = self._port.receive(timeout_s)
        return _Read(batch, began, host.now())

    def first_read(self) -> _Read:
        """Read what the port has received since it was opened, without waiting."""
        read = self.read(0.0)
        if not read.batch.received:
            self._stalls.found_nothing(self._clock.of_host(read.ended))
        return read

    def take(self, read: _Read) -> None:
        """Timestamp and emit the frames of a read; mark as doubtful those that may have waited without a timestamp."""
        now = self._clock.of_host(read.ended)
        is_late = self._stalls.is_late(now, POLL_S)
        stamps = self._stamps.of(read.batch, read.began, read.ended, is_late=is_late)
        name, emit, sent, doubtful = self._name, self._emit, self._sent, 0
        for (frame, _), stamp in zip(read.batch.received, stamps, strict=True):
            if sent:
                self._emit_sent(stamp)
            doubtful += stamp.is_doubtful
            arbitration_id, data, is_extended, is_remote, is_error = frame
            emit(CanCapture(name, stamp, arbitration_id, data, is_extended, is_remote, is_error))
        began = self._clock.of_host(read.began)
        if sent and read.batch.is_last:
            self._emit_sent(began)
        reports: list[DeviceEvent | Gap] = []
        if doubtful:
            reports = self._late.add(now, doubtful, NOT_READ_IN_TIME if is_late else CLOCK_WAS_SET)
        elif not is_late:
            reports = self._late.in_time(now)
        for report in reports:
            emit(report)
        if self._setup.is_active:
            for (frame, _), stamp in zip(read.batch.received, stamps, strict=True):
                self._setup.feed(frame, stamp)
        if read.batch.is_last and not is_late:
            self._emptied = began

    def _emit_sent(self, until: Stamp) -> None:
        """Emit the frames that were sent up to `until`; all frames still unread were received later."""
        while self._sent and self._sent[0].stamp.monotonic_ns <= until.monotonic_ns:
            self._emit(self._sent.popleft())

    def serve(self, requests: Iterable[NodeSetup], published: Iterable[Frame]) -> None:
        """Send all frames that are due, and report lost frames.

        Frames that find the transmit queue full are not sent later: they would be outdated. Set-ups are cancelled then.

        Args:
            requests: set-ups requested since the last call.
            published: own frames to send.
        """
        monotonic_ns = self._clock.monotonic_ns()
        for request in requests:  # before anything is sent: a send that fails must not lose them
            self._setup.add(request)
        if self._sync is not None:
            sync = self._sync.due(monotonic_ns)
            if sync is not None:
                self._send(sync)
        for frame in published:
            self._send(frame)
        if self._setup.is_active:
            self._setup.advance(self._clock.now())
        # Even if no set-up is active any more, the last node's start command and event may be left to send
        if not all(self._send(frame) for frame in self._setup.take_frames()):
            self._setup.abort(self._clock.now(), "the transmit queue was full or the adapter refused")
        self._emit_setup_events()
        if monotonic_ns >= self._check_losses_ns:
            self._check_losses_ns = monotonic_ns + LOSS_CHECK_NS
            self._report_losses()
            if self._unsent == self._unsent_checked:
                self._end_unsent()
            self._unsent_checked = self._unsent
            self.read_until = self._emptied

    def patience_s(self) -> float:
        """Return how long the next read may wait, in real seconds."""
        patience_s = POLL_S
        for deadline_ns in (self._sync.next_ns if self._sync else None, self._setup.deadline_ns):
            if deadline_ns is not None:
                left_s = max(deadline_ns - self._clock.monotonic_ns(), 0) / NS_PER_S
                patience_s = min(patience_s, self._clock.real_seconds(left_s))
        return patience_s

    def close(self, requests: Iterable[NodeSetup], cause: str) -> None:
        """Report everything that is left when the bus is closed because of `cause`; cancel set-ups."""
        self._emit_sent(self._clock.now())
        self._report_losses()
        self._end_unsent()
        self.read_until = self._emptied
        for item in self._late.end(self._clock.now()):
            self._emit(item)
        for request in requests:
            self._setup.add(request)
        self._setup.abort(self._clock.now(), cause)
        self._emit_setup_events()

    def _send(self, frame: Frame) -> bool:
        """Send a frame; return False if the transmit queue is full, which is reported once."""
        self._permission.check(frame)
        stamp = self._clock.now()
        if not self._port.send(frame):
            if not self._unsent:
                self._emit(DeviceEvent(self._name, stamp, EventKind.WARNING, f"{self._name}: {QUEUE_FULL}"))
            self._unsent += 1
            return False
        self._sent.append(CanCapture(self._name, stamp, frame.arbitration_id, frame.data, is_transmitted=True))
        return True

    def _end_unsent(self) -> None:
        """Withdraw the warning that the transmit queue is full."""
        if self._unsent:
            text = f"{self._name}: {self._unsent} frames were not sent as the queue was full or the adapter refused"
            self._emit(DeviceEvent(self._name, self._clock.now(), EventKind.WARNING, text, 0))
        self._unsent = 0

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
                text = f"{self._name}: {lost} frames lost: {reason}"
                self._emit(DeviceEvent(self._name, now, EventKind.FRAMES_DROPPED, text, lost))
                if reason == OVERFLOW:
                    # Reported only with the next frame that fits, so the loss may go back to the frame before the check
                    start = self._heard_then
        if missed:
            self._emit(Gap(self._name, GapReason.FRAMES_LOST, start, now, missed))
        self._losses, self._checked, self._heard_then = losses, now, self._stamps.latest
