"""The protocol of the control socket, one JSON object per line in each direction, and its client.

Request `{"command": "session.start", "arguments": {...}}`; answer `{"ok": true, "result": ...}` or
`{"ok": false, "status": 2, "error": "one sentence"}`. `status` is the exit status with which a command line should end.
"""

from __future__ import annotations

import contextlib
import grp
import json
import math
import socket
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from daemon.commands import FAILED, REFUSED, CommandError, Handler, reading_socket
from daemon.control.command_table import READING
from daemon.host.safe_output import shown

MAX_LINE_BYTES = 1 << 20
MAX_ERROR_CHARACTERS = 2000
MAX_DEPTH = 20  # nesting of lists and objects in a request; commands need at most four levels
MAX_WHOLE = 2**63 - 1  # the store keeps whole numbers in 64 bits
_FORM = '{"command": NAME, "arguments": {...}}'


# ---- requests and answers --------------------------------------------------------------------------------------------


def parse_request(line: bytes) -> tuple[str, dict[str, Any]]:
    """Return the command and the arguments of a request.

    Raises:
        CommandError: the line is not a request, or contains what no command can use: numbers that are not finite or
            need more than 64 bits, text that is not valid Unicode, or nesting deeper than `MAX_DEPTH`.
    """
    if len(line) > MAX_LINE_BYTES:
        raise CommandError(f"request longer than {MAX_LINE_BYTES} bytes")
    try:
        request = json.loads(line, parse_constant=_no_number, parse_float=_finite, parse_int=_whole)
    except ValueError:
        request = None
    except RecursionError:
        raise _too_deep() from None
    if not isinstance(request, dict) or not isinstance(request.get("command"), str):
        raise CommandError(f"a request is one JSON object per line: {_FORM}")
    _check_values(request)
    if unknown := sorted(request.keys() - {"command", "arguments"}):
        raise CommandError(f"unknown key {shown(unknown[0], 80)} in the request; a request is {_FORM}")
    arguments = request.get("arguments", {})
    if not isinstance(arguments, dict):
        raise CommandError("arguments must be a JSON object")
    return request["command"], arguments


def answer_line(result: object) -> bytes:
    """Return the answer to a command that succeeded."""
    return json.dumps({"ok": True, "result": result}).encode() + b"\n"


def refusal_line(message: str, status: int) -> bytes:
    """Return the answer to a command that was refused or failed.

    Args:
        message: why; cut off after `MAX_ERROR_CHARACTERS`.
        status: exit status for a command line.
    """
    if len(message) > MAX_ERROR_CHARACTERS:
        message = f"{message[:MAX_ERROR_CHARACTERS]}..."
    return json.dumps({"ok": False, "status": status, "error": message}).encode() + b"\n"


def _no_number(text: str) -> NoReturn:
    raise CommandError(f"a request may contain finite numbers only, not {text}")


