"""Supervision of a CANopen node by its frames: boot-up, state, heartbeat, emergencies, objects read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from drivers.canopen.cia301 import NmtState, decode_heartbeat, emcy_id, heartbeat_id, sdo_response_id
from drivers.canopen.emcy import decode_emergency
from drivers.canopen.pdo import PdoChannelDecoder
from drivers.canopen.sdo import UploadResponse, decode_response
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import DecodeFailure, DeviceEvent, EventKind, Record

HEARTBEAT_TOLERANCE = 2.5  # producer times without a heartbeat: two may be lost, and the node's clock be slow

VOIDS = "its values are not used until it takes this back"
"""How the text of an emergency ends while it, or one before it, voids the values of the node's channels."""

_REGISTER_DEVICE_PROFILE = 1 << 5
_CLASS_HARDWARE = 0x5000


class NodeSupervision:
    """Supervision of one node.

    The heartbeat is supervised from the first that is heard after a boot-up (CiA 301), for a node that has booted may
    not produce any until it is configured; one that never does is noticed by the silence of its channels.

    An emergency voids the values of the node's channels if it says that the measurement itself has failed: code 5xxxh
    (device hardware), or error register bit 5 (device profile). Any other, such as communication, voltage or
    temperature, is reported and leaves the values, which 6503h voids where they are wrong. A code 00xxh with an error
    register of zero, or a boot-up, makes them valid again; with a bit of the register left, one error of several is
    gone, and which one is not said (CiA 301, emergency state transitions).

    Args:
        node: node number.
        channels: decoders of the channels that the node feeds, at least one; the first names the node in events.
    """

    def __init__(self, node: int, channels: Sequence[PdoChannelDecoder]) -> None:
        self.node = node
        self._channels = tuple(channels)
        self._name = channels[0].name
        self._state: NmtState | None = None
        self._heartbeat: Stamp | None = None
        self._is_lost = False
        self._timeout_ns = round(max(c.heartbeat_ms for c in channels) * 1e-3 * HEARTBEAT_TOLERANCE * NS_PER_S)

    @property
    def handlers(self) -> dict[int, Callable[[Stamp, bytes], list[Record]]]:
        """The handlers of the node's frames, by identifier."""
        return {
            heartbeat_id(self.node): self._on_heartbeat,
            emcy_id(self.node): self._on_emergency,
            sdo_response_id(self.node): self._on_sdo_response,
        }

    def recall(self, event: DeviceEvent) -> list[DeviceEvent]:
        """Take on what an event told that an earlier decoder made of this node, as its text says.

        Args:
            event: of a channel of the link; with another rig file the node may have been another channel's.

        Returns:
            The event under the name that the node has now; nothing where it is another node's, or tells nothing.
        """
        if not event.text.startswith((f"node {self.node}:", f"node {self.node} ")):
            return []
        if event.kind in (EventKind.ALARM, EventKind.WARNING):
            return [event for channel in self._channels if channel.name == event.device and channel.recall(event)]
        if event.kind is EventKind.BOOT_UP:
            for channel in self._channels:
                channel.node_restarted()
        elif event.kind is EventKind.EMERGENCY_CLEARED:
            self._void(is_void=False)
        elif event.kind is EventKind.EMERGENCY and event.text.endswith(VOIDS):
            self._void(is_void=True)
        elif event.kind in (EventKind.HEARTBEAT_LOST, EventKind.HEARTBEAT_RESTORED):
            if not self._timeout_ns:
                return []
            self._is_lost = event.kind is EventKind.HEARTBEAT_LOST
        return [replace(event, device=self._name)]

    def tick(self, now: Stamp) -> list[Record]:
        """Report a heartbeat that is overdue."""
        heartbeat = self._heartbeat
        if heartbeat is None or self._is_lost or not self._timeout_ns or now.since(heartbeat) <= self._timeout_ns:
            return []
        self._is_lost = True
        text = f"node {self.node}: no heartbeat for {self._timeout_ns / NS_PER_S:g} s; check its power and cable"
        # Stamped with the deadline, so that it does not matter when this is called
        return [DeviceEvent(self._name, heartbeat.shifted(self._timeout_ns), EventKind.HEARTBEAT_LOST, text)]

    def _on_heartbeat(self, stamp: Stamp, data: bytes) -> list[Record]:
        try:
            state = decode_heartbeat(data)
        except ValueError as error:
            return [DecodeFailure(self._name, stamp, f"node {self.node}: {error}", data)]
        records = self.tick(stamp)
        self._heartbeat = None if state is NmtState.BOOT_UP else stamp
        if self._is_lost:
            self._is_lost = False
            text = f"node {self.node}: heartbeat is back, state {state.words}"
            records.append(DeviceEvent(self._name, stamp, EventKind.HEARTBEAT_RESTORED, text))
        if state is NmtState.BOOT_UP:
            text = f"node {self.node} has booted; it sends nothing until it is started"
            records.append(DeviceEvent(self._name, stamp, EventKind.BOOT_UP, text))
            for channel in self._channels:
                channel.node_restarted()
        elif state is not self._state:
            before = "" if self._state is None else f", was {self._state.words}"
            text = f"node {self.node} is {state.words}{before}"
            records.append(DeviceEvent(self._name, stamp, EventKind.NMT_STATE, text, int(state)))
        self._state = state
        return records

    def _on_emergency(self, stamp: Stamp, data: bytes) -> list[Record]:
        try:
            emergency = decode_emergency(data)
        except ValueError as error:
            return [DecodeFailure(self._name, stamp, f"node {self.node}: {error}", data)]
        if emergency.is_reset and not emergency.register:
            self._void(is_void=False)
            text = f"node {self.node}: errors are gone ({emergency.words})"
            return [DeviceEvent(self._name, stamp, EventKind.EMERGENCY_CLEARED, text, emergency.code)]
        is_void = emergency.code & 0xF000 == _CLASS_HARDWARE or bool(emergency.register & _REGISTER_DEVICE_PROFILE)
        # Another emergency does not make values valid that one before it has voided.
        is_void |= any(channel.is_void for channel in self._channels)
        self._void(is_void=is_void)
        what = f"an error is gone, others are left: {emergency.words}" if emergency.is_reset else emergency.words
        text = f"node {self.node}: {what}{f'; {VOIDS}' if is_void else ''}"
        return [DeviceEvent(self._name, stamp, EventKind.EMERGENCY, text, emergency.code or None)]

    def _void(self, *, is_void: bool) -> None:
        for channel in self._channels:
            channel.is_void = is_void

    def _on_sdo_response(self, stamp: Stamp, data: bytes) -> list[Record]:
        """Take the value of an object of the node that anybody on the bus has read."""
        try:
            response = decode_response(data)
        except ValueError:
            return []  # of block transfers and others; no reading depends on it
        if not isinstance(response, UploadResponse) or response.data is None:
            return []
        value = int.from_bytes(response.data, "little")
        return [r for channel in self._channels for r in channel.object_read(stamp, response.index, value)]
