"""CiA 301, the CANopen base protocol: identifiers, NMT, heartbeat. SYNC, EMCY, SDO and PDO are separate modules."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, StrEnum

from drivers.can.frame import Frame


class Service(StrEnum):
    """Services of the pre-defined connection set."""

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
    """The parts of a COB-ID.

    Attributes:
        service: service that uses it.
        node: node that it belongs to; None for the broadcast services.
    """

    service: Service
    node: int | None = None


_NODE_SERVICES: dict[int, Service] = {
    0x080: Service.EMCY,
    0x180: Service.TPDO,
    0x200: Service.RPDO,
    0x280: Service.TPDO,
    0x300: Service.RPDO,
    0x380: Service.TPDO,
    0x400: Service.RPDO,
    0x480: Service.TPDO,
    0x500: Service.RPDO,
    0x580: Service.SDO_RESPONSE,
    0x600: Service.SDO_REQUEST,
    0x700: Service.HEARTBEAT,
}
_BROADCAST = {
    0x000: CobId(Service.NMT),
    0x080: CobId(Service.SYNC),
    0x100: CobId(Service.TIME),
    0x7E4: CobId(Service.LSS),
    0x7E5: CobId(Service.LSS),
}


def classify(arbitration_id: int) -> CobId | None:
    """Return the service and node of an 11-bit identifier in the pre-defined connection set; None if it has none."""
    broadcast = _BROADCAST.get(arbitration_id)
    if broadcast is not None:
        return broadcast
    node = arbitration_id & 0x7F
    found = _NODE_SERVICES.get(arbitration_id & ~0x7F)
    if found is None or node == 0:
        return None
    return CobId(found, node)


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


class NmtState(IntEnum):
    """States of the heartbeat byte."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F

    @property
    def words(self) -> str:
        """The state in words, for messages to operators."""
        return self.name.lower().replace("_", "-")


def encode_nmt(command: NmtCommand, node: int) -> Frame:
    """Return the NMT message for one node (0: all nodes)."""
    return Frame(0x000, bytes((command, node)))


def decode_heartbeat(data: bytes) -> NmtState:
    """Decode the state in a heartbeat, boot-up message or node-guarding answer (ignoring the latter's toggle bit 7).

    Raises:
        ValueError: `data` is not one byte, or its state is not one of CiA 301.
    """
    if len(data) != 1:
        raise ValueError(f"a heartbeat has 1 byte, this one has {len(data)}")
    try:
        return NmtState(data[0] & 0x7F)
    except ValueError:
        raise ValueError(f"{data[0]:02X}h is not an NMT state (00, 04, 05, 7F)") from None
