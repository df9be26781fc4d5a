"""SAE J1939-21: the parts of a 29-bit identifier.

An identifier does not show whether its bus is a J1939 bus. On other buses these numbers have no meaning.
"""

from __future__ import annotations

from dataclasses import dataclass

from drivers.can.frame import EXTENDED_ID_MAX

GLOBAL_ADDRESS = 0xFF
_PDU2_FIRST_FORMAT = 240  # from this format on, PDU specific is part of the PGN; below, the destination

_NAMES = {
    0xEA00: "request",
    0xEB00: "transport, data",
    0xEC00: "transport, connection",
    0xEE00: "address claimed",
    0xFECA: "DM1, active faults",
}


@dataclass(frozen=True, slots=True)
class J1939Id:
    """The parts of a 29-bit identifier: priority << 26 | EDP, DP << 24 | PDU format << 16 | PDU specific << 8 | source.

    Attributes:
        priority: 0 (highest) to 7.
        pgn: parameter group number, 18 bits; its low byte is 0 if the message has a destination.
        source: address of the sender.
        destination: address of the receiver, or GLOBAL_ADDRESS for all; None for groups without one (broadcast).
    """

    priority: int
    pgn: int
    source: int
    destination: int | None

    @classmethod
    def parse(cls, arbitration_id: int) -> J1939Id:
        """Split an identifier into its parts.

        Raises:
            ValueError: the identifier has more than 29 bits.
        """
        if not 0 <= arbitration_id <= EXTENDED_ID_MAX:
            raise ValueError(f"{arbitration_id:X}h is not a 29-bit identifier")
        group = arbitration_id >> 8 & 0x3FFFF
        is_broadcast = group >> 8 & 0xFF >= _PDU2_FIRST_FORMAT
        return cls(
            priority=arbitration_id >> 26,
            pgn=group if is_broadcast else group & ~0xFF,
            source=arbitration_id & 0xFF,
            destination=None if is_broadcast else group & 0xFF,
        )

    def __str__(self) -> str:
        name = f" ({_NAMES[self.pgn]})" if self.pgn in _NAMES else ""
        if self.destination is None:
            receiver = ""
        else:
            receiver = " to all" if self.destination == GLOBAL_ADDRESS else f" to {self.destination:02X}h"
        return f"PGN {self.pgn:04X}h{name} from {self.source:02X}h{receiver}, priority {self.priority}"
