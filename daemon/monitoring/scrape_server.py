"""The web server of the metrics: a stalled client uses up nothing that the daemon needs."""

from __future__ import annotations

import contextlib
import socket
import sys
import threading
import time
from collections.abc import Iterable
from socketserver import ThreadingMixIn
from typing import TYPE_CHECKING, Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import make_wsgi_app

from drivers.clock import TimeBudget

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

IDLE_S = 5.0  # longest time in which a connection neither sends nor receives
LONGEST_S = 30.0  # longest time from a connection to the end of its answer, against clients that send single bytes
MOST_AT_ONCE = 16  # connections, each with a descriptor and a thread
WAIT_S = 1.0  # wait for the end of a connection when there are MOST_AT_ONCE
PAUSE_S = 0.2  # after a connection could not be accepted: the missing resource will still be missing for a moment


class _Handler(WSGIRequestHandler):
    """Logs no requests, and disconnects a client that stalls."""

    timeout = IDLE_S

    def log_message(self, *_arguments: Any) -> None:
        pass


class ScrapeServer(ThreadingMixIn, WSGIServer):
    """Serves a registry to a bounded number of clients at once; clients beyond it wait briefly and are disconnected.

    Args:
        host, port: to listen on.
        registry: metrics to serve.

    Attributes:
        trouble: why a client was refused since the last successful request, a clause; None if none was.

    Raises:
        OSError: the port cannot be opened.
    """

    daemon_threads = True
    request_queue_size = MOST_AT_ONCE  # a client beyond this backlog retries after a second

    def __init__(self, host: str, port: int, registry: CollectorRegistry) -> None:
        self.trouble: str | None = None
        self._places = threading.BoundedSemaphore(MOST_AT_ONCE)
        self._turn = threading.Lock()  # guards connections: the descriptor of a closed connection may be reused at once
        self._open: dict[socket.socket, TimeBudget] = {}
        self._app = make_wsgi_app(registry)
        super().__init__((host, port), _Handler)
        self.set_app(self._serve)

    def get_request(self) -> tuple[socket.socket, Any]:
        """Accept a connection. On failure leave it pending and pause before the next attempt."""
        try:
            return super().get_request()
        except OSError as error:
            if not isinstance(error, ConnectionError):  # the client has disconnected
                self.trouble = f"a connection cannot be accepted: {error.strerror}"
                time.sleep(PAUSE_S)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._places.acquire(timeout=WAIT_S):
            self._turn_away(request, f"all {MOST_AT_ONCE} connections are taken by stalled clients")
            return
        with self._turn:
            self._open[request] = TimeBudget(LONGEST_S)
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # no thread can be started
            self._places.release()
            self._turn_away(request, "the computer has no thread left for a connection")

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def shutdown_request(self, request: Any) -> None:
        with self._turn:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Disconnect clients that exceed `LONGEST_S`; called several times a second."""
        with self._turn:
            for request, left in self._open.items():
                if left.is_over:
                    with contextlib.suppress(OSError):  # the client has disconnected
                        request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log no error about a client that has disconnected or stalls."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)

    def _serve(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        self.trouble = None
        answer: Iterable[bytes] = self._app(environ, start_response)
        return answer

    def _turn_away(self, request: Any, why: str) -> None:
        self.trouble = why
        self.shutdown_request(request)
