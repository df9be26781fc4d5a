"""A pseudo-terminal behind a symbolic link: the serial port of a simulated device."""

from __future__ import annotations

import os
import pty
import termios
import tty
from pathlib import Path

_BACKLOG = 65536  # bytes kept for a host that does not read; more are lost, as on a real line


class Backlog:
    """Buffer for bytes that the host has not read yet.

    Attributes:
        lost: number of bytes lost because the buffer was full.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._waiting = bytearray()

    def write(self, descriptor: int, data: bytes) -> None:
        """Write as much as possible to a non-blocking descriptor, and keep the rest for the next call."""
        if not (data or self._waiting):
            return
        room = _BACKLOG - len(self._waiting)
        self.lost += max(0, len(data) - room)
        self._waiting += data[: max(0, room)]
        try:
            sent = os.write(descriptor, self._waiting)
        except BlockingIOError:
            return
        del self._waiting[:sent]

    def clear(self) -> None:
        """Discard all buffered bytes."""
        self._waiting.clear()


class PtyPort:
    """A port that can be unplugged.

    Attributes:
        path: the symbolic link.

    Args:
        path: path of the symbolic link; its directory must exist. An existing link is replaced.

    Raises:
        OSError: no pty is available, or the link cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._master = -1
        self._slave = -1
        self._backlog = Backlog()
        self.plug()

    @property
    def name(self) -> str:
        """Path of the symbolic link, for messages."""
        return str(self.path)

    @property
    def lost(self) -> int:
        """Number of bytes lost because no host read them."""
        return self._backlog.lost

    @property
    def plugged(self) -> bool:
        """True if the port exists."""
        return self._master >= 0

    def fileno(self) -> int:
        """Return the master's file descriptor, for `select`."""
        return self._master

    def plug(self) -> None:
        """Create the port; does nothing if it exists."""
        if self.plugged:
            return
        self._master, self._slave = pty.openpty()
        # The slave end stays open here, so that the port continues to exist when a host closes it
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        fresh = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        fresh.unlink(missing_ok=True)
        try:
            fresh.symlink_to(os.ttyname(self._slave))
            fresh.replace(self.path)
        except OSError:
            self._close()
            raise

    def unplug(self) -> None:
        """Remove the port's link and device; a host that has it open gets errors."""
        if not self.plugged:
            return
        if self.path.is_symlink() and os.readlink(self.path) == os.ttyname(self._slave):
            self.path.unlink()
        self._close()

    def _close(self) -> None:
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1
        self._backlog.clear()

    def read(self) -> bytes:
        """Return the bytes that the host wrote since the last call."""
        if not self.plugged:
            return b""
        try:
            return os.read(self._master, 4096)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> None:
        """Send bytes; never blocks."""
        if self.plugged:
            self._backlog.write(self._master, data)

    def discard(self) -> None:
        """Discard the bytes that the host has not read yet."""
        if self.plugged:
            self._backlog.clear()
            termios.tcflush(self._slave, termios.TCIFLUSH)
