"""The canned queries on a large store: `python -m tests.bench.store_queries [--samples 1e8] [--keep DIRECTORY]`.

Makes the store of `year_store`, or takes the one that a directory has, and runs each of the ten queries that Datasette
is given, for the first, the middle and the last session. `--dense` stores every reading outside sessions too, as if
nothing had been left out: that many rows in the tables. Exit status 1: a query takes longer than a second.
"""

from __future__ import annotations

import argparse
import contextlib
import sqlite3
import sys
from pathlib import Path

from sqlite_utils import Database

from daemon.store.queries.canned_queries import canned_queries
from daemon.store.views import channels_of
from tests.bench import year_store
from tests.bench.year_store import QUERY_S, Bars


def rows(db: sqlite3.Connection, sql: str, session: str) -> int:
    """Return how many rows a query has."""
    return sum(1 for _ in db.execute(sql, {"session": session}))


def measure(path: Path) -> bool:
    """Print how long each query takes; returns whether all bars are held."""
    bars = Bars()
    with contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as db:
        for table in ("joint_samples", "signals", "fixes", "observations", "raw_chunks"):
            found = db.execute(f"SELECT max(id) FROM {table}").fetchone()
            print(f"  {table:14s} {found[0] or 0:>12,} rows")
        names = [name for (name,) in db.execute("SELECT id FROM calibration_sessions ORDER BY rowid")]
        for query in canned_queries(channels_of(Database(db))):
            chosen = [names[0], names[len(names) // 2], names[-1]] if query.parameters else names[:1]
            for name in chosen:
                count = rows(db, query.sql, name)
                what = f"{query.name} {name if query.parameters else ''} ({count} rows)"
                bars.took(what, QUERY_S, rows, db, query.sql, name)
    return bars.are_held


def main() -> int:
    """Make the store and print how long each query takes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=float, default=1e8)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--dense", action="store_true", help="a row for each sample, outside sessions too")
    parser.add_argument("--keep", type=Path, help="directory of the store, which stays and is measured again")
    options = parser.parse_args()
    with year_store.scratch(options.keep) as directory:
        path = directory / "rigcal.sqlite"
        if not path.exists():
            year_store.build(path, options.samples, options.seed, is_dense=options.dense)
        print(f"the store has {path.stat().st_size / 2**30:.2f} GiB")
        return int(not measure(path))


if __name__ == "__main__":
    sys.exit(main())
