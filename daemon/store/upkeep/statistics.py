"""Size and contents of a store, and the share of it that may be deleted."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path
from typing import Any

from daemon.store.files import database_files
from daemon.store.reader import Reader

# Each figure uses an index or a small table.
_FACTS = """SELECT (SELECT count(*) FROM raw_chunks) AS chunks, (SELECT count(*) FROM small_chunks) AS small_chunks,
    (SELECT count(*) FROM undecoded_chunks) AS undecoded_chunks,
    (SELECT count(*) FROM calibration_sessions) AS sessions, (SELECT count(*) FROM boots) AS boots"""
_OLDEST = """SELECT first_utc_ns FROM raw_chunks ORDER BY last_boot_id, last_monotonic_ns LIMIT 1"""
_NEWEST = """SELECT last_utc_ns FROM raw_chunks ORDER BY last_boot_id DESC, last_monotonic_ns DESC LIMIT 1"""
_TABLES = "SELECT name, pgsize AS bytes FROM dbstat WHERE aggregate = TRUE ORDER BY pgsize DESC, name"


def statistics(path: Path, *, tables: bool = False) -> dict[str, Any]:
    """Return figures of a store; the daemon may write to it meanwhile.

    Args:
        path: the database.
        tables: also return the size of each table and index, for which the whole file is read.

    Returns:
        `file_bytes` (with the write-ahead log), `free_inside_bytes` (free pages, which are used again),
        `disk_free_bytes`, `chunks`, `small_chunks`, `undecoded_chunks`, `sessions`, `boots`, `oldest_utc_ns`,
        `newest_utc_ns`, and `tables`, name -> bytes, None if this SQLite cannot report sizes.

    Raises:
        StoreError: there is no store.
    """
    with Reader(path) as reader:
        found: dict[str, Any] = dict(next(reader.rows(_FACTS)))
        for key, sql in (("oldest_utc_ns", _OLDEST), ("newest_utc_ns", _NEWEST)):
            found[key] = next((next(iter(row.values())) for row in reader.rows(sql)), None)
        pages = [next(reader.rows(f"PRAGMA {name}"))[name] for name in ("freelist_count", "page_size")]
        sizes = None
        if tables:
            try:
                sizes = {row["name"]: row["bytes"] for row in reader.rows(_TABLES)}
            except sqlite3.OperationalError:  # built without dbstat
                sizes = None
    files = database_files(path)
    return {
        "store": str(path),
        "file_bytes": sum(file.stat().st_size for file in files if file.exists()),
        "free_inside_bytes": pages[0] * pages[1],
        "disk_free_bytes": shutil.disk_usage(path.parent).free,
        **found,
        **({"tables": sizes} if tables else {}),
    }
