"""Decoder of a CAN link: captures to readings, events and gaps. Pure: it owns no port, no thread and no clock."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence

from drivers.can.channel import ChannelDecoder, without_time
from drivers.can.error_frames import BusErrors
from drivers.can.j1939 import J1939Id
from drivers.can.summary import CanSummary, IdSummary, RateWindow
from drivers.canopen.cia301 import Service, classify, sdo_request_id
from drivers.canopen.node_setup import NodeSetup
from drivers.canopen.pdo_channel import PdoChannelDecoder
from drivers.canopen.supervision import NodeSupervision
from drivers.canopen.sync import SYNC_ID, Sync, SyncSampling
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import CanCapture, Capture, DeviceEvent, Gap, GapReason, Record

IDS_MAX = 512
"""Limit of identifiers counted one by one, so that noise on a 29-bit bus fills neither memory nor the screen."""

_EXTENDED = 1 << 31

_SERVICE_NAMES = {
    Service.EMCY: "emergencies",
    Service.SDO_RESPONSE: "SDO answers",
    Service.HEARTBEAT: "heartbeat",
}


class CanDecoder:
    """The decoder of one link. `summary` may be called from any thread, all other methods from a single thread.

    Args:
        link: name of the link.
        channels: decoders of its channels. The nodes of CANopen channels are supervised (see NodeSupervision).
        setups: set-ups of those nodes that rigcal may set up; of several for one node the last one counts, as for
            `CanLink`.
    """

    def __init__(self, link: str, channels: Iterable[ChannelDecoder], setups: Iterable[NodeSetup] = ()) -> None:
        self._link = link
        self._entries: dict[int, _Entry] = {}
        self._lock = threading.Lock()  # held while `_entries` grows, `_rates` changes, or either is copied
        self._rates = RateWindow()
        self._unlisted = _Entry()
        self._channels: list[_ChannelState] = []
        self._nodes: list[NodeSupervision] = []
        self._requests: dict[int, NodeSupervision] = {}  # by the identifier of SDO requests to the node
        self._bus_errors = BusErrors(link)
        self._sync: Sync | None = None
        self._started = False
        nodes: dict[int, list[PdoChannelDecoder]] = {}
        for decoder in channels:
            state = _ChannelState(decoder)
            self._channels.append(state)
            entry = self._entry(decoder.arbitration_id, decoder.is_extended)
            entry.channels = (*entry.channels, state)
            if isinstance(decoder, PdoChannelDecoder):
                nodes.setdefault(decoder.node, []).append(decoder)
        expected = {setup.node: setup for setup in setups}
        for node, decoders in nodes.items():
            supervision = NodeSupervision(node, decoders, expected.get(node))
            self._nodes.append(supervision)
            self._requests[sdo_request_id(node)] = supervision
            for arbitration_id, handler in supervision.handlers.items():
                self._entry(arbitration_id, False).handler = handler
            for channel in decoders:
                if channel.is_synchronous:
                    self._entry(channel.arbitration_id, channel.is_extended).node = supervision

    @property
    def channels(self) -> frozenset[str]:
        """Names of the link's channels."""
        return frozenset(channel.name for channel in self._channels)

    def recall(self, events: Iterable[DeviceEvent]) -> list[DeviceEvent]:
        """Restore the state of nodes from events that were recorded before this decoder was created.

        Args:
            events: events of any devices except those on other links, the last of each kind, oldest first.

        Returns:
            The events that changed the state of one of the link's nodes, each under the node's current name.
        """
        return [taken for event in events for node in self._nodes for taken in node.recall(event)]

    def feed(self, capture: Capture) -> Sequence[Record]:
        if type(capture) is not CanCapture:
            return ()
        stamp = capture.stamp
        if not self._started:
            self._start(stamp)
        if capture.is_error:
            return self._bus_errors.feed(stamp, capture.arbitration_id, capture.data)
        key = capture.arbitration_id
        if key == SYNC_ID and not (capture.is_extended or capture.is_remote):
            # Including rigcal's own SYNC: it marks an instant and is not a reading
            self._sync = Sync(stamp, 0 if self._sync is None else self._sync.number + 1)
        if capture.is_extended:
            key |= _EXTENDED
        if capture.is_transmitted:
            if key in self._requests:
                self._requests[key].requested(stamp, capture.data)
            return ()
        entry = self._entries.get(key)
        if entry is None:
            entry = self._new_unknown(key)
        entry.count += 1
        entry.last_seen = stamp
        if entry.is_unknown or capture.is_remote:
            return ()
        records: list[Record] = []
        if entry.node is not None:
            records += entry.node.on_synchronous_pdo(key, stamp, self._sync, capture.data)
        for channel in entry.channels:
            channel.decode(stamp, self._sync, capture.data, records)
        if entry.handler is not None:
            records += entry.handler(stamp, capture.data)
        return records

    def tick(self, now: Stamp) -> Sequence[Record]:
        if not self._started:
            self._start(now)
        if self._rates.is_due(now):
            with self._lock:
                self._rates.mark(now, {key: entry.count for key, entry in self._entries.items()})
        records: list[Record] = [*self._bus_errors.tick(now)]
        for channel in self._channels:
            channel.tick(now, records)
        for node in self._nodes:
            records += node.tick(now)
        return records

    def summary(self, now: Stamp) -> CanSummary:
        """Return the counts until `now`, including channels that were never received."""
        with self._lock:
            entries = sorted(self._entries.items())
            rates = self._rates.rates_per_s()
        return CanSummary(
            link=self._link,
            ids=tuple(
                entry.summary(key, rates.get(key), now) for key, entry in entries if entry.count or entry.channels
            ),
            unlisted_frames=self._unlisted.count,
            error_frames=self._bus_errors.count,
        )

    def _start(self, now: Stamp) -> None:
        self._started = True
        for channel in self._channels:
            channel.last_seen = now

    def _entry(self, arbitration_id: int, is_extended: bool) -> _Entry:
        key = arbitration_id | (_EXTENDED if is_extended else 0)
        entry = self._entries.setdefault(key, _Entry())
        entry.is_unknown = False
        return entry

    def _new_unknown(self, key: int) -> _Entry:
        if len(self._entries) >= IDS_MAX:
            return self._unlisted
        entry = _Entry()
        with self._lock:
            self._entries[key] = entry
        return entry


