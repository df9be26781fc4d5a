"""Errors of the store, and their messages."""

from __future__ import annotations

import contextlib
import errno
import os
import pwd
import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_READ_ONLY = {errno.EROFS}
_NO_PLACE = {errno.ENOENT, errno.ENOTDIR, errno.EACCES, errno.EPERM}

# Errors of a busy computer that temporarily lacks a resource.
LACKING = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM, errno.EAGAIN})
NOTHING_BYTES = 2**20  # a disk with less free space than this counts as full
_UNWRITABLE = {
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_NOMEM,
}


class StoreError(Exception):
    """The store cannot be opened or used; the message names the file and what to do."""


class NotInStoreError(StoreError):
    """There is no row of the requested name or number; the message names the command that lists the rows."""


class DamagedChunkError(StoreError):
    """A chunk of captures is damaged.

    Attributes:
        what: how, without the advice to restore the store, as the chunk may be in a backup.
    """

    def __init__(self, what: str) -> None:
        super().__init__(f"{what}; restore the store from a backup")
        self.what = what


class StoreBusyError(StoreError):
    """Another process writes to this store.

    Attributes:
        pid: process id of that process; None if it could not be read.
    """

    def __init__(self, path: str, pid: int | None) -> None:
        holder = f"process {pid}" if pid is not None else "another process"
        super().__init__(
            f"{path}: {holder} has this store open for writing; stop it first (`rigcal status` shows it), or configure "
            "a different file"
        )
        self.pid = pid


def is_unwritable(error: BaseException) -> bool:
    """Return True if a write failed for a passing reason: disk, memory or a lock. The transaction was rolled back."""
    code = getattr(error, "sqlite_errorcode", None) if isinstance(error, sqlite3.Error) else None
    return code is not None and code & 0xFF in _UNWRITABLE  # the low byte; the other bytes give the operation


def is_damage(error: BaseException) -> bool:
    """Return True if the error shows that the database file is damaged."""
    code = getattr(error, "sqlite_errorcode", None) if isinstance(error, sqlite3.Error) else None
    return code is not None and code & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


def storage_sentence(path: Path, error: sqlite3.Error | OSError) -> str:
    """Return one sentence that states the failure of the disk or SQLite with a file, and what to do about it.

    Args:
        path: path of the store; for an OSError that names a file, that file is named instead.
        error: the error.
    """
    if isinstance(error, OSError):
        path, reason, code = Path(error.filename or path), error.strerror or str(error), error.errno
        name = ""
    else:
        reason, code = str(error), None
        name = getattr(error, "sqlite_errorname", "") or ""  # the module's own errors have none
    place = _existing(path.parent)
    free_bytes = _free_bytes(place)
    free = "free space is unknown" if free_bytes is None else f"{free_bytes / 2**20:.0f} MiB free in {place}"
    # On a full disk SQLite reports an I/O error if the index of the write-ahead log cannot grow.
    is_full = name.startswith("SQLITE_IOERR") and free_bytes is not None and free_bytes < NOTHING_BYTES
    if is_full or code in _FULL or name == "SQLITE_FULL":
        return (
            f"{path}: cannot be written, the disk is full ({reason}; {free}): delete files there that are not "
            "rigcal's, or move the state directory to a larger disk"
        )
    if code in _READ_ONLY or name.startswith("SQLITE_READONLY"):
        return (
            f"{path}: cannot be written ({reason}): {place} or the file is read-only; mount it for writing (`dmesg` "
            f"shows whether the kernel found a disk fault) and let user {_user()} write to it"
        )
    if code in _NO_PLACE or name.startswith("SQLITE_CANTOPEN") or name == "SQLITE_PERM":
        return (
            f"{path}: cannot be created or opened ({reason}): the directory must exist, and user {_user()} must be "
            "allowed to write to it"
        )
    if name.startswith(("SQLITE_CORRUPT", "SQLITE_NOTADB")):
        return (
            f"{path}: cannot be used as a store ({reason}): move it away and restore the store from a backup, or use "
            "another backup if this is one"
        )
    if name.startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
        return f"{path}: locked by another program ({reason}): end that program (a `sqlite3` shell, a backup)"
    return f"{path}: cannot be used ({reason}; {free}): check the disk; `dmesg` may show the fault"


@contextlib.contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Convert errors of disk and SQLite into a StoreError that states what to do.

    Args:
        path: path of the store.

    Raises:
        StoreError: in place of sqlite3.Error and OSError.
    """
    try:
        yield
    except (sqlite3.Error, OSError) as error:
        raise StoreError(storage_sentence(path, error)) from error


@contextlib.contextmanager
def unwritable_errors(path: Path) -> Iterator[None]:
    """Convert passing write errors into a StoreError that states what to do before the command is repeated.

    Args:
        path: path of the store.

    Raises:
        StoreError: in place of a sqlite3.Error that `is_unwritable`.
    """
    try:
        yield
    except sqlite3.Error as error:
        if not is_unwritable(error):
            raise
        raise StoreError(
            f"{storage_sentence(path, error)}; nothing was changed, so repeat the command afterwards"
        ) from error


def _existing(directory: Path) -> Path:
    """Return the directory, or its nearest accessible parent."""
    return next((place for place in (directory, *directory.parents) if os.access(place, os.F_OK)), Path("/"))


def _free_bytes(directory: Path) -> int | None:
    try:
        return shutil.disk_usage(directory).free
    except OSError:
        return None


def _user() -> str:
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return str(os.getuid())
