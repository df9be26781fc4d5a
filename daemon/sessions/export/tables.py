"""A stored session as tables for other programs: observations, joint readings and fixes, as CSV, Parquet or MAT."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path

from calibration.rig.description import Rig, parse_rig
from daemon.sessions.export.captured_logs import ended_session
from daemon.sessions.export.table_format import Row, TableFormat, is_text
from daemon.sessions.session_data import sessions_csv
from daemon.store.queries.sessions import fixes_measured, joints_measured
from daemon.store.reader import Reader


def export_tables(store: Path, session_id: str, out: Path, form: TableFormat) -> list[Path]:
    """Write a session's observations, joint readings and fixes.

    Observations have the columns of the observations CSV; only those that calibration may use are written. Readings and
    fixes have the columns of the views `v_joints` and `v_fixes` (docs/reference/schema.md); all from the session's
    start to its end are written.

    Args:
        store: the database.
        session_id: a session that has ended.
        out: directory, created if needed.
        form: the format.

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
        return form.write(tables, out / session_id)


def _observations(reader: Reader, rig: Rig, session_id: str) -> Iterator[Row]:
    """Yield the rows of the observations CSV, with numbers converted to float."""
    text = sessions_csv(reader, rig, [session_id]).decode()
    for row in csv.DictReader(io.StringIO(text)):
        yield {name: _cell(name, value) for name, value in row.items()}


def _cell(name: str, value: str) -> object:
    if value == "":
        return None
    return value if is_text(name) else float(value)
