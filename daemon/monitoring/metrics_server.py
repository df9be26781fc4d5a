"""Serves the metrics on the loopback interface, with the official Prometheus client."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from daemon.host.systemd import network_hint
from daemon.monitoring.metrics import FAMILIES, Status
from drivers.clock import NS_PER_S, SystemClock

if TYPE_CHECKING:
    from prometheus_client.metrics_core import Metric

    from daemon.monitoring.scrape_server import ScrapeServer

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
RETRY_S = 5.0
STOP_S = 5.0


class StatusCollector:
    """Converts the daemon's status to metrics at every scrape.

    Args:
        status: returns the status; called in the thread of a scrape.
    """

    def __init__(self, status: Callable[[], Status]) -> None:
        self._status = status

    def describe(self) -> list[Metric]:
        """Return nothing, so that the registry does not need the status to know the names."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield every family with its present samples."""
        from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily

        status = self._status()
        for family in FAMILIES:
            made = {"gauge": GaugeMetricFamily, "counter": CounterMetricFamily}[family.kind](
                family.name, family.help, labels=family.labels
            )
            for labels, value in family.samples(status):
                if value is not None:
                    made.add_metric(labels, value)
            yield made


class MetricsServer:
    """Serves `/metrics` on a port of the loopback interface; if the port is in use, it is retried.

    Args:
        port: to listen on; 0 for any free port.
        status: returns the daemon's status.
    """

    def __init__(self, port: int, status: Callable[[], Status]) -> None:
        from prometheus_client import CollectorRegistry, ProcessCollector

        self._wanted = port
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(StatusCollector(status))
        ProcessCollector(registry=self._registry)
        self._clock = SystemClock()  # retries are in real time
        self._next_ns = 0
        self._served: tuple[ScrapeServer, threading.Thread] | None = None
        self._trouble: str | None = None
        self.look()

    @property
    def port(self) -> int | None:
        """The port that is served; None while no port is open."""
        return None if self._served is None else self._served[0].server_port

    def trouble(self) -> str | None:
        """Return why the metrics cannot be read, a clause; None if they can."""
        if self._served is None:
            return self._trouble
        server, thread = self._served
        return server.trouble if thread.is_alive() else "the thread that serves the metrics has ended"

    def look(self) -> None:
        """Start to serve if that has not succeeded yet; to be called periodically."""
        now_ns = self._clock.monotonic_ns()
        if self._served is not None or now_ns < self._next_ns:
            return
        try:
            self._served = self._begun()
        except (OSError, RuntimeError) as error:  # RuntimeError: no thread can be started
            self._next_ns = now_ns + round(RETRY_S * NS_PER_S)
            was_told = self._trouble is not None
            reason = error.strerror if isinstance(error, OSError) else error
            self._trouble = f"metrics cannot be served at {HOST}:{self._wanted}: {reason}{network_hint(error)}"
            if not was_told:
                log.error("%s", self._trouble)
        else:
            self._trouble = None
            log.info("metrics are served at http://%s:%d/metrics", HOST, self.port)

    def _begun(self) -> tuple[ScrapeServer, threading.Thread]:
        from daemon.monitoring.scrape_server import ScrapeServer

        server = ScrapeServer(HOST, self._wanted, self._registry)
        thread = threading.Thread(target=server.serve_forever, name="metrics", daemon=True)
        try:
            thread.start()
        except RuntimeError:
            server.server_close()
            raise
        return server, thread

    def stop(self) -> None:
        """Stop serving."""
        if self._served is not None:
            server, thread = self._served
            server.shutdown()
            server.server_close()
            thread.join(STOP_S)
