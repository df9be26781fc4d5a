"""Adapter of pyserial: every failure of a port becomes a LinkError that says what to do."""

from __future__ import annotations

import errno
import fcntl
import glob
import os
import select
import termios
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import serial
from pydantic import Field

from drivers.errors import LinkError
from drivers.settings import Settings

_PARITY = {"none": serial.PARITY_NONE, "even": serial.PARITY_EVEN, "odd": serial.PARITY_ODD}

# What pyserial lets through. flush and tcsetattr raise termios.error, which is no OSError; a port closed or unplugged
# under a call raises TypeError or ValueError (its descriptor is None or -1).
_FAILURES = (serial.SerialException, OSError, termios.error, ValueError, TypeError)


class SerialConfig(Settings):
    """Settings of a serial port.

    Attributes:
        path: device, best a udev link that names the adapter (`/dev/rigcal-station`).
        baud: bit/s, as the instrument is set.
        bytesize: 7 or 8 data bits.
        parity: `none`, `even` or `odd`.
        stopbits: 1 or 2.
    """

    path: str = Field(min_length=1)
    baud: int = Field(default=9600, ge=50, le=4_000_000)
    bytesize: Literal[7, 8] = 8
    parity: Literal["none", "even", "odd"] = "none"
    stopbits: Literal[1, 2] = 1

    @property
    def character_s(self) -> float:
        """Seconds that one character takes on the wire: start bit, data, parity, stop bits."""
        return (1 + self.bytesize + (self.parity != "none") + self.stopbits) / self.baud


class SerialPort:
    """An open serial port, for one thread: the one that reads also writes and closes.

    Opening discards what the port had received before, as nothing tells when that was. The port is locked against
    other programs by flock and TIOCEXCL. A pseudo-terminal carries eight bits and has neither parity nor stop bits
    (Linux answers EINVAL to other settings), so there these settings are passed over.

    Args:
        config: how to open it.
        link: name of the link, for messages.
        write_timeout_s: real seconds after which a write that the device does not take fails.

    Raises:
        LinkError: it cannot be opened.
    """

    def __init__(self, config: SerialConfig, link: str, write_timeout_s: float = 5.0) -> None:
        self._path = config.path
        self._where = f"{link} ({config.path})"
        try:
            pseudo_terminal = is_pseudo_terminal(config.path)
            self._port = serial.Serial(
                config.path,
                baudrate=config.baud,
                bytesize=8 if pseudo_terminal else config.bytesize,
                parity=serial.PARITY_NONE if pseudo_terminal else _PARITY[config.parity],
                stopbits=1 if pseudo_terminal else config.stopbits,
                timeout=0,
                write_timeout=write_timeout_s,
                exclusive=True,
            )
        except _FAILURES as error:
            raise LinkError(self._where, _why_not_opened(error, config)) from error
        if not pseudo_terminal:
            with self._failing("locking failed"):
                forbid_other_openers(self._port.fileno())

    def fileno(self) -> int:
        """Return its descriptor, which does not block."""
        return int(self._port.fileno())

    def read(self, timeout_s: float) -> bytes:
        """Return the received bytes; wait up to `timeout_s` real seconds for the first. Empty when none came.

        Raises:
            LinkError: the device is gone.
        """
        with self._failing("reading failed"):
            ready, _, _ = select.select([self._port.fileno()], [], [], timeout_s)
            return self._port.read(max(1, self._port.in_waiting)) if ready else b""

    def write(self, data: bytes) -> None:
        """Hand all of `data` to the device.

        Raises:
            LinkError: the device is gone, or did not take the bytes in time.
        """
        with self._failing("writing failed"):
            self._port.write(data)

    def close(self) -> None:
        """Close the port; does nothing when it is closed. Only the thread that reads may call this."""
        with self._failing("closing failed"):
            self._port.close()

    @contextmanager
    def _failing(self, doing: str) -> Iterator[None]:
        try:
            yield
        except _FAILURES as error:
            raise LinkError(
                self._where, f"{doing} ({error}): check that the adapter is plugged in and the instrument connected"
            ) from error


def is_pseudo_terminal(path: str) -> bool:
    """Return True if `path`, links followed, is the slave of a Linux pseudo-terminal."""
    return os.path.realpath(path).startswith("/dev/pts/")


def forbid_other_openers(descriptor: int) -> None:
    """Make further open() calls on the terminal fail with EBUSY (root excepted) until its last descriptor is closed.

    Not for pseudo-terminals: theirs lives on in the master, and a killed process would leave it locked.
    """
    fcntl.ioctl(descriptor, termios.TIOCEXCL)


def _why_not_opened(error: Exception, config: SerialConfig) -> str:
    code = getattr(error, "errno", None)
    match code:
        case errno.ENOENT | errno.ENXIO | errno.ENODEV | errno.EIO:
            return "no such port: plug the adapter in, or correct the path"
        case errno.EACCES | errno.EPERM:
            return "permission denied: add this user to group dialout and log in again"
        case errno.EBUSY | errno.EAGAIN:
            holder = _holder(config.path)
            return f"in use by {holder}: stop it" if holder else "in use by another program: stop that program"
    settings = f"{config.baud} baud, {config.bytesize} data bits, parity {config.parity}, {config.stopbits} stop bits"
    return f"is no serial port, or does not take {settings} ({error}): correct the path or the settings"


def _holder(path: str) -> str:
    """Return the process that has `path` open, as far as this user may see it; empty if none is seen."""
    device = os.path.realpath(path)
    for entry in glob.iglob("/proc/[0-9]*/fd/*"):
        try:
            if os.readlink(entry) == device:
                process = Path(entry).parts[2]
                name = Path("/proc", process, "comm").read_text(encoding="utf-8", errors="replace").strip()
                return f"process {process} ({name})"
        except OSError:
            continue  # it ended meanwhile, or is another user's
    return ""
