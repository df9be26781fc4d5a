"""A format of tables, and what several formats need: types of the columns, batches of rows, names of files."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Row = Mapping[str, Any]
Tables = Mapping[str, Iterable[Row]]

WHOLE = {"id", "boot_id", "monotonic_ns"}  # columns of integers
_BATCH = 50_000  # rows held in memory at once
_LABELS = {"prism", "time", "joint", "status", "station", "lock", "reason"}


@dataclass(frozen=True)
class TableFormat:
    """One format.

    Attributes:
        name: value of `--format`.
        write: writes tables, by their names, and returns the files. Its second argument is the path of the table
            `observations` without its ending; `table_file` gives those of the others.
    """

    name: str
    write: Callable[[Tables, Path], list[Path]]


@functools.cache
def is_text(column: str) -> bool:
    """Return True if a column has texts instead of numbers."""
    from calibration.table import LABEL_COLUMNS

    return column in _LABELS or column in LABEL_COLUMNS


def batches(rows: Iterable[Row]) -> Iterator[list[Row]]:
    """Yield rows in lists of limited length."""
    source = iter(rows)
    while batch := list(itertools.islice(source, _BATCH)):
        yield batch


def table_file(base: Path, name: str, ending: str) -> Path:
    """Return the file of a table; that of the observations has the name of the session."""
    return base.with_name(base.name + ("" if name == "observations" else f"-{name}") + f".{ending}")
