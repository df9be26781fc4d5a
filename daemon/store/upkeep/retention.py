"""Deletes the oldest of what may go: captures, readings and fixes that no session needs.

What lies in a session, a minute before it and a little after it, stays, and so do observations, events, gaps, jobs and
models. Pages that become free are used again; the file does not become smaller.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass

from daemon.store.queries.sessions import AFTER_NS, BEFORE_NS
from daemon.store.rows import RowSource
from daemon.store.store import Store
from drivers.clock import NS_PER_S, Clock

Place = tuple[int, int]  # row of a boot, and ns of its monotonic clock: in this order everything was measured

FIRST: Place = (0, -(2**63))
LAST: Place = (2**63 - 1, 2**63 - 1)
NEWEST_KEPT_NS = 3600 * NS_PER_S  # a session that begins now needs the last minute, and people look at the last hour
TRUE_SINCE_NS = 1_735_689_600 * NS_PER_S  # 2025: a clock that shows an earlier time is not set
STEP_CHUNKS = 20
LOOKED_AT = 200  # chunks, of which the first ones go
STEP_ROWS = 5000
LOW_SHARE = 0.1
_DAY_NS = 86_400 * NS_PER_S

_WINDOWS = """SELECT started_boot_id, started_monotonic_ns, ended_boot_id, ended_monotonic_ns FROM calibration_sessions
    ORDER BY started_boot_id, started_monotonic_ns"""
# In the order of their ends, which the index has. One that waits to be decoded stays.
_CHUNKS = """SELECT id, first_boot_id, first_monotonic_ns, last_boot_id, last_monotonic_ns, last_utc_ns FROM raw_chunks
    WHERE (last_boot_id, last_monotonic_ns) >= (?1, ?2) AND (last_boot_id, last_monotonic_ns) < (?3, ?4)
        AND (first_boot_id, first_monotonic_ns) >= (?1, ?2) AND last_utc_ns >= ?6
        AND id NOT IN (SELECT chunk_id FROM undecoded_chunks)
    ORDER BY last_boot_id, last_monotonic_ns LIMIT ?5"""
_ANY_NS = -(2**63)
_NEWEST = """SELECT last_boot_id, last_monotonic_ns FROM raw_chunks
    ORDER BY last_boot_id DESC, last_monotonic_ns DESC LIMIT 1"""
_CLOCK = """SELECT last_utc_ns - last_monotonic_ns AS ahead_ns FROM raw_chunks WHERE last_boot_id = ?
    ORDER BY last_monotonic_ns {} LIMIT 1"""
_CLOCKS = (_CLOCK.format("DESC"), _CLOCK.format("ASC"))  # as a boot's captures show it last, and first
_LATEST = """SELECT max(utc_ns) AS utc_ns FROM (
    SELECT started_utc_ns AS utc_ns FROM calibration_sessions WHERE (started_boot_id, started_monotonic_ns) < (?1, ?2)
    UNION ALL SELECT ended_utc_ns FROM calibration_sessions WHERE (ended_boot_id, ended_monotonic_ns) < (?1, ?2)
    ) WHERE utc_ns <= ?3"""
_ROWS = """DELETE FROM {0} WHERE id IN (SELECT id FROM {0}
    WHERE (boot_id, monotonic_ns) >= (?1, ?2) AND (boot_id, monotonic_ns) <= (?3, ?4) LIMIT ?5)"""
_FIXES = """DELETE FROM fixes WHERE id IN (SELECT id FROM fixes
    WHERE station = ?6 AND (boot_id, monotonic_ns) >= (?1, ?2) AND (boot_id, monotonic_ns) <= (?3, ?4)
        AND NOT EXISTS (SELECT 1 FROM observations WHERE fix_id = fixes.id) LIMIT ?5)"""
_STATIONS = """WITH RECURSIVE known(name) AS (SELECT min(station) FROM fixes
        UNION ALL SELECT (SELECT min(station) FROM fixes WHERE station > name) FROM known WHERE name IS NOT NULL)
    SELECT name FROM known WHERE name IS NOT NULL"""
SAMPLES = ("joint_samples", "signals", "decode_failures")


@dataclass(frozen=True)
class Room:
    """Room for the store to grow.

    Attributes:
        disk_bytes: free on its disk.
        inside_bytes: in pages of its own that are free.
        least_bytes: of both together; the oldest goes where there is less.
    """

    disk_bytes: int
    inside_bytes: int
    least_bytes: int

    @property
    def is_short(self) -> bool:
        """True if something should go."""
        return self.disk_bytes + self.inside_bytes < self.least_bytes


def room(store: Store, free_bytes: int) -> Room:
    """Return the room of a store.

    Args:
        store: on its disk.
        free_bytes: wanted; a tenth of the disk is enough where that is less.

    Raises:
        OSError: the file system does not tell.
    """
    disk = shutil.disk_usage(store.path.parent)
    inside = store.pragma("freelist_count") * store.pragma("page_size")
    return Room(disk.free, inside, min(free_bytes, round(LOW_SHARE * disk.total)))


class Retention:
    """Deletion of what may go, the oldest first, in steps that keep acquisition from the store for a moment.

    Args:
        store: open for writing.
        clock: of the computer.
    """

    def __init__(self, store: Store, clock: Clock) -> None:
        self._store, self._clock = store, clock

    def delete_oldest(self, older_than_ns: int | None = None) -> int | None:
        """Delete the oldest step of what may go.

        Args:
            older_than_ns: UTC; only what is older. None: everything that may go.

        Returns:
            UTC in ns of the newest capture that was deleted; None where nothing may go.

        Raises:
            sqlite3.Error: the store cannot be read or written; each single deletion is whole.
        """
        newest = self._store.rows(_NEWEST)
        if not newest:
            return None
        boot, at_ns = newest[0].values()
        limit = (boot, at_ns - NEWEST_KEPT_NS)
        for begin, end in free_stretches(self._store):
            if begin >= limit:
                return None
            span = [*begin, *min(end, limit)]
            found = self._timed(self._store.rows(_CHUNKS, [*span, LOOKED_AT, _ANY_NS]), begin)
            if older_than_ns is not None and all(row["last_utc_ns"] < TRUE_SINCE_NS for row in found):
                # the next one whose clock was set tells how old they are
                found += self._timed(self._store.rows(_CHUNKS, [*span, 1, TRUE_SINCE_NS]), begin)
            old = (found if older_than_ns is None else self._older(found, older_than_ns))[:STEP_CHUNKS]
            if old:
                last = old[-1]
                self._delete([row["id"] for row in old], begin, (last["last_boot_id"], last["last_monotonic_ns"]))
                return int(last["last_utc_ns"])
            if found:
                return None
        return None

    def oldest_ns(self) -> int | None:
        """UTC in ns of the oldest capture that may go, by a clock that was set; None where there is none."""
        for begin, end in free_stretches(self._store):
            for shown_ns in (_ANY_NS, TRUE_SINCE_NS):
                for row in self._timed(self._store.rows(_CHUNKS, [*begin, *end, 1, shown_ns]), begin):
                    if row["last_utc_ns"] >= TRUE_SINCE_NS:
                        return int(row["last_utc_ns"])
        return None

    def aged_on(self) -> int:
        """Day, counted from 1970, on which records last went by age; 0 where none did."""
        return self._store.pragma("user_version")

    def note_aged(self, day: int) -> None:
        """Note that records go by age on a day, in the number that the file's header has for its program."""
        with self._store.transaction() as db:
            db.execute(f"PRAGMA user_version = {day:d}")

    def _timed(self, chunks: list[dict[str, int]], begin: Place) -> list[dict[str, int]]:
        """Return chunks with the latest UTC that tells when they were captured; a wrong one would delete young ones.

        Their own, those by the monotonic clock from the first and the last capture of their boot, and the latest of the
        sessions before them tell it. A UTC after both the present one and that of the newest capture of all is wrong,
        unless it is the nearest to them: then these two may be behind.

        Args:
            chunks: of one stretch between sessions.
            begin: of the stretch.
        """
        if not chunks:
            return []
        newest_boot, at_ns = self._store.rows(_NEWEST)[0].values()
        ahead_ns = {
            boot: [self._store.rows(sql, [boot])[0]["ahead_ns"] for sql in _CLOCKS]
            for boot in {newest_boot, *(row["last_boot_id"] for row in chunks)}
        }
        newest_ns = max(at_ns + ahead_ns[newest_boot][0], self._clock.now().utc_ns)
        session_ns = self._store.rows(_LATEST, [*begin, newest_ns])[0]["utc_ns"] or _ANY_NS
        timed = []
        for row in chunks:
            shown = [row["last_utc_ns"], *(row["last_monotonic_ns"] + ns for ns in ahead_ns[row["last_boot_id"]])]
            nearest_ns = min(shown, key=lambda utc_ns: abs(utc_ns - newest_ns))
            possible = [utc_ns for utc_ns in shown if utc_ns <= max(newest_ns, nearest_ns)]
            timed.append({**row, "last_utc_ns": max(*possible, session_ns)})
        return timed

    @staticmethod
    def _older(chunks: list[dict[str, int]], than_ns: int) -> list[dict[str, int]]:
        """Return the first chunks that are old, and those between them whose clock was not set."""
        young = next((n for n, row in enumerate(chunks) if row["last_utc_ns"] >= than_ns), len(chunks))
        while young and chunks[young - 1]["last_utc_ns"] < TRUE_SINCE_NS:
            young -= 1  # as old as what follows them, perhaps
        return chunks[:young]

    def _delete(self, chunk_ids: list[int], begin: Place, end: Place) -> None:
        """Delete chunks, after all rows that were made of them: what a kill leaves, the next step deletes."""
        for table in SAMPLES:
            self._delete_rows(_ROWS.format(table), [*begin, *end, STEP_ROWS])
        for station in [row["name"] for row in self._store.rows(_STATIONS)]:
            self._delete_rows(_FIXES, [*begin, *end, STEP_ROWS, station])
        with self._store.transaction() as db:
            ids = [(number,) for number in chunk_ids]
            db.conn.executemany("DELETE FROM small_chunks WHERE chunk_id = ?", ids)
            db.conn.executemany("DELETE FROM raw_chunks WHERE id = ?", ids)

    def _delete_rows(self, sql: str, parameters: list[int | str]) -> None:
        deleted = STEP_ROWS
        while deleted == STEP_ROWS:
            with self._store.transaction() as db:
                deleted = db.execute(sql, parameters).rowcount


def free_stretches(source: RowSource) -> Iterator[tuple[Place, Place]]:
    """Yield the stretches between sessions, oldest first, each from its begin up to, and without, its end."""
    begin = FIRST
    for window in source.rows(_WINDOWS):
        boot, at_ns, end_boot, end_ns = window.values()
        start = boot, at_ns - BEFORE_NS
        if start > begin:
            yield begin, start
        if end_boot is None:
            return  # it is open
        begin = max(begin, (end_boot, end_ns + AFTER_NS))
    yield begin, LAST


def cutoff_ns(now_utc_ns: int, keep_days: float) -> int | None:
    """Return the UTC before which everything may go; None where the computer's clock is not set."""
    return None if now_utc_ns < TRUE_SINCE_NS else now_utc_ns - round(keep_days * _DAY_NS)
