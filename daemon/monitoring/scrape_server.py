"""The web server of the metrics: a caller who does not go on takes nothing that the daemon needs."""

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

IDLE_S = 5.0  # that a connection may say nothing, or take nothing
LONGEST_S = 30.0  # from a connection to the end of its answer: a byte now and then keeps no place
MOST_AT_ONCE = 16  # connections, each of which has a descriptor and a thread
WAIT_S = 1.0  # for the end of one of them
PAUSE_S = 0.2  # after a caller who could not be taken: what that lacks will be lacking a moment longer


class _Handler(WSGIRequestHandler):
    """Logs no request, and hangs up on a caller who does not go on."""

    timeout = IDLE_S

    def log_message(self, *_arguments: Any) -> None:
        pass


class ScrapeServer(ThreadingMixIn, WSGIServer):
    """Serves a registry, a bounded number of callers at once; what comes beyond waits a little and is hung up on.

    Args:
        host, port: to listen on.
        registry: what is served.

    Attributes:
        trouble: why a caller was not taken since the registry was served last, a clause; None where all were.

    Raises:
        OSError: the port cannot be opened.
    """

    daemon_threads = True
    request_queue_size = MOST_AT_ONCE  # beyond it a caller's system waits a second before it asks again

    def __init__(self, host: str, port: int, registry: CollectorRegistry) -> None:
        self.trouble: str | None = None
        self._places = threading.BoundedSemaphore(MOST_AT_ONCE)
        self._turn = threading.Lock()  # of connections: one that is closed may be another's descriptor at once
        self._open: dict[socket.socket, TimeBudget] = {}
        self._app = make_wsgi_app(registry)
        super().__init__((host, port), _Handler)
        self.set_app(self._serve)

    def get_request(self) -> tuple[socket.socket, Any]:
        """Take a caller; one who cannot be taken goes on waiting, and nobody asks for him without a pause."""
        try:
            return super().get_request()
        except OSError as error:
            if not isinstance(error, ConnectionError):  # which is a caller who has gone
                self.trouble = f"a caller cannot be taken: {error.strerror}"
                time.sleep(PAUSE_S)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._places.acquire(timeout=WAIT_S):
            self._turn_away(request, f"{MOST_AT_ONCE} callers, as many as are served at once, do not go on")
            return
        with self._turn:
            self._open[request] = TimeBudget(LONGEST_S)
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # the system has no thread to give
            self._places.release()
            self._turn_away(request, "the computer has no thread left for a caller")

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
        """Hang up on callers whose time is over; called several times a second."""
        with self._turn:
            for request, left in self._open.items():
                if left.is_over:
                    with contextlib.suppress(OSError):  # the caller has gone
                        request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a caller who has gone, or does not go on."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)

    def _serve(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        self.trouble = None
        answer: Iterable[bytes] = self._app(environ, start_response)
        return answer

    def _turn_away(self, request: Any, why: str) -> None:
        self.trouble = why
        self.shutdown_request(request)
