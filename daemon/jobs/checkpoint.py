"""A file in which a long search keeps its findings, so that a killed command goes on where it was."""

from __future__ import annotations

import contextlib
from pathlib import Path
from types import TracebackType

from calibration.errors import CalibrationError
from daemon.host.safe_output import write_file


class FileCheckpoint:
    """`calibration.identification.search.checkpoint.Checkpoint` in a file that is there whole or not at all.

    A context manager that forgets it where the work is done or refused, which would end the same way again, and keeps
    it where the work was interrupted.

    Args:
        path: of the file; its directory is made where it is missing.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> FileCheckpoint:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None or issubclass(kind, CalibrationError):
            with contextlib.suppress(OSError):  # a refusal matters more than what it leaves behind
                self._path.unlink(missing_ok=True)

    def load(self) -> bytes | None:
        """Return the state that was saved last; None where there is nothing to read."""
        try:
            return self._path.read_bytes()
        except OSError:
            return None

    def save(self, state: bytes) -> None:
        """Keep a state in place of the one before; OSError where the file system refuses."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        write_file(self._path, state)
