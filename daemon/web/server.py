"""Serves the page until it is stopped."""

from __future__ import annotations

import asyncio
import errno
import logging
import signal
import socket
from collections.abc import Callable

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from daemon.commands import FAILED, CommandError
from daemon.host.systemd import Notifier
from daemon.web.app import make_app
from daemon.web.live import STALLED_S
from daemon.web.settings import WebSettings

log = logging.getLogger(__name__)

CONNECTIONS = 200
KEEP_ALIVE_S = 15
REQUEST_S = 10.0  # limit for a whole request, which takes effect within twice that time
STOP_S = 2


class _Timed(H11Protocol):
    """A connection that is closed if no whole request arrives in time, so that silent clients block nobody."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override] # as in uvicorn
        super().connection_made(transport)
        self._seen = self.cycle
        self.loop.call_later(REQUEST_S, self._look)

    def _look(self) -> None:
        """Close the connection if the same request has been incomplete since the last check."""
        if self.conn.their_state in (h11.IDLE, h11.SEND_BODY) and self.cycle is self._seen:
            self.transport.close()
        if not self.transport.is_closing():
            self._seen = self.cycle
            self.loop.call_later(REQUEST_S, self._look)


def serve(settings: WebSettings, say: Callable[[str], None], notifier: Notifier) -> None:
    """Serve the page until SIGTERM or Ctrl-C.

    Args:
        settings: settings of the server.
        say: called with the page's address once it can be opened.
        notifier: connection to the service manager.

    Raises:
        CommandError: the page must not or cannot be served with these settings.
    """
    settings.check()
    listener = _listener(settings)
    config = uvicorn.Config(
        make_app(settings),
        http=_Timed,
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        lifespan="off",
        limit_concurrency=CONNECTIONS,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=STOP_S,
        h11_max_incomplete_event_size=16 << 10,
        ssl_certfile=settings.certificate,
        ssl_keyfile=settings.key,
    )
    try:
        config.load()
    except OSError as error:  # ssl.SSLError is one
        raise CommandError(f"{settings.certificate}, {settings.key}: not a certificate and its key: {error}") from error
    host, port = listener.getsockname()[:2]
    scheme = "https" if settings.is_secure else "http"
    say(f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}/")
    notifier.send("READY=1", f"STATUS=serving the page at {scheme}://{host}:{port}")
    # uvicorn stops on SIGTERM and raises the signal again afterwards, when the shutdown is complete.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    with listener:
        uvicorn.Server(config).run(sockets=[listener])


def _listener(settings: WebSettings) -> socket.socket:
    """Return the listening socket; the kernel closes the connection of a client that receives nothing for long."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        listener = socket.create_server((settings.host, settings.port), family=family, backlog=CONNECTIONS)
    except OSError as error:
        what = "another program listens there already" if error.errno == errno.EADDRINUSE else error.strerror
        raise CommandError(
            f"{settings.host} port {settings.port}: the page cannot be served there: {what}; choose a different --port",
            FAILED,
        ) from error
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(STALLED_S * 1000))
    return listener
