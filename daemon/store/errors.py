"""What can go wrong with the store."""

from __future__ import annotations

import sqlite3

_UNWRITABLE = {sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN}


def is_unwritable(error: BaseException) -> bool:
    """True if the disk refused: it is full, faulty or read-only. The transaction was rolled back."""
    code = getattr(error, "sqlite_errorcode", None) if isinstance(error, sqlite3.Error) else None
    return code is not None and code & 0xFF in _UNWRITABLE  # the low byte; the rest says which read or write it was


class StoreError(Exception):
    """The store cannot be opened or used; the message names the file and what to do."""


class StoreBusyError(StoreError):
    """Another process writes to this store.

    Attributes:
        pid: that process, where it could be read.
    """

    def __init__(self, path: str, pid: int | None) -> None:
        holder = f"process {pid}" if pid is not None else "another process"
        super().__init__(
            f"{path}: {holder} holds this store; stop it first (`rigcal status` shows it), or configure another file"
        )
        self.pid = pid
