"""What the decoders of all CAN channels have in common."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

from drivers.clock import Stamp
from drivers.pdo import TransmitPdo
from drivers.readings import DecodeFailure, Reading, Record, Status


class ChannelDecoder(Protocol):
    """Turns the frames of one identifier into the readings of one channel. Pure; never raises on any data."""

    @property
    def name(self) -> str:
        """The channel, as the rig file names it."""

    @property
    def arbitration_id(self) -> int:
        """Identifier of the frames it wants."""

    @property
    def is_extended(self) -> bool:
        """Whether that identifier has 29 bits."""

    @property
    def timeout_s(self) -> float:
        """Silent for longer than this is a gap."""

    @property
    def missed_frames(self) -> int | None:
        """Frames that did not arrive so far, by the counter that they carry; None if they carry none that counts."""

    def decode(self, stamp: Stamp, data: bytes) -> list[Record]:
        """Records of one frame, sampled at `stamp`; if that is doubtful, no motion is judged by it."""


@dataclass(frozen=True, kw_only=True)
class PdoChannel:
    """What every channel that a CANopen node sends in a TPDO has.

    Attributes:
        name: the joint or signal.
        unit: unit of the value.
        node: CANopen node number.
        pdo: the TPDO that carries it.
        pdo_number: which of the node's TPDOs that is, 1 to 4.
        is_synchronous: sampled at SYNC, so that its readings carry the instant of the SYNC before.
        heartbeat_ms: the node's heartbeat producer time; 0: none.
        timeout_s: silent for longer than this is a gap.
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
        """The sentence for a TPDO that lacks what the channel is read from."""
        words = " ".join(f"{word:08X}" for word in self.pdo.mapping.words)
        return f"TPDO{self.pdo_number} of node {self.node} does not carry {what}; its mapping is {words}"


class PdoChannelDecoder:
    """Base of the decoders of CANopen channels.

    Attributes:
        is_void: the node has an emergency that voids its values (set by the supervision of the node).
    """

    missed_frames: int | None = None  # PDOs carry no counter

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

    def object_read(self, stamp: Stamp, index: int, value: int) -> list[Record]:  # noqa: ARG002 - profiles use them
        """Records caused by an object of the node that was seen read over SDO."""
        return []

    def node_restarted(self) -> None:
        """The node has booted: what it was last known to say is no longer known."""
        self.is_void = False

    def _too_short(self, stamp: Stamp, data: bytes, needed_bits: int) -> list[Record]:
        return too_short(self.name, self._unit, stamp, data, needed_bits)


def too_short(name: str, unit: str, stamp: Stamp, data: bytes, needed_bits: int) -> list[Record]:
    """The records of a frame that ends before the channel's value does."""
    reason = f"the frame has {len(data)} bytes, the value needs {(needed_bits + 7) // 8}"
    return [DecodeFailure(name, stamp, reason, data), Reading(name, stamp, None, unit, Status.MALFORMED)]


def value_reading(name: str, unit: str, stamp: Stamp, value: float, raw_counts: int | None) -> Reading:
    """A reading of a computed value; one that is not finite is out of range, never a number."""
    if math.isfinite(value):
        return Reading(name, stamp, value, unit, Status.OK, raw_counts)
    return Reading(name, stamp, None, unit, Status.OUT_OF_RANGE, raw_counts)


def without_time(record: Record) -> Record:
    """A record of a frame whose time is doubtful: a reading has no value, because it is not known when it had it."""
    if isinstance(record, Reading) and record.status is Status.OK:
        return replace(record, value=None, status=Status.TIME_DOUBTFUL)
    return record
