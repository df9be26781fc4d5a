"""How a command talks to the running daemon: where its socket is, what it is asked, and how its answer is shown."""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from daemon.cli.output import json_option
from daemon.cli.terminal import Terminal
from daemon.config import read_config
from daemon.control import request

DEFAULT_SOCKET = Path("/run/rigcal/control.sock")

Show = Callable[[Console, Any], None]


def socket_of(path: Path | None, config: Path | None) -> Path:
    """Where the daemon listens: --socket, --config, $RIGCAL_SOCKET, else the service's place."""
    if path is not None:
        return path
    if config is not None:
        return read_config(config).socket_path
    return Path(os.environ.get("RIGCAL_SOCKET", DEFAULT_SOCKET))


def talks(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options that every command to the daemon has."""
    command = json_option(command)
    command = click.option(
        "--config", type=click.Path(path_type=Path), help="Configuration of the daemon to talk to (gives its socket)."
    )(command)
    at = click.Path(path_type=Path, readable=False)  # who may only look is told what to do, by `request`
    return click.option("--socket", type=at, help="Control socket of the daemon.")(command)


def ask(where: dict[str, Any], command: str, show: Show, timeout_s: float = 120.0, **arguments: Any) -> Any:
    """Send a command; show its result to people, and return it for `--json`."""
    given = {key: value for key, value in arguments.items() if value is not None}
    result = request(socket_of(where["socket"], where["config"]), command, given, timeout_s=timeout_s)
    if not where["as_json"]:
        show(Terminal(), result)
    return result if isinstance(result, dict) else {"result": result}


def say(console: Console, text: Any) -> None:
    """Print a line as it is."""
    console.print(str(text))


def who(operator: str, user: str | None) -> str:
    """Return the operator that somebody named, and the user that the computer knew, where that is another name."""
    if not user or user == operator:
        return operator
    return f"{operator} (user {user})" if operator else f"user {user}"


def utc(utc_ns: int) -> str:
    """An instant for people."""
    return datetime.fromtimestamp(utc_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
