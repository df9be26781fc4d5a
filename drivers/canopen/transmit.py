"""Permission to send on a machine's bus: denied unless the configuration allows it, node by node."""

from __future__ import annotations

from collections.abc import Collection

from drivers.can.frame import Frame
from drivers.canopen.cia301 import Service, classify
from drivers.errors import TransmitForbiddenError

FREE_IDENTIFIERS = range(0x680, 0x6E0)
_BROADCAST = (Service.SYNC, Service.TIME)
_TO_NODE = (Service.SDO_REQUEST, Service.RPDO)


def is_free(arbitration_id: int) -> bool:
    """Return True if CANopen leaves an 11-bit identifier free for an application's own messages.

    Source: CiA 301, the pre-defined connection set and the table of restricted CAN-IDs.
    """
    return arbitration_id in FREE_IDENTIFIERS


class TransmitPermission:
    """Checks every frame before a link sends it.

    SYNC and TIME need `allow_transmit`. NMT, SDO requests and RPDOs also need their node to be listed, and rigcal's own
    messages need their identifier to be listed. Everything else is always refused: NMT to all nodes, LSS, remote and
    extended frames, and messages that only a node itself may send.

    Args:
        link: name of the link, for error messages.
        allow_transmit: the link may send.
        nodes: numbers of the nodes that may be addressed.
        own_identifiers: 11-bit identifiers of rigcal's own messages.

    Raises:
        TransmitForbiddenError: an own identifier is given for a link that may not transmit, or belongs to CANopen.
    """

    def __init__(
        self, link: str, allow_transmit: bool, nodes: Collection[int], own_identifiers: Collection[int] = ()
    ) -> None:
        self._link = link
        self._allow_transmit = allow_transmit
        self._nodes = frozenset(nodes)
        self._own_identifiers = frozenset(own_identifiers)
        for identifier in sorted(self._own_identifiers):
            self.check_link()
            if not is_free(identifier):
                raise TransmitForbiddenError(
                    link, f"identifier {identifier:03X}h is not free for rigcal's messages; use one of 680h to 6DFh"
                )

    def check_link(self) -> None:
        """Raise TransmitForbiddenError unless the link may transmit."""
        if not self._allow_transmit:
            raise TransmitForbiddenError(
                self._link, "the link is listen-only; set allow_transmit = true and list the nodes to transmit"
            )

    def allows(self, node: int) -> bool:
        """Return True if `node` may be addressed."""
        return self._allow_transmit and node in self._nodes

    def check_node(self, node: int) -> None:
        """Raise TransmitForbiddenError unless `node` may be addressed."""
        self.check_link()
        if not self.allows(node):
            known = ", ".join(map(str, sorted(self._nodes))) or "none"
            raise TransmitForbiddenError(self._link, f"node {node} is not listed in transmit_nodes (listed: {known})")

    def check(self, frame: Frame) -> None:
        """Raise TransmitForbiddenError unless `frame` may be sent."""
        self.check_link()
        if frame.is_plain and frame.arbitration_id in self._own_identifiers:
            return
        meaning = classify(frame.arbitration_id) if frame.is_plain else None
        if meaning is not None:
            if meaning.service in _BROADCAST:
                return
            if meaning.service in _TO_NODE and meaning.node is not None:
                self.check_node(meaning.node)
                return
            if meaning.service is Service.NMT and len(frame.data) == 2 and frame.data[1] != 0:
                self.check_node(frame.data[1])
                return
        raise TransmitForbiddenError(self._link, f"frame {frame} is of a kind that rigcal never sends")
