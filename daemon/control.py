"""The control socket: one JSON object a line, each way, on a unix socket that only the rig's own users reach.

Request `{"command": "session.start", "arguments": {...}}`; answer `{"ok": true, "result": ...}` or
`{"ok": false, "status": 2, "error": "one sentence"}`. `status` is the exit status a command line should end with.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn

from daemon.store.errors import is_unwritable

log = logging.getLogger(__name__)

MAX_LINE_BYTES = 1 << 20
MESSAGE_MAX = 1000  # characters of an error
FAILED, WRONG_USE, REFUSED = 1, 2, 3


class CommandError(Exception):
    """A command that was not carried out.

    Attributes:
        status: 1 failed, 2 wrong use or bad input, 3 refused because the result would be unsafe.
    """

    def __init__(self, message: str, status: int = WRONG_USE) -> None:
        # What was asked for is quoted, and may be anything
        super().__init__(message if len(message) <= MESSAGE_MAX else f"{message[:MESSAGE_MAX]}...")
        self.status = status


Handler = Callable[[Mapping[str, Any]], Any]


class ControlServer:
    """Serves commands on a unix socket, one thread a connection, so that a slow command stops no other.

    Args:
        path: the socket; a file left by a killed daemon is replaced (the store's lock says that it is dead).
        handlers: command name -> function of the arguments, returning something JSON can hold.
    """

    def __init__(self, path: Path, handlers: Mapping[str, Handler]) -> None:
        self._path = path
        self._handlers = handlers
        self._stopping = threading.Event()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._connections: set[socket.socket] = set()
        self._threads: set[threading.Thread] = set()
        self._lock = threading.Lock()
        if path.is_socket():
            path.unlink()
        try:
            self._socket.bind(str(path))
        except OSError as error:
            self._socket.close()
            raise CommandError(f"the control socket {path} cannot be made: {error.strerror}", FAILED) from error
        os.chmod(path, 0o660)
        self._socket.listen(128)
        self._acceptor = threading.Thread(target=self._accept, name="control", daemon=True)
        self._acceptor.start()

    def close(self) -> None:
        """Stop serving; connections are closed and the socket file is removed."""
        self._stopping.set()
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        with self._lock:
            connections, threads = list(self._connections), list(self._threads)
        for connection in connections:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        self._acceptor.join(timeout=5)
        for thread in threads:
            thread.join(timeout=5)
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        while not self._stopping.is_set():
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            thread = threading.Thread(target=self._serve, args=(connection,), name="control-client", daemon=True)
            with self._lock:
                self._connections.add(connection)
                self._threads.add(thread)
            thread.start()

    def _serve(self, connection: socket.socket) -> None:
        try:
            with connection, connection.makefile("rwb") as stream:
                while line := stream.readline(MAX_LINE_BYTES + 1):
                    stream.write(json.dumps(self._answer(line)).encode() + b"\n")
                    stream.flush()
                    if len(line) > MAX_LINE_BYTES:
                        return
        except (OSError, ValueError):
            log.debug("a control connection ended early", exc_info=True)
        finally:
            with self._lock:
                self._connections.discard(connection)
                self._threads.discard(threading.current_thread())

    def _answer(self, line: bytes) -> dict[str, Any]:
        command: object = None
        try:
            command, arguments = self._parse(line)
            return {"ok": True, "result": self._handlers[command](arguments)}
        except CommandError as error:
            return _refusal(str(error), error.status)
        except Exception as error:  # a fault in one command must not end the daemon
            if is_unwritable(error):
                log.error("command %s: the store cannot be written (%s)", command, error)
                return _refusal(
                    f"the store cannot be written ({error}), so nothing was changed; free space on its disk, then say "
                    "it again",
                    FAILED,
                )
            log.exception("command %s failed", command)
            return _refusal(f"{command} failed inside the daemon: {error}; see its log", FAILED)

    def _parse(self, line: bytes) -> tuple[str, dict[str, Any]]:
        if len(line) > MAX_LINE_BYTES:
            raise CommandError(f"request longer than {MAX_LINE_BYTES} bytes")
        try:
            request = json.loads(line, parse_int=_int, parse_constant=_no_constant)
            json.dumps(request, ensure_ascii=False).encode()  # half a surrogate pair can neither be stored nor shown
        except (ValueError, RecursionError):
            request = None
        if not isinstance(request, dict) or not isinstance(request.get("command"), str):
            raise CommandError('a request is one JSON object a line: {"command": NAME, "arguments": {...}}')
        command, arguments = request["command"], request.get("arguments", {})
        if command not in self._handlers:
            raise CommandError(f"unknown command {command!r}; known: {', '.join(sorted(self._handlers))}")
        if not isinstance(arguments, dict):
            raise CommandError("arguments must be a JSON object")
        return command, arguments


def _int(digits: str) -> int:
    """A whole number that the store can hold; ValueError for one that it cannot."""
    number = int(digits)
    if not -(1 << 63) <= number < 1 << 63:
        raise ValueError("a whole number beyond 64 bits")
    return number


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON")


def _refusal(message: str, status: int) -> dict[str, Any]:
    return {"ok": False, "status": status, "error": message}


def request(path: Path, command: str, arguments: Mapping[str, Any] | None = None, *, timeout_s: float = 120.0) -> Any:
    """Send one command to the running daemon and return its result.

    Raises:
        CommandError: no daemon is listening, it refused, or it did not answer within `timeout_s`.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.settimeout(timeout_s)
            connection.connect(str(path))
            with connection.makefile("rwb") as stream:
                message = {"command": command, "arguments": dict(arguments or {})}
                stream.write(json.dumps(message).encode() + b"\n")
                stream.flush()
                line = stream.readline()
    except TimeoutError:
        raise CommandError(f"the daemon at {path} did not answer within {timeout_s:g} s", 1) from None
    except PermissionError:
        raise CommandError(f"{path}: permission denied; join the group that owns it or use sudo", 1) from None
    except OSError as error:
        raise CommandError(
            f"no daemon is listening at {path} ({error.strerror or error}); start one with `rigcal run`, "
            "or name its socket with --socket",
            1,
        ) from None
    if not line:
        raise CommandError(f"the daemon at {path} closed the connection without an answer; see its log", 1)
    answer = json.loads(line)
    if not answer["ok"]:
        raise CommandError(answer["error"], answer["status"])
    return answer["result"]
