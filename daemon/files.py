"""Files that are there whole or not at all."""

from __future__ import annotations

import errno
import os
from pathlib import Path


def write_file(path: Path, data: bytes) -> None:
    """Write a file whole or not at all: beside it, flushed to disk, renamed. A link's target is written.

    Raises:
        OSError: something that is no file has that name (a device, a pipe, a directory), or the file system refuses.
    """
    path = path.resolve()
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "is not a regular file; name another", str(path))
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with scratch.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        scratch.replace(path)
    finally:
        scratch.unlink(missing_ok=True)
