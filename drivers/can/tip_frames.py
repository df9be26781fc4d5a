"""Encoder of the corrected tip as CAN frames; `tip.dbc` and docs/reference/tip-frames.md describe them.

Two frames with consecutive 11-bit identifiers carry one tip. Both contain its counter and its status, so that a
receiver can pair them. Lengths are in 0.1 mm, little-endian, in the base frame.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum

from drivers.can.frame import Frame

FRAMES = 2  # number of identifiers used by one tip, starting with the configured one
UNIT_MM = 0.1
COORDINATE_MAX = 2**23 - 1
NO_COORDINATE = -(2**23)
SIGMA_MAX, NO_SIGMA = 0xFFFE, 0xFFFF
AGE_UNIT_S = 0.01
AGE_MAX, NO_AGE = 0xFE, 0xFF


class TipStatus(IntEnum):
    """Validity of a tip. From NO_MODEL on there is no position."""

    OK = 0
    DOUBTFUL = 1
    NO_MODEL = 16
    MODEL_UNUSABLE = 17
    STALE = 18
    OUT_OF_LIMITS = 19
    FAILED = 20
    ZERO_LOST = 21

    @property
    def has_position(self) -> bool:
        """True if a tip with this status has a position."""
        return self < TipStatus.NO_MODEL


@dataclass(frozen=True)
class TipMessage:
    """A tip to be sent.

    Attributes:
        status: validity of the tip.
        position_mm: x, y, z in the base frame; None without a position.
        sigma_mm: expected RMS of the position's 3-D error.
        age_s: time since the joints were read; slightly negative if clocks differ, and then sent as 0.
    """

    status: TipStatus
    position_mm: tuple[float, float, float] | None = None
    sigma_mm: float | None = None
    age_s: float | None = None


def encode_tip(message: TipMessage, arbitration_id: int, counter: int) -> list[Frame]:
    """Encode one tip as two frames.

    If the frames cannot hold the position (838 m or more from the base, or NaN), status FAILED is sent without a
    position. A sigma or an age that is unknown, NaN or out of range is sent as the largest value.

    Args:
        message: the tip.
        arbitration_id: identifier of the first frame; the second frame has the next one.
        counter: number of tips sent so far; its last 8 bits are sent.
    """
    status, coordinates = message.status, (NO_COORDINATE,) * 3
    sigma, age = NO_SIGMA, NO_AGE
    if message.position_mm is not None and status.has_position:
        x, y, z = (value / UNIT_MM for value in message.position_mm)
        if all(abs(value) <= COORDINATE_MAX for value in (x, y, z)):  # False for NaN
            coordinates = (round(x), round(y), round(z))
            sigma = _counts(message.sigma_mm, UNIT_MM, SIGMA_MAX)
            age = _counts(message.age_s, AGE_UNIT_S, AGE_MAX)
        else:
            status = TipStatus.FAILED
    x_bytes, y_bytes, z_bytes = (value.to_bytes(3, "little", signed=True) for value in coordinates)
    end = bytes([counter & 0xFF, status])
    return [
        Frame(arbitration_id, x_bytes + y_bytes + end),
        Frame(arbitration_id + 1, z_bytes + struct.pack("<HB", sigma, age) + end),
    ]


def _counts(value: float | None, unit: float, most: int) -> int:
    """Return a value in whole units, limited to 0 to `most`; `most` if the value is None or NaN."""
    if value is None or math.isnan(value):
        return most
    return round(min(max(value / unit, 0.0), most))
