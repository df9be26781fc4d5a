"""The daemon's client: finds its socket, sends commands, and formats its answers."""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from daemon.cli.command import json_option
from daemon.commands import INSTALLED_CONFIG, INSTALLED_SOCKET
from daemon.control.protocol import request

STATUS_TIMEOUT_S = 10.0  # a daemon that does not answer within this time has a fault

operator_option = click.option(
    "--operator",
    default=lambda: os.environ.get("USER", ""),
    help="Who is responsible, stored with the decision.  [default: $USER]",
)


def socket_of(path: Path | None, config: Path | None) -> Path:
    """Return the path of the daemon's socket: from --socket, --config, $RIGCAL_SOCKET, or else the service's path."""
    if path is not None:
        return path
    if config is not None:
        from daemon.config.config import read_config

        return read_config(config).socket_path
    return Path(os.environ.get("RIGCAL_SOCKET") or INSTALLED_SOCKET)


def config_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--config` to a command on a daemon's files; the default is the installed service's configuration."""
    return click.option(
        "--config",
        type=click.Path(path_type=Path),
        callback=_installed,
        help=f"Configuration of the daemon.  [default: {INSTALLED_CONFIG}]",
    )(command)


def _installed(_ctx: click.Context, _parameter: click.Parameter, given: Path | None) -> Path:
    if given is None and not INSTALLED_CONFIG.exists():
        raise click.UsageError(f"{INSTALLED_CONFIG} does not exist; give the daemon's configuration with --config FILE")
    return given or INSTALLED_CONFIG


def client_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of every command to the daemon: `--socket`, `--config` and `--json`."""
    command = json_option(command)
    command = click.option(
        "--config", type=click.Path(path_type=Path), help="Configuration of the daemon, which names its control socket."
    )(command)
    at = click.Path(path_type=Path, readable=False)  # `request` explains what to do if the user may only read
    usual = f"[default: $RIGCAL_SOCKET or {INSTALLED_SOCKET}]"
    return click.option("--socket", type=at, help=f"Control socket of the daemon.  {usual}")(command)


def ask(
    where: dict[str, Any], command: str, show: Callable[[Any], None], timeout_s: float = 120.0, **arguments: Any
) -> Any:
    """Send a command, print its result unless `--json` is given, and return it.

    Args:
        where: the values of `client_options`.
        command: its name in the protocol.
        show: prints the result.
        timeout_s: how long to wait for the answer, in seconds.
        arguments: of the command; arguments that are None are not sent.
    """
    given = {key: value for key, value in arguments.items() if value is not None}
    result = request(socket_of(where["socket"], where["config"]), command, given, timeout_s=timeout_s)
    if not where["as_json"]:
        show(result)
    return result if isinstance(result, dict) else {"result": result}


def who(operator: str, user: str | None) -> str:
    """Return the given operator's name, with the login name of the user if the two differ."""
    if not user or user == operator:
        return operator
    return f"{operator} (user {user})" if operator else f"user {user}"


def utc(utc_ns: int) -> str:
    """Return a time in UTC, formatted for people."""
    return datetime.fromtimestamp(utc_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
