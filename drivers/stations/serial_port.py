"""Wrapper of pyserial: every failure of a port becomes a LinkError that states what to do."""

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

# Exceptions that escape from pyserial. flush and tcsetattr raise termios.error, which is not an OSError; a port that is
# closed or unplugged during a call raises TypeError or ValueError (its descriptor is None or -1).
_FAILURES = (serial.SerialException, OSError, termios.error, ValueError, TypeError)


class SerialConfig(Settings):
    """Settings of a serial port.

    Attributes:
        path: device, preferably a udev link that names the adapter (`/dev/rigcal-station`).
        baud: baud rate in bit/s, the same as set on the instrument.
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
    """An open serial port, for use by one thread: the thread that reads also writes and closes.

    Opening discards data that the port received before, because its time is unknown. The port is locked against other
    programs by flock and TIOCEXCL. A pseudo-terminal always has eight bits and neither parity nor stop bits (Linux
    answers EINVAL to other settings), so these settings are ignored for one.

    Args:
        config: settings of the port.
        link: name of the link, for error messages.
        write_timeout_s: real seconds after which a write fails if the device does not accept the data.

    Raises:
        LinkError: the port cannot be opened.
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
        """Return the port's non-blocking descriptor."""
        return int(self._port.fileno())

    def read(self, timeout_s: float) -> bytes:
        """Return the received bytes; wait up to `timeout_s` real seconds for the first. Empty after the timeout.

        Raises:
            LinkError: the device was lost.
        """
        with self._failing("reading failed"):
            ready, _, _ = select.select([self._port.fileno()], [], [], timeout_s)
            return self._port.read(max(1, self._port.in_waiting)) if ready else b""

    def write(self, data: bytes) -> None:
        """Write all of `data` to the device.

        Raises:
            LinkError: the device was lost, or did not accept the bytes in time.
        """
        with self._failing("writing failed"):
            self._port.write(data)

    def close(self) -> None:
        """Close the port; does nothing if it is closed. Only the thread that reads may call this."""
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
    """Return True if `path`, after following links, is the slave of a Linux pseudo-terminal."""
    return os.path.realpath(path).startswith("/dev/pts/")


def forbid_other_openers(descriptor: int) -> None:
    """Make further open() calls on the terminal fail with EBUSY (root excepted) until its last descriptor is closed.

    Do not use it on pseudo-terminals: the master keeps the lock, so a killed process would leave the terminal locked.
    """
    fcntl.ioctl(descriptor, termios.TIOCEXCL)


def _why_not_opened(error: Exception, config: SerialConfig) -> str:
    code = getattr(error, "errno", None)
    match code:
        case errno.ENOENT | errno.ENXIO | errno.ENODEV | errno.EIO:
            return "no such port: plug in the adapter, or correct the path"
        case errno.EACCES | errno.EPERM:
            return "permission denied: add this user to group dialout and log in again"
        case errno.EBUSY | errno.EAGAIN:
            holder = _holder(config.path)
            return f"in use by {holder}: stop it" if holder else "in use by another program: stop that program"
    settings = f"{config.baud} baud, {config.bytesize} data bits, parity {config.parity}, {config.stopbits} stop bits"
    return f"not a serial port, or {settings} not supported ({error}): correct the path or the settings"


def _holder(path: str) -> str:
    """Return the process that has `path` open; empty if this user can see none."""
    device = os.path.realpath(path)
    for entry in glob.iglob("/proc/[0-9]*/fd/*"):
        try:
            if os.readlink(entry) == device:
                process = Path(entry).parts[2]
                name = Path("/proc", process, "comm").read_text(encoding="utf-8", errors="replace").strip()
                return f"process {process} ({name})"
        except OSError:
            continue  # the process has ended or belongs to a different user
    return ""
