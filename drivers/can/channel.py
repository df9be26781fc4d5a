"""The interface of all channel decoders, and the readings that they share."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Protocol

from drivers.clock import Stamp
from drivers.readings import DecodeFailure, Reading, Record, Status


class ChannelDecoder(Protocol):
    """Decoder of the frames of one identifier to the readings of one channel. Pure; never raises on any data.

    Attributes:
        name: the channel, as the rig file names it.
        arbitration_id: identifier of the frames it wants.
        is_extended: that identifier has 29 bits.
        timeout_s: silent for longer than this is a gap.
        missed_frames: frames that did not arrive so far, by the counter that they carry; None if they carry none that
            counts.
    """

    name: str
    arbitration_id: int
    is_extended: bool
    timeout_s: float
    missed_frames: int | None

    def decode(self, stamp: Stamp, data: bytes) -> list[Record]:
        """Return the records of one frame, sampled at `stamp`; if that is doubtful, no motion is judged by it."""


def too_short(name: str, unit: str, stamp: Stamp, data: bytes, needed_bits: int) -> list[Record]:
    """Return the records of a frame that ends before the channel's value does."""
    reason = f"the frame has {len(data)} bytes, the value needs {(needed_bits + 7) // 8}"
    return [DecodeFailure(name, stamp, reason, data), Reading(name, stamp, None, unit, Status.MALFORMED)]


def value_reading(name: str, unit: str, stamp: Stamp, value: float, raw_counts: int | None) -> Reading:
    """Return the reading of a computed value; one that is not finite is out of range, never a number."""
    if math.isfinite(value):
        return Reading(name, stamp, value, unit, Status.OK, raw_counts)
    return Reading(name, stamp, None, unit, Status.OUT_OF_RANGE, raw_counts)


def without_time(record: Record) -> Record:
    """Return the record of a frame whose time is doubtful: a reading without its value."""
    if isinstance(record, Reading) and record.status is Status.OK:
        return replace(record, value=None, status=Status.TIME_DOUBTFUL)
    return record
