"""CiA 301, the CANopen base protocol: identifiers, NMT, SYNC, TIME, EMCY, heartbeat. Pure codecs; SDO is in `sdo`."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, StrEnum

from drivers.canframe import Frame

NODE_MAX = 127
SYNC_COUNTER_MAX = 240
_MS_PER_DAY = 86_400_000
_TIME_EPOCH_DAY = 5113  # 1984-01-01 counted from 1970-01-01


class Service(StrEnum):
    """What a COB-ID of the pre-defined connection set is for."""

    NMT = "nmt"
    SYNC = "sync"
    EMCY = "emcy"
    TIME = "time"
    TPDO = "tpdo"
    RPDO = "rpdo"
    SDO_RESPONSE = "sdo_response"
    SDO_REQUEST = "sdo_request"
    HEARTBEAT = "heartbeat"
    LSS = "lss"


@dataclass(frozen=True, slots=True)
class CobId:
    """A COB-ID taken apart.

    Attributes:
        service: which service uses it.
        node: the node it belongs to; None for the broadcast services.
        pdo: 1 to 4 for PDOs, else None.
    """

    service: Service
    node: int | None = None
    pdo: int | None = None


_NODE_SERVICES: dict[int, tuple[Service, int | None]] = {
    0x080: (Service.EMCY, None),
    0x180: (Service.TPDO, 1),
    0x200: (Service.RPDO, 1),
    0x280: (Service.TPDO, 2),
    0x300: (Service.RPDO, 2),
    0x380: (Service.TPDO, 3),
    0x400: (Service.RPDO, 3),
    0x480: (Service.TPDO, 4),
    0x500: (Service.RPDO, 4),
    0x580: (Service.SDO_RESPONSE, None),
    0x600: (Service.SDO_REQUEST, None),
    0x700: (Service.HEARTBEAT, None),
}
_BROADCAST = {
    0x000: CobId(Service.NMT),
    0x080: CobId(Service.SYNC),
    0x100: CobId(Service.TIME),
    0x7E4: CobId(Service.LSS),
    0x7E5: CobId(Service.LSS),
}


def classify(arbitration_id: int) -> CobId | None:
    """What an 11-bit identifier is for in the pre-defined connection set; None if for nothing."""
    broadcast = _BROADCAST.get(arbitration_id)
    if broadcast is not None:
        return broadcast
    node = arbitration_id & 0x7F
    found = _NODE_SERVICES.get(arbitration_id & ~0x7F)
    if found is None or node == 0:
        return None
    return CobId(found[0], node, found[1])


def emcy_id(node: int) -> int:
    """COB-ID of a node's EMCY."""
    return 0x080 + node


def tpdo_id(node: int, pdo: int) -> int:
    """COB-ID of a node's TPDO 1 to 4."""
    return 0x180 + 0x100 * (pdo - 1) + node


def sdo_response_id(node: int) -> int:
    """COB-ID of a node's SDO answers (server to client)."""
    return 0x580 + node


def sdo_request_id(node: int) -> int:
    """COB-ID of SDO requests to a node (client to server)."""
    return 0x600 + node


def heartbeat_id(node: int) -> int:
    """COB-ID of a node's heartbeat and boot-up message."""
    return 0x700 + node


class NmtCommand(IntEnum):
    """Command specifiers of the NMT message 000h."""

    START = 0x01
    STOP = 0x02
    ENTER_PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """States of the heartbeat byte."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F

    @property
    def words(self) -> str:
        """The state as an operator reads it."""
        return self.name.lower().replace("_", "-")


def encode_nmt(command: NmtCommand, node: int) -> Frame:
    """The NMT message for one node (0: all nodes)."""
    return Frame(0x000, bytes((command, node)))


def encode_sync(counter: int | None = None) -> Frame:
    """The SYNC message, with a counter 1 to 240 where object 1019h asks for one."""
    return Frame(0x080, b"" if counter is None else bytes((counter,)))


def decode_heartbeat(data: bytes) -> NmtState:
    """The state in a heartbeat, boot-up or node-guarding answer (whose toggle bit 7 is left out).

    Raises:
        ValueError: not one byte, or no state of CiA 301.
    """
    if len(data) != 1:
        raise ValueError(f"a heartbeat has 1 byte, this has {len(data)}")
    try:
        return NmtState(data[0] & 0x7F)
    except ValueError:
        raise ValueError(f"{data[0]:02X}h is no NMT state (00, 04, 05, 7F)") from None


def encode_time(utc_ns: int) -> bytes:
    """TIME_OF_DAY: milliseconds since midnight (28 bit) and days since 1984-01-01."""
    days, milliseconds = divmod(utc_ns // 1_000_000, _MS_PER_DAY)
    return struct.pack("<IH", milliseconds, days - _TIME_EPOCH_DAY)


def decode_time(data: bytes) -> int:
    """Nanoseconds since 1970 of a TIME_OF_DAY.

    Raises:
        ValueError: not 6 bytes, or more milliseconds than a day has.
    """
    if len(data) != 6:
        raise ValueError(f"a TIME message has 6 bytes, this has {len(data)}")
    milliseconds = int.from_bytes(data[:4], "little") & 0x0FFFFFFF
    days = int.from_bytes(data[4:], "little")
    if milliseconds >= _MS_PER_DAY:
        raise ValueError(f"{milliseconds} ms since midnight is more than a day")
    return ((days + _TIME_EPOCH_DAY) * _MS_PER_DAY + milliseconds) * 1_000_000


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
        code: emergency error code; 0 when all errors are gone.
        register: object 1001h.
        manufacturer: five bytes of the maker's own.
    """

    code: int
    register: int
    manufacturer: bytes

    @property
    def is_reset(self) -> bool:
        """The node takes errors back (codes 00xxh)."""
        return self.code & 0xFF00 == 0

    @property
    def words(self) -> str:
        """Code and register as an operator reads them."""
        text = next((text for mask, code, text in _EMCY_CLASSES if self.code & mask == code), "unknown code")
        bits = error_register_words(self.register)
        return f"emergency {self.code:04X}h ({text}), error register {self.register:02X}h ({bits})"


def error_register_words(register: int) -> str:
    """The bits of object 1001h in words; "none" if none is set."""
    return ", ".join(text for bit, text in _ERROR_REGISTER_BITS.items() if register >> bit & 1) or "none"


def decode_emergency(data: bytes) -> Emergency:
    """An EMCY message.

    Raises:
        ValueError: not 8 bytes.
    """
    if len(data) != 8:
        raise ValueError(f"an EMCY message has 8 bytes, this has {len(data)}")
    code, register = struct.unpack_from("<HB", data)
    return Emergency(code, register, data[3:])
