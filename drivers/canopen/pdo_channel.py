"""The base of channels of CANopen nodes that send their values in PDOs, and of their decoders."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.can.channel import too_short
from drivers.canopen.pdo import TransmitPdo
from drivers.clock import Stamp
from drivers.jumps import JumpWatch
from drivers.readings import DeviceEvent, Record


@dataclass(frozen=True, kw_only=True)
class PdoChannel:
    """Settings common to all channels in a node's TPDO.

    Attributes:
        name: name of the joint or signal.
        unit: unit of the value.
        node: CANopen node number.
        pdo: the TPDO that contains the value.
        pdo_number: number of that TPDO, 1 to 4.
        is_synchronous: the value is sampled at SYNC, so its readings get the instant of the preceding SYNC.
        heartbeat_ms: the node's heartbeat producer time; 0 for no heartbeat.
        timeout_s: silence longer than this is a gap.
    """

    name: str
    unit: str
    node: int
    pdo: TransmitPdo
    pdo_number: int = 1
    is_synchronous: bool = False
    heartbeat_ms: int = 1000
    timeout_s: float = 1.0

    def does_not_carry(self, what: str) -> str:
        """Return the error text for a TPDO that lacks the channel's object."""
        words = " ".join(f"{word:08X}" for word in self.pdo.mapping.words)
        return f"TPDO{self.pdo_number} of node {self.node} does not contain {what}; its mapping is {words}"


class PdoChannelDecoder:
    """Base of the decoders of CANopen channels.

    Attributes:
        is_void: an emergency or a failed set-up makes the node's values invalid (set by the supervision of the node).
    """

    missed_frames: int | None = None  # PDOs have no counter

    def __init__(self, channel: PdoChannel) -> None:
        self.name = channel.name
        self.node = channel.node
        self.arbitration_id = channel.pdo.arbitration_id
        self.is_extended = channel.pdo.is_extended
        self.is_synchronous = channel.is_synchronous
        self.heartbeat_ms = channel.heartbeat_ms
        self.timeout_s = channel.timeout_s
        self.is_void = False
        self._unit = channel.unit
        self._jumps: JumpWatch | None = None

    @property
    def is_joint(self) -> bool:
        """True if the channel is checked for jumps, as those of joints are: its zero can be lost."""
        return self._jumps is not None

    def object_read(self, stamp: Stamp, index: int, value: int) -> list[Record]:  # noqa: ARG002 - profiles use them
        """Return the records caused by an object of the node that was read over SDO.

        Args:
            stamp: when the answer was received.
            index: index of the object.
            value: its content as an unsigned integer.
        """
        return []

    def recall(self, event: DeviceEvent) -> bool:  # noqa: ARG002 - profiles use it
        """Restore alarms or warnings from an event of an earlier decoder of the node; True if any were restored."""
        return False

    def node_restarted(self) -> None:
        """Discard what the channel knows of the node's state, because the node has booted."""

    def _too_short(self, stamp: Stamp, data: bytes, needed_bits: int) -> list[Record]:
        return too_short(self.name, self._unit, stamp, data, needed_bits, self._jumps)
