"""Encoder of the corrected tip as CAN frames; `tip.dbc` and docs/reference/tip-frames.md describe them.

Two frames with consecutive 11-bit identifiers carry one tip; both have its counter and its status, so that a receiver
can pair them. Lengths are in 0.1 mm, little-endian, in the base frame.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum

from drivers.can.frame import Frame

FRAMES = 2  # identifiers that one tip takes, from the configured one on
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
        """True if a position comes with it."""
        return self < TipStatus.NO_MODEL


@dataclass(frozen=True)
class TipMessage:
    """A tip to be sent.

    Attributes:
        status: what it is worth.
        position_mm: x, y, z in the base frame; None without a position.
        sigma_mm: RMS of the 3-D error to be expected of it.
        age_s: how long ago the joints were read; clocks may differ so that it is a little below 0, sent as 0.
    """

    status: TipStatus
    position_mm: tuple[float, float, float] | None = None
    sigma_mm: float | None = None
    age_s: float | None = None


def encode_tip(message: TipMessage, arbitration_id: int, counter: int) -> list[Frame]:
    """Encode one tip as two frames.

    A position that the frames cannot hold (838 m and more from the base, or no number) is sent as FAILED without one; a
    sigma or an age that is not known, no number, or beyond its range is sent as the greatest value.

    Args:
        message: the tip.
        arbitration_id: of the first frame; the second has the next one.
        counter: of tips sent so far; its last 8 bits are sent.
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
    """Return the whole units in a value, 0 to `most`; `most` where it is not known or no number."""
    if value is None or math.isnan(value):
        return most
    return round(min(max(value / unit, 0.0), most))
