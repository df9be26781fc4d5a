"""Priorities of what the daemon does beside acquisition, which comes before all of it.

Source: setpriority(2); on Linux a priority is a thread's, and that of a process is its main thread's.
"""

from __future__ import annotations

import contextlib
import os
import threading

METER_NICE = 5  # someone waits for what the meter says
JOB_NICE = 10
UPKEEP_NICE = 15


def lower_priority(nice: int, pid: int | None = None) -> None:
    """Lower the priority of a process, with all that it starts from then on, or of the thread that calls this.

    Does nothing where the process has ended or the host forbids it, and never raises a priority.

    Args:
        nice: from 0, the priority of acquisition, to 19, the lowest.
        pid: of the process; this thread alone by default.
    """
    task = threading.get_native_id() if pid is None else pid
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, task, max(nice, os.getpriority(os.PRIO_PROCESS, task)))