class _Entry:
    """One identifier."""

    __slots__ = ("channels", "count", "handler", "is_unknown", "last_seen", "node")

    def __init__(self) -> None:
        self.channels: tuple[_ChannelState, ...] = ()
        self.handler: Callable[[Stamp, bytes], list[Record]] | None = None
        self.node: NodeSupervision | None = None  # of a synchronous PDO
        self.is_unknown = True
        self.count = 0
        self.last_seen: Stamp | None = None

    def summary(self, key: int, rate_per_s: float | None, now: Stamp) -> IdSummary:
        last_seen = self.last_seen
        # Channels of one message read the same counter; a channel that was silent for longer has counted fewer losses
        missed = [count for channel in self.channels if (count := channel.missed_frames) is not None]
        return IdSummary(
            arbitration_id=key & ~_EXTENDED,
            is_extended=bool(key & _EXTENDED),
            names=self._names(key),
            count=self.count,
            rate_per_s=rate_per_s,
            age_s=None if last_seen is None else max(now.since(last_seen), 0) / NS_PER_S,
            missed=max(missed, default=None),
        )

    def _names(self, key: int) -> str:
        if self.channels:
            return ", ".join(channel.name for channel in self.channels)
        if key & _EXTENDED:
            return str(J1939Id.parse(key & ~_EXTENDED))
        if key == SYNC_ID:
            return "SYNC"
        meaning = classify(key) if self.handler is not None else None
        return "" if meaning is None else f"{_SERVICE_NAMES[meaning.service]} of node {meaning.node}"


class _ChannelState:
    """State of one channel: whether it is silent, and the SYNC that its next frame belongs to."""

    __slots__ = ("_decoder", "_is_silent", "_sampling", "_timeout_ns", "last_seen", "name")

    def __init__(self, decoder: ChannelDecoder) -> None:
        self.name = decoder.name
        self.last_seen: Stamp | None = None
        self._decoder = decoder
        self._timeout_ns = round(decoder.timeout_s * NS_PER_S)
        self._is_silent = False
        is_synchronous = isinstance(decoder, PdoChannelDecoder) and decoder.is_synchronous
        self._sampling = SyncSampling() if is_synchronous else None

    @property
    def missed_frames(self) -> int | None:
        return self._decoder.missed_frames

    def decode(self, stamp: Stamp, sync: Sync | None, data: bytes, records: list[Record]) -> None:
        sampled = stamp if self._sampling is None else self._sampling.instant(stamp, sync)
        decoded = self._decoder.decode(sampled, data)
        if not decoded:
            return
        if stamp.is_doubtful:
            decoded = [without_time(record) for record in decoded]
        last_seen = self.last_seen
        if last_seen is not None and (self._is_silent or stamp.since(last_seen) > self._timeout_ns):
            self.tick(stamp, records)
            self._is_silent = False
            records.append(Gap(self.name, GapReason.SILENT, last_seen, stamp))
        self.last_seen = stamp
        records += decoded

    def tick(self, now: Stamp, records: list[Record]) -> None:
        last_seen = self.last_seen
        if last_seen is not None and not self._is_silent and now.since(last_seen) > self._timeout_ns:
            self._is_silent = True
            records.append(Gap(self.name, GapReason.SILENT, last_seen))
