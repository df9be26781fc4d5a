"""Reading of external files with bounded memory."""

from __future__ import annotations

import errno
import io
from collections.abc import Iterator
from pathlib import Path
from typing import IO, AnyStr

LINE_MAX = 1 << 20  # enough for a serial capture of half a megabyte in hexadecimal


def read_whole(path: Path, most_bytes: int) -> bytes:
    """Read the bytes of a file.

    Raises:
        OSError: the file cannot be read, or (EFBIG) is larger than `most_bytes`; `strerror` is the reason.
    """
    with path.open("rb") as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise OSError(errno.EFBIG, f"it is larger than the limit of {most_bytes:,} bytes for such a file", str(path))
    return data


def read_text(path: Path, most_bytes: int) -> str:
    """Read the text of a UTF-8 file, with all line ends converted to a newline.

    Raises:
        OSError: see `read_whole`.
        UnicodeDecodeError: the file is not UTF-8.
    """
    return io.TextIOWrapper(io.BytesIO(read_whole(path, most_bytes)), encoding="utf-8").read()


def bounded_lines(file: IO[AnyStr], most: int = LINE_MAX) -> Iterator[AnyStr]:
    """Yield the lines of an open file.

    Args:
        file: text or binary file.
        most: longest line, in characters or bytes.

    Raises:
        OSError: the file cannot be read, or (EFBIG) has a longer line than `most`; `strerror` is the reason.
    """
    number = 0
    while line := file.readline(most + 1):
        number += 1
        if len(line) > most:
            raise OSError(errno.EFBIG, f"line {number} is longer than the limit of {most:,} characters")
        yield line
