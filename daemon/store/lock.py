"""One writer per store: a lock file beside the database, held for the life of the process.

The kernel drops the lock when its process ends, however it ends, so a stale file never needs to be removed.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path

from daemon.store.errors import StoreBusyError, storage_errors


class WriterLock:
    """The exclusive right to write to `database`; taken by the constructor.

    Raises:
        StoreBusyError: another process (or another store of this one) has it.
        StoreError: the lock file cannot be made or written.
    """

    def __init__(self, database: Path) -> None:
        path = database.with_name(database.name + ".lock")
        with storage_errors(path):
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            text = os.pread(self._file, 32, 0).strip()
            os.close(self._file)
            raise StoreBusyError(str(database), int(text) if text.isdigit() else None) from None
        # Who holds it is for people; on a full disk the lock holds without.
        with contextlib.suppress(OSError):
            os.ftruncate(self._file, 0)
            os.pwrite(self._file, f"{os.getpid()}\n".encode(), 0)

    def release(self) -> None:
        """Give the right up; harmless when it was given up before."""
        if self._file >= 0:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, 0)
            os.close(self._file)
            self._file = -1
