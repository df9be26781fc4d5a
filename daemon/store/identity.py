"""Which file lies at a path: a name can come to mean another file while a program has the first one open."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

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
        return cls(path, tuple(FileIdentity.of(_beside(path, suffix)) for suffix in BESIDE))

    @property
    def database(self) -> FileIdentity | None:
        """The database itself."""
        return self.identities[0]

    def changed(self) -> tuple[Path, bool] | None:
        """The first file that is not the one that was opened, and whether another lies in its place.

        Raises:
            OSError: the file system does not tell.
        """
        for suffix, opened in zip(BESIDE, self.identities, strict=True):
            path = _beside(self.path, suffix)
            now = FileIdentity.of(path)
            if opened is not None and now != opened:
                return path, now is not None
        return None


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)
