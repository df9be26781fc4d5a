"""systemd's readiness and watchdog protocol (sd_notify(3)): a few datagrams, no library."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
import weakref
from collections.abc import Iterator

from daemon.plain_text import shown
from daemon.time_budget import TimeBudget

EXTEND_EVERY_S = 20.0
EXTEND_BY_S = 60
EXTEND_LIMIT_S = 1800.0  # a start that takes longer hangs

log = logging.getLogger(__name__)


class Notifier:
    """Tells systemd how the service is; does nothing when not started by systemd.

    Args:
        environ: where NOTIFY_SOCKET and WATCHDOG_USEC are looked up.
    """

    def __init__(self, environ: os._Environ[str] | dict[str, str] = os.environ) -> None:
        address = environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._is_heard = True
        if self._address:
            # Opened once: a beat must not need a descriptor when there are none left.
            self._channel = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            weakref.finalize(self, self._channel.close)
        usec = environ.get("WATCHDOG_USEC", "")
        own = environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.watchdog_s = int(usec) / 1e6 if usec.isdigit() and own else None

    def send(self, *states: str) -> None:
        """Send states such as `READY=1`, `STOPPING=1`, `WATCHDOG=1`, `STATUS=...`; one that is lost is logged."""
        if not self._address:
            return
        try:
            self._channel.sendto("\n".join(map(shown, states)).encode(), self._address)
        except OSError as error:
            if self._is_heard:
                log.warning("the service manager is not reached at %s: %s", self._address, error.strerror)
            self._is_heard = False
        else:
            self._is_heard = True

    @contextlib.contextmanager
    def extending(self, status: str) -> Iterator[None]:
        """While the block runs, systemd waits for READY beyond its TimeoutStartSec.

        A store that a new version brings up to date, or that a power cut left with a long log, takes its time to open.

        Args:
            status: what is being done, for `systemctl status`.
        """
        if not self._address:
            yield
            return
        done = threading.Event()

        def extend() -> None:
            limit = TimeBudget(EXTEND_LIMIT_S)
            while not limit.is_over:
                self.send(f"EXTEND_TIMEOUT_USEC={EXTEND_BY_S * 1_000_000}", f"STATUS={status}")
                if done.wait(EXTEND_EVERY_S):
                    return

        thread = threading.Thread(target=extend, name="start-time", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()
