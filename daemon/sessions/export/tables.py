"""A stored session as tables for other programs: observations, joint readings and fixes, as CSV, Parquet or MAT."""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import Rig, parse_rig
from calibration.table import LABEL_COLUMNS
from daemon.commands import CommandError
from daemon.sessions.export.captured_logs import ended_session
from daemon.sessions.session_data import sessions_csv
from daemon.store.queries.sessions import fixes_measured, joints_measured
from daemon.store.reader import Reader

Row = Mapping[str, Any]
Tables = Mapping[str, Iterable[Row]]

_BATCH = 50_000  # rows held in memory at once
_TEXT = {"prism", *LABEL_COLUMNS, "time", "joint", "status", "station", "lock", "reason"}  # columns without numbers
_WHOLE = {"id", "boot_id", "monotonic_ns"}


def export_tables(store: Path, session_id: str, out: Path, form: str) -> list[Path]:
    """Write a session's observations, joint readings and fixes.

    Observations have the columns of the observations CSV; only those that calibration may use are written. Readings and
    fixes have the columns of the views `v_joints` and `v_fixes` (docs/reference/schema.md); all from the session's
    start to its end are written.

    Args:
        store: the database.
        session_id: a session that has ended.
        out: directory, created if needed.
        form: a key of TABLE_FORMATS.

    Returns:
        The files: `<session>.csv`, `<session>-joints.csv` and `<session>-fixes.csv`, the same with `.parquet`, or one
        `<session>.mat` with three structures. A table without rows is left out.

    Raises:
        CommandError: there is no such session, it is still open or not decoded, or the library that writes the format
            is not installed.
        StoreError: there is no store, or it cannot be read.
    """
    with Reader(store) as reader:
        found = ended_session(reader, session_id)
        rig = parse_rig(found["rig_text"], "the session's rig")
        out.mkdir(parents=True, exist_ok=True)
        tables = {
            "observations": _observations(reader, rig, session_id),
            "joints": joints_measured(reader, session_id),
            "fixes": fixes_measured(reader, session_id),
        }
        return TABLE_FORMATS[form](tables, out / session_id)


def _observations(reader: Reader, rig: Rig, session_id: str) -> Iterator[Row]:
    """Yield the rows of the observations CSV, with numbers converted to float."""
    text = sessions_csv(reader, rig, [session_id]).decode()
    for row in csv.DictReader(io.StringIO(text)):
        yield {name: _cell(name, value) for name, value in row.items()}


def _cell(name: str, value: str) -> object:
    if value == "":
        return None
    return value if name in _TEXT else float(value)


def _write_csv(tables: Tables, base: Path) -> list[Path]:
    files = []
    for name, rows in tables.items():
        path = _file(base, name, "csv")
        for i, batch in enumerate(_batches(rows)):
            with path.open("a" if i else "w", encoding="utf-8", newline="") as stream:
                writer = csv.DictWriter(stream, list(batch[0]), lineterminator="\n")
                if not i:
                    writer.writeheader()
                    files.append(path)
                writer.writerows(batch)
    return files


def _write_parquet(tables: Tables, base: Path) -> list[Path]:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise CommandError("Parquet needs pyarrow: `pip install 'rigcal[parquet]'`, or use --format csv") from error
    files = []
    for name, rows in tables.items():
        path = _file(base, name, "parquet")
        writer = None
        try:
            for batch in _batches(rows):
                columns = {column: [row[column] for row in batch] for column in batch[0]}
                if writer is None:
                    types = [(column, _arrow_type(pa, column)) for column in columns]
                    writer = pq.ParquetWriter(path, pa.schema(types))
                writer.write_table(pa.table(columns, schema=writer.schema))
        finally:
            if writer is not None:
                writer.close()
        if writer is not None:
            files.append(path)
    return files


def _arrow_type(pa: Any, column: str) -> Any:
    """Return a column's type by its name, because a batch may contain no value of it."""
    if column in _TEXT:
        return pa.string()
    return pa.int64() if column in _WHOLE else pa.float64()


def _write_mat(tables: Tables, base: Path) -> list[Path]:
    from scipy.io import savemat

    found = {name: _arrays(rows) for name, rows in tables.items()}
    path = base.with_name(f"{base.name}.mat")
    savemat(
        path, {name: columns for name, columns in found.items() if columns}, long_field_names=True, oned_as="column"
    )
    return [path]


def _arrays(rows: Iterable[Row]) -> dict[str, NDArray[Any]]:
    """Return the columns of rows; missing numbers are NaN, missing texts are ""."""
    parts: dict[str, list[NDArray[Any]]] = {}
    for batch in _batches(rows):
        for column in batch[0]:
            values = [row[column] for row in batch]
            if column in _TEXT:
                array: NDArray[Any] = np.array(["" if value is None else value for value in values])
            else:
                array = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
            parts.setdefault(column, []).append(array)
    return {column: np.concatenate(arrays) for column, arrays in parts.items()}


def _batches(rows: Iterable[Row]) -> Iterator[list[Row]]:
    source = iter(rows)
    while batch := list(itertools.islice(source, _BATCH)):
        yield batch


def _file(base: Path, name: str, ending: str) -> Path:
    return base.with_name(base.name + ("" if name == "observations" else f"-{name}") + f".{ending}")


TABLE_FORMATS: Mapping[str, Callable[[Tables, Path], list[Path]]] = {
    "csv": _write_csv,
    "parquet": _write_parquet,
    "mat": _write_mat,
}
