"""Priorities of the daemon's work other than acquisition, which has the highest priority.

Source: setpriority(2); on Linux each thread has its own priority, and setting a process's sets its main thread's.
"""

from __future__ import annotations

import contextlib
import os
import threading

METER_NICE = 5  # a person waits for the meter's result
JOB_NICE = 10
UPKEEP_NICE = 15


def lower_priority(nice: int, pid: int | None = None) -> None:
    """Lower the priority of a process and of all that it starts later, or of the calling thread.

    Does nothing if the process has ended or the host forbids it; never raises a priority.

    Args:
        nice: from 0, the priority of acquisition, to 19, the lowest.
        pid: process id; only the calling thread by default.
    """
    task = threading.get_native_id() if pid is None else pid
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, task, max(nice, os.getpriority(os.PRIO_PROCESS, task)))
