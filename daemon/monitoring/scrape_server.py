"""The web server of the metrics: a caller who does not go on takes nothing that the daemon needs."""

from __future__ import annotations

import sys
import threading
from socketserver import ThreadingMixIn
from typing import TYPE_CHECKING, Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import make_wsgi_app

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

IDLE_S = 5.0  # that a connection may say nothing, or take nothing
MOST_AT_ONCE = 16  # connections, each of which has a descriptor and a thread
WAIT_S = 1.0  # for the end of one of them


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

    Raises:
        OSError: the port cannot be opened.
    """

    daemon_threads = True

    def __init__(self, host: str, port: int, registry: CollectorRegistry) -> None:
        self._places = threading.BoundedSemaphore(MOST_AT_ONCE)
        super().__init__((host, port), _Handler)
        self.set_app(make_wsgi_app(registry))

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._places.acquire(timeout=WAIT_S):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a caller who has gone, or does not go on."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)
