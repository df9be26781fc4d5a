"""The other end of both links, by script: what a host does that sets up nodes, sends SYNC and polls the station.

For generating captures without a daemon. It knows just enough of the protocols to keep the conversation going.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from simulators.devices.can.bus import Frame
from simulators.devices.stations.topcon_text import ETX, frame

_SDO_TIMEOUT_S = 0.5
_STATION_TIMEOUT_S = 3.0
_REBOOT_GRACE_S = 0.02


def expedited(node: int, index: int, sub: int, value: int, size: int) -> Frame:
    """An SDO write of 1, 2 or 4 bytes."""
    command = {1: 0x2F, 2: 0x2B, 4: 0x23}[size]
    head = bytes([command]) + index.to_bytes(2, "little") + bytes([sub])
    return Frame(0x600 + node, head + value.to_bytes(4, "little"))


def upload(node: int, index: int, sub: int) -> Frame:
    """An SDO read."""
    return Frame(0x600 + node, bytes([0x40]) + index.to_bytes(2, "little") + bytes([sub]) + bytes(4))


def set_up_frames(node: int, *, heartbeat_ms: int) -> list[Frame]:
    """Identify a node, switch its first TPDO to SYNC and its second off, and have it send heartbeats."""
    first, second = 0x180 + node, 0x280 + node
    return [
        upload(node, 0x1000, 0),
        upload(node, 0x1018, 1),
        upload(node, 0x6501, 0),
        expedited(node, 0x1800, 1, first | 0x80000000, 4),
        expedited(node, 0x1800, 2, 1, 1),
        expedited(node, 0x1800, 1, first, 4),
        expedited(node, 0x1801, 1, second | 0x80000000, 4),
        expedited(node, 0x1017, 0, heartbeat_ms, 2),
    ]


class ScriptedHost:
    """A host with a plan.

    Args:
        nodes: nodes to set up and start, and again after each boot-up; none: the bus is listened to only.
        sync_period_s: SYNC interval once the nodes are started; None sends none.
        poll_period_s: interval of measurements that the station is asked for; None: nothing is ever written to it.
        heartbeat_ms: heartbeat time given to the nodes.
    """

    def __init__(
        self,
        nodes: Sequence[int] = (),
        *,
        sync_period_s: float | None = None,
        poll_period_s: float | None = None,
        heartbeat_ms: int = 1000,
    ) -> None:
        self._nodes = frozenset(nodes)
        self._heartbeat_ms = heartbeat_ms
        self._requests: deque[Frame] = deque()
        self._sdo_due_s = math.inf
        self._awaited: int | None = None  # COB-ID of the answer that is waited for
        self._sync_period_s, self._sync_due_s = sync_period_s, sync_period_s or math.inf
        self._poll_period_s = poll_period_s
        self._commands = deque([b"T34"])
        self._station_due_s = 0.0 if poll_period_s else math.inf
        self._heard = b""

    def hear_can(self, heard: Frame, now_s: float) -> None:
        """A frame from the bus."""
        node = heard.arbitration_id & 0x7F
        if heard.arbitration_id & ~0x7F == 0x700 and heard.data == b"\x00" and node in self._nodes:
            self._requests.extend(set_up_frames(node, heartbeat_ms=self._heartbeat_ms))
            self._requests.append(Frame(0x000, bytes([0x01, node])))
            if self._sdo_due_s == math.inf:
                self._sdo_due_s = now_s + _REBOOT_GRACE_S
        elif heard.arbitration_id == self._awaited:
            self._awaited = None
            self._sdo_due_s = now_s + 0.001

    def hear_station(self, data: bytes, now_s: float) -> None:
        """Bytes from the station."""
        self._heard += data
        blocks = self._heard.count(ETX)
        # A setting is answered by an acknowledgement alone, a measurement by one and a record.
        if self._poll_period_s and blocks >= (1 if self._commands else 2):
            self._heard = b""
            if self._commands:
                self._commands.popleft()
            self._station_due_s = now_s + self._poll_period_s

    def poll(self, now_s: float) -> tuple[list[Frame], bytes]:
        """What the host sends now: frames, and bytes to the station."""
        frames: list[Frame] = []
        if now_s >= self._sdo_due_s:
            frames += self._next_request(now_s)
        if now_s >= self._sync_due_s and self._sync_period_s:
            frames.append(Frame(0x080, b""))
            self._sync_due_s += self._sync_period_s
        out = b""
        if now_s >= self._station_due_s:
            out = frame(self._commands[0] if self._commands else b"C11", crlf=True)
            self._heard = b""
            self._station_due_s = now_s + _STATION_TIMEOUT_S
        return frames, out

    def _next_request(self, now_s: float) -> list[Frame]:
        if not self._requests:
            self._sdo_due_s, self._awaited = math.inf, None
            return []
        request = self._requests.popleft()
        answered = request.arbitration_id != 0x000
        self._awaited = request.arbitration_id - 0x80 if answered else None
        self._sdo_due_s = now_s + (_SDO_TIMEOUT_S if answered else 0.001)
        return [request]

    def next_deadline(self) -> float:
        """When `poll` will have something to do."""
        return min(self._sdo_due_s, self._sync_due_s, self._station_due_s)
