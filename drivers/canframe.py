"""A classic CAN frame on its way between a protocol's state machine and a bus."""

from __future__ import annotations

from typing import NamedTuple

STANDARD_ID_MAX = 0x7FF
EXTENDED_ID_MAX = 0x1FFFFFFF
DATA_MAX = 8


class Frame(NamedTuple):
    """One classic CAN frame without its instant.

    Attributes:
        arbitration_id: 11-bit, or 29-bit if `is_extended`; the error class bits of SocketCAN if `is_error`.
        data: 0 to 8 bytes.
        is_extended, is_remote, is_error: the frame's flags.
    """

    arbitration_id: int
    data: bytes
    is_extended: bool = False
    is_remote: bool = False
    is_error: bool = False

    def __str__(self) -> str:
        digits = 8 if self.is_extended else 3
        return f"{self.arbitration_id:0{digits}X} [{len(self.data)}] {self.data.hex(' ').upper()}".rstrip()
