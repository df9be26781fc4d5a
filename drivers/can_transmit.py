"""What rigcal may send on a machine's bus: nothing, unless the configuration says otherwise, node by node."""

from __future__ import annotations

from collections.abc import Collection

from drivers.canframe import Frame
from drivers.cia301 import Service, classify
from drivers.errors import TransmitForbiddenError

_BROADCAST = (Service.SYNC, Service.TIME)
_TO_NODE = (Service.SDO_REQUEST, Service.RPDO)


class TransmitPermission:
    """The gate in front of a link's sender.

    SYNC and TIME need `allow_transmit`; NMT, SDO requests and RPDOs also need their node to be listed. Everything else
    is refused always: NMT to all nodes, LSS, remote and extended frames, and what only a node itself may send.

    Args:
        link: name of the link, for messages.
        allow_transmit: whether anything may be sent at all.
        nodes: nodes that may be addressed.
    """

    def __init__(self, link: str, allow_transmit: bool, nodes: Collection[int]) -> None:
        self._link = link
        self._allow_transmit = allow_transmit
        self._nodes = frozenset(nodes)

    def check_link(self) -> None:
        """Raise TransmitForbiddenError unless the link may transmit."""
        if not self._allow_transmit:
            raise TransmitForbiddenError(
                self._link, "the link is listen-only; set allow_transmit = true and list the nodes to transmit"
            )

    def check_node(self, node: int) -> None:
        """Raise TransmitForbiddenError unless `node` may be addressed."""
        self.check_link()
        if node not in self._nodes:
            known = ", ".join(map(str, sorted(self._nodes))) or "none"
            raise TransmitForbiddenError(self._link, f"node {node} is not listed in transmit_nodes (listed: {known})")

    def check(self, frame: Frame) -> None:
        """Raise TransmitForbiddenError unless `frame` may be sent."""
        self.check_link()
        meaning = None if frame.is_extended or frame.is_remote or frame.is_error else classify(frame.arbitration_id)
        if meaning is not None:
            if meaning.service in _BROADCAST:
                return
            if meaning.service in _TO_NODE and meaning.node is not None:
                self.check_node(meaning.node)
                return
            if meaning.service is Service.NMT and len(frame.data) == 2 and frame.data[1] != 0:
                self.check_node(frame.data[1])
                return
        raise TransmitForbiddenError(self._link, f"frame {frame} is none that rigcal may ever send")