def _finite(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _no_number(text[:20])


def _whole(text: str) -> int:
    if len(text) <= len(str(-MAX_WHOLE)) and -MAX_WHOLE - 1 <= (value := int(text)) <= MAX_WHOLE:
        return value
    raise CommandError(f"whole numbers in a request must fit in 64 bits, and {text:.20} does not")


def _check_values(request: object) -> None:
    """Raise CommandError where JSON values are nested too deep, or a text cannot be encoded."""
    level = [request]
    for _ in range(MAX_DEPTH):
        below: list[object] = []
        for value in level:
            if isinstance(value, str):
                _check_text(value)
            elif isinstance(value, dict):
                below += (*value, *value.values())
            elif isinstance(value, list):
                below += value
        if not below:
            return
        level = below
    raise _too_deep()


def _check_text(text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise CommandError(f"texts in a request must be Unicode; {text[error.start]!a} is half a character") from None


def _too_deep() -> CommandError:
    return CommandError(f"a request may nest lists and objects at most {MAX_DEPTH} deep")


# ---- the client's side -----------------------------------------------------------------------------------------------


def how_to_be_let_in(control_path: Path) -> str:
    """Return how a user without access to a control socket can get it: a clause that names the socket's group, if any.

    Args:
        control_path: the control socket.
    """
    try:
        gid = control_path.stat().st_gid
    except OSError:
        return "join the group that owns its control socket, or use sudo"
    if gid == 0:
        return "use sudo: its group is root, which nobody should join"
    try:
        group = grp.getgrgid(gid).gr_name
    except (KeyError, OSError):
        group = str(gid)
    return f"join the group {group} (`sudo adduser NAME {group}`, then log in again), or use sudo"


def request(path: Path, command: str, arguments: Mapping[str, Any] | None = None, *, timeout_s: float = 120.0) -> Any:
    """Send one command to the running daemon and return its result.

    A user without access to the control socket is served by the read-only socket, where there is one.

    Args:
        path: the control socket.
        command: name of the command.
        arguments: its arguments.
        timeout_s: how long to wait for the answer.

    Raises:
        CommandError: no daemon is listening, it refused, or it did not answer within `timeout_s`.
    """
    message = request_line(command, arguments)
    try:
        try:
            line = _exchange(path, message, timeout_s)
        except PermissionError:
            line = _exchange_reading(path, message, timeout_s)
    except TimeoutError:
        raise CommandError(
            f"the daemon at {path} did not answer within {timeout_s:g} s: it hangs, was stopped by a signal, or the "
            "computer is too busy; see its log",
            FAILED,
        ) from None
    except OSError as error:
        raise unreachable(path, error) from None
    return result_of(line, path)


def request_line(command: str, arguments: Mapping[str, Any] | None = None) -> bytes:
    """Return a request as the line that is sent."""
    return json.dumps({"command": command, "arguments": dict(arguments or {})}).encode() + b"\n"


def result_of(line: bytes, path: Path) -> Any:
    """Return the result in an answer.

    Args:
        line: the answer; b"" where the connection was closed without an answer.
        path: the socket, for messages.

    Raises:
        CommandError: there is no complete answer, or the daemon refused.
    """
    if not line.endswith(b"\n"):
        raise CommandError(f"the daemon at {path} closed the connection without an answer; see its log", FAILED)
    answer = json.loads(line)
    if not answer["ok"]:
        raise CommandError(answer["error"], answer["status"])
    return answer["result"]


def unreachable(path: Path, error: OSError) -> CommandError:
    """Return the error of a client that finds no daemon at a socket."""
    return CommandError(
        f"no daemon is listening at {path} ({error.strerror or error}); start one with `rigcal run`, "
        "or name its socket with --socket: `rigcal run` logs it at its start (--sim uses rigcal-sim/control.sock)",
        FAILED,
    )


def _exchange_reading(control_path: Path, message: bytes, timeout_s: float) -> bytes:
    """Send a request to the read-only socket."""
    try:
        return _exchange(reading_socket(control_path), message, timeout_s)
    except TimeoutError:
        raise
    except OSError:
        raise CommandError(f"{control_path}: permission denied; {how_to_be_let_in(control_path)}", REFUSED) from None


def _exchange(path: Path, message: bytes, timeout_s: float) -> bytes:
    """Send a line and return the answer; b"" where there is none."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(timeout_s)
        connection.connect(str(path))
        # A daemon that refuses a connection sends the reason and closes, perhaps before it has received anything.
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            connection.sendall(message)
        with connection.makefile("rb") as stream:
            try:
                return stream.readline()
            except ConnectionResetError:
                return b""


# ---- rights ----------------------------------------------------------------------------------------------------------


def reading_only(handlers: Mapping[str, Handler], control_path: Path) -> dict[str, Handler]:
    """Return handlers that refuse the commands that change something, and carry out the others.

    Args:
        handlers: handlers of all commands.
        control_path: the control socket, whose group the refusal names.
    """
    return {
        name: handler if name in READING else partial(_refuse, name, control_path) for name, handler in handlers.items()
    }


def _refuse(command: str, control_path: Path, _arguments: Mapping[str, Any]) -> NoReturn:
    raise CommandError(
        f"you may view the state but not change anything, as {command} does; {how_to_be_let_in(control_path)}", REFUSED
    )
