"""The write-ahead log of a store, which grows as long as another program keeps reading the store.

SQLite writes the log's pages into the database and begins the log anew only when no reader needs an older state. A
transaction or a cursor that a program leaves open keeps the log, and all that is written from then on is added to it.
"""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path

from daemon.store.files import database_files

KEPT_BYTES = 64 * 2**20  # to which SQLite cuts the log when it begins anew
_READ_LOCKS = range(123, 128)  # bytes of the log's index that readers lock: WAL_READ_LOCK(0) to (4) of SQLite's wal.c
# A line of /proc/locks: `7: POSIX  ADVISORY  READ 1234 fd:01:5678 124 124`.
_LOCK = re.compile(r"\d+: POSIX +ADVISORY +READ +(?P<pid>\d+) +\w+:\w+:(?P<inode>\d+) +(?P<first>\d+) +\d+")


def log_bytes(database: Path) -> int:
    """Return the size of a store's log; 0 if there is none.

    Raises:
        OSError: the file system cannot be read.
    """
    with contextlib.suppress(FileNotFoundError):
        return database_files(database)[1].stat().st_size
    return 0


def reader_of(database: Path) -> str | None:
    """Return another process that is reading a store now, as `process 1234 (python3)`; None if none is found.

    The locks are found in /proc. The log's index is never opened for this: by closing it, a process would lose its own
    locks (fcntl(2)).
    """
    with contextlib.suppress(OSError):
        index = database_files(database)[2].stat().st_ino
        locks = map(_LOCK.match, Path("/proc/locks").read_text(encoding="ascii").splitlines())
        for lock in filter(None, locks):
            pid = int(lock["pid"])
            if int(lock["inode"]) == index and int(lock["first"]) in _READ_LOCKS and pid != os.getpid():
                return f"process {pid}{_name_of(pid)}"
    return None


def _name_of(pid: int) -> str:
    with contextlib.suppress(OSError):
        return f" ({Path(f'/proc/{pid}/comm').read_text(encoding='utf-8', errors='replace').strip()})"
    return ""
