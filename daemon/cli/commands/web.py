"""`rigcal web`: the operator's page, and the tokens that let people in."""

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
@click.option("--host", help="Address to serve at.  [default: 127.0.0.1, or as [web] says]")
@click.option("--port", type=click.IntRange(0, 65535), help="Port; 0: any that is free.  [default: 8370]")
@click.option("--certificate", type=_FILE, help="PEM file; needed wherever other computers reach the page.")
@click.option("--key", type=_FILE, help="PEM file of the certificate's key.")
@click.option("--socket", type=click.Path(path_type=Path, readable=False), help="Control socket of the daemon.")
@click.option("--config", type=_CONFIG, help="Configuration of the daemon; its [web] says where to serve.")
@click.option(
    "--loopback-role",
    type=_ROLES,
    help="Most that anyone may do who opens the page on this computer without a token.  [default: what you may do]",
)
def web(**options: Any) -> None:
    """Serve the operator's page until stopped; `rigcal web token` lets people in from elsewhere.

    On a loopback address the page needs no token: who opens it may do what the user may who started it. Any other
    address needs TLS, and everybody a token (docs/how-to/operator-page.md).
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
    """Tokens: who may open the page, and what they may do there."""


def _token_options(command: Callable[..., Any]) -> Callable[..., Any]:
    return config_option(json_option(command))


@token.command(cls=Command, name="add")
@click.argument("name")
@click.option("--role", type=_ROLES, required=True, help="read: look; operate: measure; approve: put models live, too.")
@_token_options
def token_add(name: str, role: str, config: Path, *, as_json: bool) -> dict[str, str]:
    """Make a token for NAME and print it: it is shown this once, and only its hash is kept."""
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
    """Remove the token of NAME: whoever uses it is refused from now on."""
    _tokens(config).remove(name)
    if not as_json:
        echo(f"the token of {name} counts no more")
    return {"removed": name}


@token.command(cls=Command, name="list")
@_token_options
def token_list(config: Path, *, as_json: bool) -> dict[str, Any]:
    """List whose tokens there are, with their roles."""
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
