"""The files of a store: which they are, whatever they are called, and the lock of the one process that writes.

A name can come to mean another file while a program has the first one open. While a restore renames files, a note
beside the database says so: one that was killed leaves it, and nobody takes half a store for an empty one.
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

BESIDE = ("", "-wal", "-shm")  # a database in WAL mode is three files


@dataclass(frozen=True)
class FileIdentity:
    """A file, whatever it is called.

    Attributes:
        device, inode: as stat(2) has them.
    """

    device: int
    inode: int

    @classmethod
    def of(cls, path: Path) -> FileIdentity | None:
        """The file at `path`; None where there is none.

        Raises:
            OSError: the file system does not tell.
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
        path: of the database.
        identities: of the database, its write-ahead log and that log's index.
    """

    path: Path
    identities: tuple[FileIdentity | None, ...]

    @classmethod
    def of(cls, path: Path) -> StoreFiles:
        """The files of the store at `path`, which is open."""
        path = path.absolute()
        return cls(path, tuple(map(FileIdentity.of, database_files(path))))

    @property
    def database(self) -> FileIdentity | None:
        """The database itself."""
        return self.identities[0]

    def changed(self) -> tuple[Path, bool] | None:
        """The first file that is not the one that was opened, and whether another lies in its place.

        Raises:
            OSError: the file system does not tell.
        """
        for path, opened in zip(database_files(self.path), self.identities, strict=True):
            now = FileIdentity.of(path)
            if opened is not None and now != opened:
                return path, now is not None
        return None


@dataclass(frozen=True)
class RestoreNote:
    """A restore whose renames have begun and have not all been made.

    Attributes:
        backup: directory that is put in the store's place.
        aside: name of the directory beside the store that what was there is moved to.
        replaced: names of files and directories that are moved there.
    """

    backup: str
    aside: str
    replaced: tuple[str, ...]

    @classmethod
    def of(cls, database: Path) -> RestoreNote | None:
        """The note beside a database; None where no restore was cut off.

        Raises:
            StoreError: it cannot be read.
        """
        path = restore_note_path(database)
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            return cls(str(found["backup"]), str(found["aside"]), tuple(map(str, found["replaced"])))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise StoreError(f"{path}: the note of a restore that was cut off cannot be read ({error})") from error

    def write(self, database: Path) -> None:
        """Write the note beside a database, durably; OSError where the file system refuses."""
        write_file(restore_note_path(database), json.dumps(asdict(self)).encode() + b"\n")


def restore_note_path(database: Path) -> Path:
    """Return the path of the note that a restore keeps while it renames files."""
    return _beside(database, ".restoring")


def require_no_half_restore(database: Path) -> None:
    """Refuse a store of which a restore has put a part in place and no more.

    Raises:
        StoreError: a restore was cut off; the message says how to end it.
    """
    note = RestoreNote.of(database)
    if note is not None:
        raise StoreError(
            f"{database}: a restore of {note.backup} was cut off, so store and models are not whole; run `rigcal store "
            f"restore {note.backup}` again, with the same --config (what was replaced is kept in "
            f"{database.parent / note.aside})"
        )


class WriterLock:
    """The exclusive right to write to `database`; taken by the constructor.

    A lock file beside the database is held for the life of the process. The kernel drops the lock when the process
    ends, however it ends, so a stale file never needs to be removed.

    Raises:
        StoreBusyError: another process (or another store of this one) has it.
        StoreError: the lock file cannot be made or written.
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


def database_files(database: Path) -> list[Path]:
    """Return the files of a database: SQLite has the other two beside the file itself, whatever links lead to it."""
    return [database, *(_beside(database.resolve(), suffix) for suffix in BESIDE[1:])]


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)
