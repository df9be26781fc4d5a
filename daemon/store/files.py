"""The files of a store, identified independently of their names, and the lock of the one writing process.

A name may come to denote a different file while a program has the original file open. While a restore renames files,
there is a note beside the database; if the restore is killed, the note remains and marks the store as incomplete.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

from daemon.host.safe_output import write_file
from daemon.store.errors import StoreBusyError, StoreError, storage_errors

BESIDE = ("", "-wal", "-shm")  # a database in WAL mode consists of three files


@dataclass(frozen=True)
class FileIdentity:
    """Identity of a file, independent of its name.

    Attributes:
        device, inode: as in stat(2).
    """

    device: int
    inode: int

    @classmethod
    def of(cls, path: Path) -> FileIdentity | None:
        """Return the identity of the file at `path`; None if there is no file.

        Raises:
            OSError: the file system cannot be read.
        """
        try:
            status = path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return None
        return cls(status.st_dev, status.st_ino)


@dataclass(frozen=True)
class StoreFiles:
    """The files of a store, as they were when it was opened.

    Attributes:
        path: path of the database.
        identities: identities of the database, its write-ahead log and the log's index.
    """

    path: Path
    identities: tuple[FileIdentity | None, ...]

    @classmethod
    def of(cls, path: Path) -> StoreFiles:
        """Return the files of the open store at `path`."""
        path = path.absolute()
        return cls(path, tuple(map(FileIdentity.of, database_files(path))))

    @property
    def database(self) -> FileIdentity | None:
        """The database itself."""
        return self.identities[0]

    def changed(self) -> tuple[Path, bool] | None:
        """Return the first file that is no longer the opened one, and whether a different file has replaced it.

        Raises:
            OSError: the file system cannot be read.
        """
        for path, opened in zip(database_files(self.path), self.identities, strict=True):
            now = FileIdentity.of(path)
            if opened is not None and now != opened:
                return path, now is not None
        return None


@dataclass(frozen=True)
class RestoreNote:
    """A restore that has begun to rename files and has not finished.

    Attributes:
        backup: directory of the backup that replaces the store.
        aside: name of the directory beside the store to which the replaced files are moved.
        replaced: names of the files and directories that are moved there.
    """

    backup: str
    aside: str
    replaced: tuple[str, ...]

    @classmethod
    def of(cls, database: Path) -> RestoreNote | None:
        """Return the note beside a database; None if no restore was interrupted.

        Raises:
            StoreError: the note cannot be read.
        """
        path = restore_note_path(database)
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            return cls(str(found["backup"]), str(found["aside"]), tuple(map(str, found["replaced"])))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise StoreError(f"{path}: the note of an interrupted restore cannot be read ({error})") from error

    def write(self, database: Path) -> None:
        """Write the note beside a database, durably.

        Raises:
            OSError: the file system refuses.
        """
        write_file(restore_note_path(database), json.dumps(asdict(self)).encode() + b"\n")


def restore_note_path(database: Path) -> Path:
    """Return the path of the note that exists while a restore renames files."""
    return _beside(database, ".restoring")


def require_no_half_restore(database: Path) -> None:
    """Refuse a store that was only partly restored.

    Raises:
        StoreError: a restore was interrupted; the message states how to complete it.
    """
    note = RestoreNote.of(database)
    if note is not None:
        raise StoreError(
            f"{database}: a restore of {note.backup} was interrupted, so store and models are incomplete; run `rigcal "
            f"store restore {note.backup}` again, with the same --config (replaced files are kept in "
            f"{database.parent / note.aside})"
        )


class WriterLock:
    """The exclusive right to write to `database`; acquired by the constructor.

    A lock file beside the database is locked until it is released or the process ends. The kernel then drops the lock
    in any case, so a stale file never needs to be removed.

    Raises:
        StoreBusyError: another process (or another store in this process) holds the lock.
        StoreError: the lock file cannot be created or written.
    """

    def __init__(self, database: Path) -> None:
        path = _beside(database.resolve(), ".lock")  # one lock, whatever links lead to the database
        with storage_errors(path):
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            text = os.pread(self._file, 32, 0).strip()
            os.close(self._file)
            raise StoreBusyError(str(database), int(text) if text.isdigit() else None) from None
        # The process id is only informative; on a full disk the lock works without it.
        with contextlib.suppress(OSError):
            os.ftruncate(self._file, 0)
            os.pwrite(self._file, f"{os.getpid()}\n".encode(), 0)

    def release(self) -> None:
        """Release the lock; harmless if it is released already."""
        if self._file >= 0:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, 0)
            os.close(self._file)
            self._file = -1


def database_files(database: Path) -> list[Path]:
    """Return the files of a database; SQLite puts the other two beside the file to which links lead."""
    return [database, *(_beside(database.resolve(), suffix) for suffix in BESIDE[1:])]


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)
