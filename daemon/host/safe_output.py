"""Output of the process: text that is safe to show, JSON that any parser reads, and files written atomically."""

from __future__ import annotations

import errno
import json
import math
import os
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import Any

MOST_CHARACTERS = 4000
# Control, format (bidirectional overrides among them), surrogate, private and unassigned characters, line and paragraph
# separators: invisible, or able to move the cursor, to reorder text, or to begin a line.
_UNSAFE = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})


def shown(text: object, most: int = MOST_CHARACTERS) -> str:
    """Return `text` on one line, with unsafe characters escaped as in Python, cut off after `most` characters."""
    text = str(text)
    if len(text) > most:
        text = f"{text[:most]}..."
    if text.isprintable():
        return text
    return "".join(
        c.encode("unicode_escape").decode("ascii") if unicodedata.category(c) in _UNSAFE else c for c in text
    )


def shown_lines(text: str) -> str:
    """Return a text of several lines with each line made safe to show."""
    return "\n".join(shown(line) for line in text.split("\n"))


def duration(seconds: float) -> str:
    """Return a duration in readable form: `40 s`, `12 min`, `3.2 h`, `5 days`."""
    seconds = max(seconds, 0.0)
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    if seconds < 172_800:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86_400:.0f} days"


def json_line(result: Mapping[str, Any]) -> str:
    """Return a JSON object on one line; numbers that JSON cannot represent (NaN, infinity) become null."""
    return json.dumps(_finite(result), allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return value


def write_file(path: Path, data: bytes) -> None:
    """Write a file atomically: to a temporary file in its directory, flushed to disk, then renamed.

    Args:
        path: the file; if it is a symbolic link, the link's target is written.
        data: its new content.

    Raises:
        OSError: `path` is not a regular file (a device, a pipe, a directory), its directory is missing, or the file
            system refuses.
    """
    path = path.resolve()
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "is not a regular file; name a different one", str(path))
    if not path.parent.is_dir():
        raise OSError(errno.ENOENT, "its directory does not exist; create it, or name a different one", str(path))
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with scratch.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        scratch.replace(path)
    except OSError as error:
        error.filename = str(path)  # a write of data names no file
        raise
    finally:
        scratch.unlink(missing_ok=True)
