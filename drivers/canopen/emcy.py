"""EMCY, the emergency message of a CANopen node (CiA 301): decoding, and texts for its codes."""

from __future__ import annotations

import struct
from dataclasses import dataclass

_ERROR_REGISTER_BITS = {
    0: "generic",
    1: "current",
    2: "voltage",
    3: "temperature",
    4: "communication",
    5: "device profile",
    6: "reserved",
    7: "manufacturer",
}

_EMCY_CLASSES = (  # CiA 301, table of emergency error codes: longest prefix first
    (0xFFFF, 0x8110, "CAN overrun"),
    (0xFFFF, 0x8120, "CAN in error passive mode"),
    (0xFFFF, 0x8130, "life guard or heartbeat error"),
    (0xFFFF, 0x8140, "recovered from bus-off"),
    (0xFFFF, 0x8150, "CAN-ID collision"),
    (0xFFFF, 0x8210, "PDO not processed for its length"),
    (0xFFFF, 0x8220, "PDO length exceeded"),
    (0xFF00, 0x0000, "error reset"),
    (0xFF00, 0x1000, "generic error"),
    (0xF000, 0x2000, "current"),
    (0xF000, 0x3000, "voltage"),
    (0xF000, 0x4000, "temperature"),
    (0xF000, 0x5000, "device hardware"),
    (0xF000, 0x6000, "device software"),
    (0xF000, 0x7000, "additional modules"),
    (0xFF00, 0x8100, "communication"),
    (0xFF00, 0x8200, "protocol error"),
    (0xF000, 0x8000, "monitoring"),
    (0xF000, 0x9000, "external error"),
    (0xFF00, 0xF000, "additional functions"),
    (0xFF00, 0xFF00, "device specific"),
)


@dataclass(frozen=True, slots=True)
class Emergency:
    """An EMCY message.

    Attributes:
        code: emergency error code; 0 when all errors have cleared.
        register: error register, object 1001h.
        manufacturer: five manufacturer-specific bytes.
    """

    code: int
    register: int
    manufacturer: bytes

    @property
    def is_reset(self) -> bool:
        """True if the node reports that errors have cleared (codes 00xxh)."""
        return self.code & 0xFF00 == 0

    @property
    def words(self) -> str:
        """Code and register in words, for messages to operators."""
        text = next((text for mask, code, text in _EMCY_CLASSES if self.code & mask == code), "unknown code")
        bits = error_register_words(self.register)
        return f"emergency {self.code:04X}h ({text}), error register {self.register:02X}h ({bits})"


def error_register_words(register: int) -> str:
    """Return descriptions of the bits set in object 1001h; "none" if none is set."""
    return ", ".join(text for bit, text in _ERROR_REGISTER_BITS.items() if register >> bit & 1) or "none"


def decode_emergency(data: bytes) -> Emergency:
    """Decode an EMCY message.

    Raises:
        ValueError: `data` does not have 8 bytes.
    """
    if len(data) != 8:
        raise ValueError(f"an EMCY message has 8 bytes, this one has {len(data)}")
    code, register = struct.unpack_from("<HB", data)
    return Emergency(code, register, data[3:])
