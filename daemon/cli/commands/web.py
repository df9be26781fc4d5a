"""`rigcal web`: serves the operator's page, and manages its access tokens."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from daemon.cli.client import config_option, socket_of, utc
from daemon.cli.command import Command, json_option
from daemon.cli.terminal import echo, echo_table

if TYPE_CHECKING:
    from daemon.web.access import TokenFile
    from daemon.web.settings import WebSettings

_ROLES = click.Choice(["read", "operate", "approve"])
_CONFIG = click.Path(path_type=Path)
_FILE = click.Path(dir_okay=False, path_type=Path)


@click.group(invoke_without_command=True)
@click.option("--host", help="Address to serve at.  [default: host of [web], or 127.0.0.1]")
@click.option("--port", type=click.IntRange(0, 65535), help="Port; 0 for any free port.  [default: 8370]")
@click.option("--certificate", type=_FILE, help="PEM file of the certificate; required if other computers have access.")
@click.option("--key", type=_FILE, help="PEM file of the certificate's key.")
@click.option(
    "--socket",
    type=click.Path(path_type=Path, readable=False),
    help="Control socket of the daemon; by default as for other commands.",
)
@click.option("--config", type=_CONFIG, help="Configuration of the daemon; its section [web] has the address.")
@click.option(
    "--loopback-role",
    type=_ROLES,
    help="Highest role of anyone who opens the page on this computer without a token.  [default: your own permissions]",
)
def web(**options: Any) -> None:
    """Serve the operator's page until stopped.

    `rigcal web token` manages access from other computers. On a loopback address the page needs no token: whoever opens
    it has the permissions of the user who started it. Any other address requires TLS and a token for each person
    (docs/how-to/operator-page.md).
    """
    ctx = click.get_current_context()
    if ctx.invoked_subcommand is None:
        with click.Context(_serve, parent=ctx, info_name="serve") as own:
            own.params = options
            _serve.invoke(own)


@click.command(cls=Command, name="web")
def _serve(**options: Any) -> None:
    """Serve the page."""
    from daemon.host.systemd import Notifier, set_up_logging
    from daemon.web.server import serve

    set_up_logging(level=logging.INFO)
    logging.getLogger("uvicorn").setLevel(logging.WARNING)
    serve(_settings(**options), lambda address: echo(f"the page is at {address}"), Notifier())


@web.group()
def token() -> None:
    """Manage access tokens of the operator's page."""


def _token_options(command: Callable[..., Any]) -> Callable[..., Any]:
    return config_option(json_option(command))


@token.command(cls=Command, name="add")
@click.argument("name")
@click.option(
    "--role", type=_ROLES, required=True, help="read: view; operate: also measure; approve: also accept models."
)
@_token_options
def token_add(name: str, role: str, config: Path, *, as_json: bool) -> dict[str, str]:
    """Make a token for NAME and print it.

    It is shown only once, as only its hash is stored.
    """
    from daemon.web.access import Role
    from drivers.clock import SystemClock

    made = _tokens(config).add(name, Role.named(role), SystemClock().now().utc_ns)
    if not as_json:
        echo(made)
    return {"name": name, "role": role, "token": made}


@token.command(cls=Command, name="remove")
@click.argument("name")
@_token_options
def token_remove(name: str, config: Path, *, as_json: bool) -> dict[str, str]:
    """Remove the token of NAME, which is refused from now on."""
    _tokens(config).remove(name)
    if not as_json:
        echo(f"the token of {name} is removed")
    return {"removed": name}


@token.command(cls=Command, name="list")
@_token_options
def token_list(config: Path, *, as_json: bool) -> dict[str, Any]:
    """List the names and roles of all tokens."""
    entries = _tokens(config).entries()
    if not as_json:
        if entries:
            rows = [[entry.name, entry.role, utc(entry.created_utc_ns)] for entry in entries]
            echo_table(("name", "role", "made"), rows)
        else:
            echo("no tokens yet; `rigcal web token add NAME --role operate` makes one")
    return {"tokens": [entry.model_dump(exclude={"sha256"}) for entry in entries]}


def _tokens(config: Path) -> TokenFile:
    from daemon.config.config import read_config
    from daemon.web.access import TokenFile

    return TokenFile(read_config(config).tokens_path)


def _settings(
    host: str | None,
    port: int | None,
    certificate: Path | None,
    key: Path | None,
    socket: Path | None,
    config: Path | None,
    loopback_role: str | None,
) -> WebSettings:
    from daemon.config.config import read_config
    from daemon.config.sections import WebSection
    from daemon.web.access import Role
    from daemon.web.settings import WebSettings

    settings = None if config is None else read_config(config)
    section = WebSection() if settings is None else settings.web
    at = socket_of(socket, config)
    return WebSettings(
        socket=at,
        tokens=at.with_name("web-tokens.json") if settings is None else settings.tokens_path,
        host=section.host if host is None else host,
        port=section.port if port is None else port,
        certificate=certificate or section.certificate,
        key=key or section.key,
        names=section.names,
        loopback_role=None if loopback_role is None else Role.named(loopback_role),
    )
