"""Supervision of a CANopen node from its frames: boot-up, state, heartbeat, emergencies, objects read over SDO."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from drivers.canopen.cia301 import NmtState, decode_heartbeat, emcy_id, heartbeat_id, sdo_response_id
from drivers.canopen.duplicate_node import DuplicateNodeWatch
from drivers.canopen.emcy import decode_emergency
from drivers.canopen.node_setup import NOT_USED, NodeSetup
from drivers.canopen.pdo_channel import PdoChannelDecoder
from drivers.canopen.sdo import UploadResponse, decode_response
from drivers.canopen.setup_watch import SetupWatch
from drivers.canopen.sync import Sync
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import DecodeFailure, DeviceEvent, EventKind, Record

HEARTBEAT_TOLERANCE = 2.5  # producer times; allows for two lost heartbeats and a slow clock of the node

VOIDS = "its values are not used until it takes this back"
"""End of an emergency's text while this or an earlier emergency makes the node's values invalid; `recall` needs it."""

EXCHANGED = "a different device answers than at its last set-up"
"""Part of the text of a PRESET_JUMP that states a node's new serial number; `recall` needs the newest one."""

_REGISTER_DEVICE_PROFILE = 1 << 5
_CLASS_HARDWARE = 0x5000


class NodeSupervision:
    """Supervision of one node.

    The heartbeat is supervised from the first one received after a boot-up (CiA 301), because a node that has booted
    may not send any until it is configured. A node that never sends one is noticed by the silence of its channels.

    An emergency makes the values of the node's channels invalid if it reports that the measurement itself has failed:
    code 5xxxh (device hardware), or error register bit 5 (device profile). Other emergencies, such as communication,
    voltage or temperature, are reported and leave the values valid; if the values are wrong, 6503h marks them. A code
    00xxh with an error register of zero, or a boot-up, makes the values valid again. A code 00xxh with bits left in the
    register means that one of several errors has cleared, but not which one (CiA 301, emergency state transitions).

    A set-up by rigcal that finds a different device than the rig file describes makes the values invalid until a set-up
    succeeds. If the serial number that it reads is not the one read last, the zeros of the node's joints count as lost,
    whether the set-up succeeds or not.

    Two devices with the node's number make the values invalid, too, if they are noticed: see DuplicateNodeWatch for
    synchronous PDOs, and `setup_script` for what a set-up reads.

    Args:
        node: node number.
        channels: decoders of the channels that the node feeds, at least one; events use the first one's name.
        setup: expected identity and settings of the node; None if rigcal may not set it up. What earlier set-ups have
            found wrong stays wrong all the same.
    """

    def __init__(self, node: int, channels: Sequence[PdoChannelDecoder], setup: NodeSetup | None = None) -> None:
        self.node = node
        self._channels = tuple(channels)
        self._name = channels[0].name
        self._setups = None if setup is None else SetupWatch(setup)
        self._has_failed = False  # by an emergency
        self._was_wrong = False  # an earlier set-up found a wrong device, and rigcal may not set the node up any more
        self._is_synchronous = any(channel.is_synchronous for channel in channels)
        self._is_duplicate = False
        self._duplicates: dict[int, DuplicateNodeWatch] = {}  # by the key of a PDO's identifier
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
        """Restore the node's state from an event of an earlier decoder if its text names this node.

        Args:
            event: event of a channel that a node of this link may have fed, possibly in an earlier rig file.

        Returns:
            The event under the current name of the node, or of each channel whose alarms or warnings it restores; empty
            if it is about a different node, changes nothing, or is a PRESET_JUMP, of which only the serial number is
            restored.
        """
        is_jump = event.kind is EventKind.PRESET_JUMP
        is_of_setup = (
            is_jump or event.kind is EventKind.CONFIGURED or (event.kind is EventKind.ALARM and event.code is None)
        )
        about = (f"node {self.node}:", f"node {self.node} ")
        if is_of_setup:
            is_own = event.text.startswith((*about, f"{event.device} (node {self.node}):"))
            is_told = is_own and self._recall_setup(event)
            name = self._name if self._setups is None else self._setups.name
            return [replace(event, device=name)] if is_told and not is_jump else []
        if not event.text.startswith(about):
            return []
        if event.kind in (EventKind.ALARM, EventKind.WARNING):
            return [replace(event, device=channel.name) for channel in self._channels if channel.recall(event)]
        if event.kind is EventKind.BOOT_UP:
            self._restarted()
        elif event.kind is EventKind.EMERGENCY_CLEARED:
            self._has_failed = False
        elif event.kind is EventKind.EMERGENCY:
            self._has_failed |= event.text.endswith(VOIDS)
        elif event.kind in (EventKind.HEARTBEAT_LOST, EventKind.HEARTBEAT_RESTORED) and self._timeout_ns:
            self._is_lost = event.kind is EventKind.HEARTBEAT_LOST
        elif event.kind in (EventKind.DUPLICATE_NODE, EventKind.DUPLICATE_NODE_GONE) and self._is_synchronous:
            self._is_duplicate = event.kind is EventKind.DUPLICATE_NODE
        else:
            return []
        self._mark()
        return [replace(event, device=self._name)]

    def _recall_setup(self, event: DeviceEvent) -> bool:
        """Restore what a set-up has shown, and return whether it still matters."""
        is_wrong = event.text.endswith(NOT_USED)
        if self._setups is not None:
            self._setups.recall(event)
        elif event.kind is not EventKind.PRESET_JUMP:
            self._was_wrong = is_wrong or (self._was_wrong and event.kind is EventKind.ALARM)
        self._mark()
        return self._setups is not None or is_wrong

    def requested(self, stamp: Stamp, data: bytes) -> None:
        """Process an SDO request that rigcal has sent to the node."""
        if self._setups is not None:
            self._setups.requested(stamp, data)

    def tick(self, now: Stamp) -> list[Record]:
        """Return the event of an overdue heartbeat, once."""
        heartbeat = self._heartbeat
        if heartbeat is None or self._is_lost or not self._timeout_ns or now.since(heartbeat) <= self._timeout_ns:
            return []
        self._is_lost = True
        text = f"node {self.node}: no heartbeat for {self._timeout_ns / NS_PER_S:g} s; check its power and cable"
        # Timestamped with the deadline, so that the time of the call does not matter
        return [DeviceEvent(self._name, heartbeat.shifted(self._timeout_ns), EventKind.HEARTBEAT_LOST, text)]

    def on_synchronous_pdo(self, pdo: int, stamp: Stamp, sync: Sync | None, data: bytes) -> list[Record]:
        """Return an event if two devices begin or cease to send a PDO after each SYNC.

        Args:
            pdo: what distinguishes the PDO from others of the node.
            stamp: when it was received.
            sync: the last SYNC; None if there was none.
            data: its data.
        """
        watch = self._duplicates.get(pdo)
        if watch is None:
            watch = self._duplicates[pdo] = DuplicateNodeWatch(self._is_duplicate)
        watch.feed(stamp, sync, data)
        is_duplicate = any(watch.is_duplicate and not watch.is_silent(sync) for watch in self._duplicates.values())
        if is_duplicate == self._is_duplicate:
            return []
        self._is_duplicate = is_duplicate
        self._mark()
        if not is_duplicate:
            text = f"node {self.node}: a single value arrives after each SYNC again"
            return [DeviceEvent(self._name, stamp, EventKind.DUPLICATE_NODE_GONE, text)]
        text = (
            f"node {self.node}: different values arrive after the same SYNC, as if two devices had this node number; "
            "neither is used until a single one arrives"
        )
        return [DeviceEvent(self._name, stamp, EventKind.DUPLICATE_NODE, text)]

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
            text = f"node {self.node} has booted; it sends no values until it is started"
            records.append(DeviceEvent(self._name, stamp, EventKind.BOOT_UP, text))
            self._restarted()
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
            self._has_failed = False
            self._mark()
            text = f"node {self.node}: all errors have cleared ({emergency.words})"
            return [DeviceEvent(self._name, stamp, EventKind.EMERGENCY_CLEARED, text, emergency.code)]
        is_failure = emergency.code & 0xF000 == _CLASS_HARDWARE or bool(emergency.register & _REGISTER_DEVICE_PROFILE)
        # A later emergency does not make values valid again that an earlier one made invalid
        self._has_failed |= is_failure
        self._mark()
        what = f"one error has cleared, others remain: {emergency.words}" if emergency.is_reset else emergency.words
        text = f"node {self.node}: {what}{f'; {VOIDS}' if self._has_failed else ''}"
        return [DeviceEvent(self._name, stamp, EventKind.EMERGENCY, text, emergency.code or None)]

    def _restarted(self) -> None:
        """Discard the state that a node loses when it boots; it stays the device that its set-up has found."""
        self._has_failed = False
        if self._setups is not None:
            self._setups.booted()
        for channel in self._channels:
            channel.node_restarted()
        self._mark()

    def _mark(self) -> None:
        """Tell the channels whether the node's values are valid."""
        is_wrong = self._was_wrong if self._setups is None else self._setups.is_mismatched
        is_void = self._has_failed or self._is_duplicate or is_wrong
        for channel in self._channels:
            channel.is_void = is_void

    def _on_sdo_response(self, stamp: Stamp, data: bytes) -> list[Record]:
        """Process the value of an object that any client on the bus has read from the node."""
        try:
            response = decode_response(data)
        except ValueError:
            return []  # block transfer or similar; no reading depends on it
        exchanged = None if self._setups is None else self._setups.feed(stamp, data)
        self._mark()
        if exchanged is not None:
            return self._exchanged(stamp, exchanged)
        if not isinstance(response, UploadResponse) or response.data is None:
            return []
        value = int.from_bytes(response.data, "little")
        return [r for channel in self._channels for r in channel.object_read(stamp, response.index, value)]

    def _exchanged(self, stamp: Stamp, serial_numbers: str) -> list[Record]:
        """Return the events that report that the zeros of the node's joints belong to a different device."""
        text = (
            f"node {self.node}: {EXCHANGED} ({serial_numbers}), so the joint's zero is "
            "no longer valid: check the zero, then confirm it by `rigcal model zeros-checked`"
        )
        joints = [channel.name for channel in self._channels if channel.is_joint]
        return [DeviceEvent(name, stamp, EventKind.PRESET_JUMP, text) for name in joints]
