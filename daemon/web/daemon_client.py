"""Requests to the daemon over its control socket, from a process that must never block."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from daemon.commands import FAILED, REFUSED, CommandError, reading_socket
from daemon.control.protocol import how_to_be_let_in, request_line, result_of, unreachable

_ANSWER_BYTES = 64 << 20  # longest line; a store of years has long lists
_AT_A_TIME = 8  # the daemon serves 32 clients

Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


class DaemonClient:
    """Sends requests to the daemon, each over a separate connection.

    Args:
        path: the control socket; the read-only socket is tried if this process may not use the control socket.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._places = asyncio.Semaphore(_AT_A_TIME)

    async def ask(self, command: str, arguments: Mapping[str, Any] | None = None, *, timeout_s: float = 30.0) -> Any:
        """Send one command and return its result.

        Raises:
            CommandError: no daemon is listening, it refused, or it did not answer in time.
        """
        async with self._places:
            connection = DaemonConnection(self.path)
            try:
                return await connection.ask(command, arguments, timeout_s=timeout_s)
            finally:
                connection.close()


class DaemonConnection:
    """One connection that is kept open between requests as long as possible.

    Args:
        path: as in `DaemonClient`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._streams: Streams | None = None

    async def ask(self, command: str, arguments: Mapping[str, Any] | None = None, *, timeout_s: float) -> Any:
        """Send one command and return its result; after an error the next request opens a new connection.

        Raises:
            CommandError: as in `DaemonClient.ask`.
        """
        try:
            async with asyncio.timeout(timeout_s):
                line = await self._exchange(request_line(command, arguments))
        except TimeoutError:
            self.close()
            raise CommandError(f"the daemon did not answer within {timeout_s:g} s", FAILED) from None
        except (OSError, ValueError) as error:
            self.close()
            raise unreachable(self._path, error if isinstance(error, OSError) else OSError(str(error))) from None
        except BaseException:
            self.close()  # else the next request would get this answer
            raise
        if not line:
            self.close()
        return result_of(line, self._path)

    def close(self) -> None:
        """Close the connection, if there is one."""
        if self._streams is not None:
            with contextlib.suppress(OSError, RuntimeError):
                self._streams[1].close()
            self._streams = None

    async def _exchange(self, message: bytes) -> bytes:
        is_used = self._streams is not None
        if self._streams is None:
            self._streams = await _connected(self._path)
        reader, writer = self._streams
        try:
            writer.write(message)
            await writer.drain()
            line = await reader.readline()
        except (BrokenPipeError, ConnectionResetError):
            line = b""
        if not line and is_used:  # the daemon closes idle connections: retry once on a new one
            self.close()
            return await self._exchange(message)
        return line


async def _connected(path: Path) -> Streams:
    try:
        return await asyncio.open_unix_connection(str(path), limit=_ANSWER_BYTES)
    except PermissionError:
        try:
            return await asyncio.open_unix_connection(str(reading_socket(path)), limit=_ANSWER_BYTES)
        except OSError:
            raise CommandError(f"{path}: permission denied; {how_to_be_let_in(path)}", REFUSED) from None
