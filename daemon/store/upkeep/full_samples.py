"""Complete readings and fixes of a stretch of time: those left out by thinning are decoded again from raw captures."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

from daemon.store.errors import StoreError
from daemon.store.reader import Reader
from daemon.store.store import Store
from drivers.clock import Stamp
from drivers.readings import Fix, Reading

_SAMPLES = """SELECT {0}.id, channels.name, unit, monotonic_ns, value FROM {0} JOIN channels ON channels.id = channel_id
    WHERE boot_id = ? AND monotonic_ns BETWEEN ? AND ?"""
_FIXES = "SELECT monotonic_ns FROM fixes WHERE station = ? AND boot_id = ? AND monotonic_ns BETWEEN ? AND ?"
_SESSION = "SELECT * FROM calibration_sessions WHERE id = ?"
# With min() or max() SQLite takes the other columns from the row of the smallest or largest value.
_OF_CHUNKS = """WITH chunks AS (SELECT first_boot_id AS boot_id, first_monotonic_ns, first_utc_ns, last_monotonic_ns,
        last_utc_ns FROM raw_chunks WHERE {}),
    firsts AS (SELECT boot_id, min(first_monotonic_ns) AS first_ns, first_utc_ns FROM chunks GROUP BY boot_id),
    lasts AS (SELECT boot_id, max(last_monotonic_ns) AS last_ns, last_utc_ns FROM chunks GROUP BY boot_id)
    SELECT boot_id, first_ns, first_utc_ns, last_ns, last_utc_ns FROM firsts JOIN lasts USING (boot_id)
    ORDER BY boot_id"""
# There is no index by the wall clock; for this rare query every chunk's row is read, without its captures.
_STRETCHES = _OF_CHUNKS.format("last_utc_ns >= ? AND first_utc_ns <= ?")
_BETWEEN = _OF_CHUNKS.format(
    "(last_boot_id, last_monotonic_ns) >= (?, ?) AND (first_boot_id, first_monotonic_ns) <= (?, ?)"
)

Stretch = tuple[Stamp, Stamp]


def put_again(store: Store, records: Sequence[Reading | Fix], *, may_differ: bool = False) -> int:
    """Store readings and fixes of one boot that were decoded again.

    A reading replaces the stored reading of its channel and instant. A stored fix is kept, because observations refer
    to it.

    Args:
        store: the database, open for writing.
        records: records of a short stretch of time.
        may_differ: a stored value may differ from the new one.

    Returns:
        Number of readings and fixes added.

    Raises:
        StoreError: a stored value differs although it may not, so it was made with a different rig file; none of the
            records is stored.
    """
    if not records:
        return 0
    with store.transaction() as db:
        boot = store.boot_row(records[0].stamp)
        instants = [record.stamp.monotonic_ns for record in records]
        span = boot, min(instants), max(instants)
        added = 0
        readings = [record for record in records if isinstance(record, Reading)]
        values: defaultdict[tuple[str, str, int], list[float | None]] = defaultdict(list)  # frames may share an instant
        for r in readings:
            values[r.channel, r.unit, r.stamp.monotonic_ns].append(r.value)
        for table in ("joint_samples", "signals"):
            stored = store.rows(_SAMPLES.format(table), span)
            again = [row for row in stored if (row["name"], row["unit"], row["monotonic_ns"]) in values]
            if not may_differ:
                for row in again:
                    _require_the_same(store, row, values[row["name"], row["unit"], row["monotonic_ns"]])
            db.conn.executemany(f"DELETE FROM {table} WHERE id = ?", [(row["id"],) for row in again])
            added -= len(again)
        fixes: defaultdict[str, list[Fix]] = defaultdict(list)
        for record in records:
            if isinstance(record, Fix):
                fixes[record.station].append(record)
        new: list[Reading | Fix] = list(readings)
        for station, own in fixes.items():
            known = {row["monotonic_ns"] for row in store.rows(_FIXES, (station, *span))}
            new += [fix for fix in own if fix.stamp.monotonic_ns not in known]
        store.insert_records(new)
    return added + len(new)


def _require_the_same(store: Store, row: Mapping[str, Any], values: Sequence[float | None]) -> None:
    was, now = row["value"], [value for value in values if value is not None]
    if was is not None and now and not any(math.isclose(was, value, rel_tol=1e-9, abs_tol=1e-9) for value in now):
        raise StoreError(
            f"{store.path}: {row['name']} was {was:.10g} {row['unit']} and would now be {now[0]:.10g}: its readings "
            "were made with a different rig file; use that file"
        )


def stretches_of_session(reader: Reader, session_id: str) -> list[Stretch]:
    """Return the stretches of captures in a session, one per boot; none if there is no such session."""
    for row in reader.rows(_SESSION, (session_id,)):
        since = reader.stamp(row, "started_")
        until = reader.stamp(row, "ended_") if row["ended_utc_ns"] is not None else None
        first = row["started_boot_id"], since.monotonic_ns
        last = (2**63 - 1, 0) if until is None else (row["ended_boot_id"], until.monotonic_ns)
        return _stretches(reader, _BETWEEN, (*first, *last), since, until)
    return []


def stretches_between(reader: Reader, first_utc_ns: int, last_utc_ns: int) -> list[Stretch]:
    """Return the stretches of captures between two instants of the wall clock, one per boot."""
    return _stretches(reader, _STRETCHES, (first_utc_ns, last_utc_ns), None, None)


def _stretches(
    reader: Reader, sql: str, parameters: Sequence[int], since: Stamp | None, until: Stamp | None
) -> list[Stretch]:
    boots = reader.boots()
    found = []
    for row in reader.rows(sql, parameters):
        boot = boots[row["boot_id"]]
        first = Stamp(row["first_utc_ns"], row["first_ns"], boot)
        last = Stamp(row["last_utc_ns"], row["last_ns"], boot)
        if since is not None and since.boot_id == boot and since.monotonic_ns > first.monotonic_ns:
            first = since
        if until is not None and until.boot_id == boot and until.monotonic_ns < last.monotonic_ns:
            last = until
        found.append((first, last))
    return found
