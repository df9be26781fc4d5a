"""Settings of the page's server, checked before anything listens."""

from __future__ import annotations

import getpass
import ipaddress
import os
import socket
from dataclasses import dataclass, field
from pathlib import Path

from daemon.commands import CommandError, reading_socket
from daemon.web.access import Role

_LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")


@dataclass(frozen=True)
class WebSettings:
    """Settings of the page's server: addresses, certificate, tokens.

    Attributes:
        socket: the daemon's control socket.
        tokens: file of the tokens.
        host, port: address to listen on; port 0 for any free port.
        certificate, key: PEM files for TLS; None without TLS.
        names: additional names by which browsers may address this computer.
        loopback_role: highest role of a person on the loopback interface without a token; by default limited only by
            the rights of this process.
        user: user of this process.
    """

    socket: Path
    tokens: Path
    host: str = "127.0.0.1"
    port: int = 8370
    certificate: Path | None = None
    key: Path | None = None
    names: tuple[str, ...] = ()
    loopback_role: Role | None = None
    user: str = field(default_factory=getpass.getuser)

    def check(self) -> None:
        """Raise CommandError if the page must not be served with these settings."""
        for path in (self.certificate, self.key):
            if path is not None and not os.access(path, os.R_OK):
                raise CommandError(f"{path}: cannot be read; TLS needs certificate and key as PEM files")
        if (self.certificate is None) != (self.key is None):
            raise CommandError("TLS needs both: --certificate FILE and --key FILE")
        if self.is_loopback:
            return
        if self.certificate is None:
            raise CommandError(
                f"{self.host} can be reached from other computers: use TLS (--certificate and --key), or listen on "
                "127.0.0.1"
            )

    @property
    def is_loopback(self) -> bool:
        """True if no other computer can reach the page."""
        if self.host in _LOOPBACK_NAMES:
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    @property
    def is_secure(self) -> bool:
        """True with TLS."""
        return self.certificate is not None

    def is_own_host(self, name: str) -> bool:
        """Return True if browsers may address this computer by a name (the Host header, without its port).

        This excludes a name that an attacker's server resolves to this computer (DNS rebinding).
        """
        name = name.strip("[]").lower()
        if self.is_loopback:
            return name in _LOOPBACK_NAMES or name == self.host
        try:
            ipaddress.ip_address(name)
        except ValueError:
            own = socket.gethostname().lower()
            return name in {*_LOOPBACK_NAMES, own, f"{own.partition('.')[0]}.local", *map(str.lower, self.names)}
        return True

    def role_without_token(self) -> Role | None:
        """Return the role of a person without a token; None for no access.

        On the loopback interface the page grants its own rights: all if this process may use the control socket, read
        access if it may use only the read-only socket.
        """
        if not self.is_loopback:
            return None
        own = Role.APPROVE if _may_use(self.socket) else Role.READ
        return own if self.loopback_role is None else min(own, self.loopback_role)


def _may_use(path: Path) -> bool:
    """Return True unless the socket exists and this process may not connect to it, or only the read-only one exists."""
    if path.exists():
        return os.access(path, os.W_OK)
    return not reading_socket(path).exists()
