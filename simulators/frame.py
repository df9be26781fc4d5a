"""A CAN frame as simulated devices exchange it."""

from __future__ import annotations

from typing import NamedTuple


class Frame(NamedTuple):
    """One CAN frame.

    Attributes:
        arbitration_id: 11 or 29 bit; SocketCAN's error class bits if `is_error`.
        data: 0 to 8 bytes.
        is_extended, is_remote, is_error: flags.
    """

    arbitration_id: int
    data: bytes
    is_extended: bool = False
    is_remote: bool = False
    is_error: bool = False
