"""A checkpoint file of a long search, from which a killed command resumes."""

from __future__ import annotations

import contextlib
from pathlib import Path
from types import TracebackType

from calibration.errors import CalibrationError
from daemon.host.safe_output import write_file


class FileCheckpoint:
    """`calibration.identification.search.checkpoint.Checkpoint` in a file that is replaced atomically.

    As a context manager it deletes the file when the work is done or refused with CalibrationError, which would recur,
    and keeps it when the work was interrupted.

    Args:
        path: of the file; a missing directory is created.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> FileCheckpoint:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None or issubclass(kind, CalibrationError):
            with contextlib.suppress(OSError):  # a leftover file must not hide the CalibrationError
                self._path.unlink(missing_ok=True)

    def load(self) -> bytes | None:
        """Return the state that was saved last; None if the file cannot be read."""
        try:
            return self._path.read_bytes()
        except OSError:
            return None

    def save(self, state: bytes) -> None:
        """Replace the saved state; OSError if the file cannot be written."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        write_file(self._path, state)
