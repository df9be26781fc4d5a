"""systemd's readiness and watchdog protocol (sd_notify(3)): a few datagrams, no library."""

from __future__ import annotations

import logging
import os
import socket
import weakref

from daemon.plain_text import shown

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
