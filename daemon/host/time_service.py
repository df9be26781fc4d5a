"""State of the computer's clock, as its time service and its kernel report it: read, never set.

The kernel reports whether a time service (chrony, systemd-timesyncd, ntpd) synchronises the clock, and its greatest
possible error. chrony also reports the present offset. A service's sandbox may forbid both; then a unit that systemd
starts for each connection (`rigcal-clock@.service`) reads them, with this module as its program.

Sources: adjtimex(2); chronyc(1), tracking; ntp_adjtime(3).
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import json
import os
import socket
import subprocess
import sys
from dataclasses import asdict, dataclass
from typing import Any

CLOCK_SOCKET = "RIGCAL_CLOCK_SOCKET"  # environment variable: where systemd listens for questions about the clock
_STA_PLL, _STA_UNSYNC, _STA_NANO = 0x0001, 0x0040, 0x2000
_TIMEOUT_S = 10.0
_CHRONYC = ("chronyc", "-n", "-c", "tracking")
_CHRONYC_S = 3.0
_ITSELF = "7F7F0101"  # reference id of a computer that serves its own unsynchronised time (`local`)
_SYSTEM_TIME, _ROOT_DELAY, _ROOT_DISPERSION, _LEAP_STATUS = 4, 10, 11, 13  # fields of chronyc's line


@dataclass(frozen=True)
class ClockState:
    """State of the computer's clock.

    Attributes:
        is_synchronized: whether a time service synchronises the clock; None where unknown.
        offset_s: by how much the clock is ahead of the time service's estimate; None where unknown.
        max_error_s: greatest error that the clock may have; None where it is not synchronised, or unknown.
        source: source of the state: `chrony`, `kernel`, or "" where there is none.
        error: why there is no source; "" where there is one.
    """

    is_synchronized: bool | None
    offset_s: float | None = None
    max_error_s: float | None = None
    source: str = ""
    error: str = ""


class _Timex(ctypes.Structure):
    """`struct timex` of adjtimex(2)."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        *((name, ctypes.c_long) for name in ("offset", "freq", "maxerror", "esterror")),
        ("status", ctypes.c_int),
        *((name, ctypes.c_long) for name in ("constant", "precision", "tolerance", "sec", "usec", "tick")),
        *((name, ctypes.c_long) for name in ("ppsfreq", "jitter")),
        ("shift", ctypes.c_int),
        *((name, ctypes.c_long) for name in ("stabil", "jitcnt", "calcnt", "errcnt", "stbcnt")),
        ("tai", ctypes.c_int),
        ("reserved", ctypes.c_int * 11),
    )


def clock_state(socket_path: str | None = None) -> ClockState:
    """Return the state of the clock.

    Args:
        socket_path: socket to read the state from if the sandbox forbids the system call.
    """
    try:
        state = _of_kernel()
    except OSError as error:
        if socket_path is None or error.errno != errno.EPERM:
            return ClockState(None, error=f"adjtimex: {error.strerror}")
        return _asked(socket_path)
    return _of_chrony(state)


def _of_kernel() -> ClockState:
    libc = ctypes.CDLL(None, use_errno=True)
    timex = _Timex()  # modes 0: read only
    if libc.adjtimex(ctypes.byref(timex)) < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    if timex.status & _STA_UNSYNC:
        return ClockState(False, source="kernel")
    # The offset is the part still to be slewed by the kernel; a service that slews by itself leaves 0 here.
    is_slewed = bool(timex.status & _STA_PLL)
    unit_s = 1e-9 if timex.status & _STA_NANO else 1e-6
    offset_s = 0.0 - timex.offset * unit_s if is_slewed else None  # the kernel adds timex.offset to the clock
    return ClockState(True, offset_s, timex.maxerror * 1e-6, "kernel")


def _of_chrony(kernel: ClockState) -> ClockState:
    """Return the state reported by chrony where it runs, otherwise the kernel's."""
    try:
        done = subprocess.run(_CHRONYC, capture_output=True, text=True, timeout=_CHRONYC_S, check=True)
        return parse_tracking(done.stdout)
    except (OSError, subprocess.SubprocessError, ValueError, IndexError):
        return kernel


def parse_tracking(line: str) -> ClockState:
    """Parse the line that `chronyc -c tracking` prints.

    Raises:
        ValueError, IndexError: the line has a different form.
    """
    fields = line.strip().split(",")
    if fields[_LEAP_STATUS] == "Not synchronised" or fields[0] == _ITSELF:
        return ClockState(False, source="chrony")
    offset_s = 0.0 - float(fields[_SYSTEM_TIME])  # chrony reports the correction: positive where the clock is slow
    max_error_s = abs(offset_s) + float(fields[_ROOT_DISPERSION]) + float(fields[_ROOT_DELAY]) / 2
    return ClockState(True, offset_s, max_error_s, "chrony")


def _asked(path: str) -> ClockState:
    """Return the state reported by the process that systemd starts for a connection."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.settimeout(_TIMEOUT_S)
            connection.connect(path)
            with connection.makefile("rb") as answer:
                told: dict[str, Any] = json.loads(answer.read(4096))
        return ClockState(**told)
    except OSError as error:
        return ClockState(None, error=f"{path}: {error.strerror or error}")
    except (ValueError, TypeError):
        return ClockState(None, error=f"{path}: no answer; see `journalctl -u 'rigcal-clock@*'`")


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        sys.stdout.write(json.dumps(asdict(clock_state())) + "\n")
