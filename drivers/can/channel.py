"""The interface of all channel decoders, and helpers that build their readings."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Protocol

from drivers.clock import Stamp
from drivers.jumps import JumpWatch
from drivers.readings import DecodeFailure, Reading, Record, Status


class ChannelDecoder(Protocol):
    """Decoder of the frames of one identifier into the readings of one channel. Pure; never raises on any data.

    Attributes:
        name: name of the channel in the rig file.
        arbitration_id: identifier of the frames to decode.
        is_extended: the identifier has 29 bits.
        timeout_s: silence longer than this is a gap.
        missed_frames: number of frames lost so far according to the frames' message counter; None if they have no
            working counter.
    """

    name: str
    arbitration_id: int
    is_extended: bool
    timeout_s: float
    missed_frames: int | None

    def decode(self, stamp: Stamp, data: bytes) -> list[Record]:
        """Return the records of one frame sampled at `stamp`; a doubtful stamp is not used to check for jumps."""


def too_short(
    name: str, unit: str, stamp: Stamp, data: bytes, needed_bits: int, jumps: JumpWatch | None
) -> list[Record]:
    """Return the records of a frame that is too short for the channel's value.

    Args:
        name: name of the channel.
        unit: unit of its values.
        stamp: when the frame was received.
        data: data of the frame.
        needed_bits: number of bits that the value needs.
        jumps: the watch of a joint, for which the frame is a sample without a position.
    """
    if jumps is not None:
        jumps.bad(stamp)
    reason = f"the frame has {len(data)} bytes, the value needs {(needed_bits + 7) // 8}"
    return [DecodeFailure(name, stamp, reason, data), Reading(name, stamp, None, unit, Status.MALFORMED)]


def value_reading(name: str, unit: str, stamp: Stamp, value: float, raw_counts: int | None) -> Reading:
    """Return the reading of a computed value; a value that is not finite becomes OUT_OF_RANGE without a value.

    Args:
        name: name of the channel.
        unit: unit of the value.
        stamp: when the value was sampled.
        value: the computed value.
        raw_counts: the device's own integer; None if there is none.
    """
    if math.isfinite(value):
        return Reading(name, stamp, value, unit, Status.OK, raw_counts)
    return Reading(name, stamp, None, unit, Status.OUT_OF_RANGE, raw_counts)


def without_time(record: Record) -> Record:
    """Return a record as it is for a frame with a doubtful time: a reading loses its value."""
    if isinstance(record, Reading) and record.status is Status.OK:
        return replace(record, value=None, status=Status.TIME_DOUBTFUL)
    return record
