"""The daemon's state, read once for all clients and sent to each as fast as it receives.

While any client is connected, the state is read several times per second. Each client receives the newest state that it
does not have yet: a slow client misses some states, without effect on the others. At most one message and the buffer of
its connection are pending for a client. The kernel closes the connection of a client that receives nothing for
`STALLED_S` (TCP_USER_TIMEOUT, see `server`).
"""

from __future__ import annotations

import asyncio
import itertools
import json
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any

from daemon.commands import CommandError
from daemon.next_step import next_for_page
from daemon.web.daemon_client import DaemonConnection
from drivers.clock import NS_PER_S, SystemClock

PERIOD_S = 0.15  # between two readings of the state
RETRY_S = 0.5  # while the daemon does not answer
ANSWER_S = 1.5
CLIENTS = 50
STALLED_S = 20.0

# Parts of the acquisition status that the page shows. The rest is for metrics and `rigcal status`.
_ACQUISITION = ("links", "channels", "stations", "decoding", "gaps", "writer_lag_p99_s", "error", "is_behind")
_STATUS = (
    *("rig", "mode", "version", "time", "clock", "alarms", "notices", "session", "control_shots", "jobs", "models"),
    *("gap", "events", "store_health", "unreadable"),
)


class Full(Exception):  # noqa: N818 - a state, reported to the client with status 503
    """The maximum number of clients is connected."""


class LiveFeed:
    """Sends the daemon's state to clients.

    Args:
        socket: the daemon's control socket.
    """

    def __init__(self, socket: Path) -> None:
        self._socket = socket
        self._clock = SystemClock()
        self._number = itertools.count(1)
        self._newest: tuple[int, bytes] = (0, b"")
        self._told = asyncio.Condition()
        self._clients = 0
        self._reader: asyncio.Task[None] | None = None
        self._answered_ns: int | None = None

    async def events(self) -> AsyncIterator[bytes]:
        """Yield the newest state, as an event of a text/event-stream, whenever it has changed.

        Raises:
            Full: too many clients are connected.
        """
        if self._clients >= CLIENTS:
            raise Full
        self._clients += 1
        if self._reader is None or self._reader.done():
            self._newest = (next(self._number), b"")  # a state from before the last client left is outdated
            self._answered_ns = None
            self._reader = asyncio.create_task(self._read())
        seen = self._newest[0]
        try:
            while True:
                seen, message = await self._newer(seen)
                yield message
        finally:
            self._clients -= 1
            if not self._clients and self._reader is not None:
                self._reader.cancel()

    async def _newer(self, seen: int) -> tuple[int, bytes]:
        """Wait for a state with a number above `seen`."""
        async with self._told:
            await self._told.wait_for(lambda: self._newest[0] > seen)
            return self._newest

    async def _read(self) -> None:
        """Read the state periodically."""
        connection = DaemonConnection(self._socket)
        try:
            while True:
                began_ns = self._clock.monotonic_ns()
                state = await self._state(connection)
                number = next(self._number)
                text = json.dumps(state | {"number": number}, separators=(",", ":"))
                async with self._told:
                    self._newest = number, f"id: {number}\ndata: {text}\n\n".encode()
                    self._told.notify_all()
                taken_s = (self._clock.monotonic_ns() - began_ns) / NS_PER_S
                pause_s = PERIOD_S if state["daemon"] is None else RETRY_S
                await asyncio.sleep(max(pause_s - taken_s, 0.02))
        finally:
            connection.close()

    async def _state(self, connection: DaemonConnection) -> dict[str, Any]:
        """Return the state for the page; its `daemon` is None, or the reason why there is no state."""
        try:
            status = await connection.ask("status", timeout_s=ANSWER_S)
            guide = (await connection.ask("guide.state", timeout_s=ANSWER_S))["guide"]
        except CommandError as error:
            silent_s = None
            if self._answered_ns is not None:
                silent_s = (self._clock.monotonic_ns() - self._answered_ns) / NS_PER_S
            return {"daemon": str(error), "silent_s": silent_s}
        self._answered_ns = self._clock.monotonic_ns()
        return shown_state(status, guide)


def shown_state(status: Mapping[str, Any], guide: dict[str, Any] | None) -> dict[str, Any]:
    """Return the parts of the daemon's status and of its guide that the page shows."""
    acquisition = status["acquisition"]
    return {
        "daemon": None,
        **{key: status[key] for key in _STATUS},
        "acquisition": {key: acquisition[key] for key in _ACQUISITION},
        "guide": guide,
        # Uses the guide as shown, which may be a step ahead of the status.
        "next": next_for_page({**status, "guide": guide if guide and guide["state"] == "open" else None}),
    }
