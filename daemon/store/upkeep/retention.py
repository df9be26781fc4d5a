"""Deletion of the oldest captures, readings and fixes that no session needs.

Data in a session, from a minute before it and from shortly after it are kept, and so are observations, gaps, jobs and
models. Of what a device has reported again and again, the last report of each kind is kept; other events are all kept.
Freed pages are used again; the file does not shrink.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass

from daemon.store.queries.device_states import DEVICES, STATES
from daemon.store.queries.sessions import AFTER_NS, BEFORE_NS
from daemon.store.rows import RowSource
from daemon.store.store import Store
from daemon.store.write_ahead_log import KEPT_BYTES, log_bytes
from drivers.canopen.supervision import VOIDS
from drivers.clock import NS_PER_S, Clock
from drivers.readings import EventKind

Place = tuple[int, int]  # row of a boot, and ns of its monotonic clock; places sort in order of time

FIRST: Place = (0, -(2**63))
LAST: Place = (2**63 - 1, 2**63 - 1)
NEWEST_KEPT_NS = 3600 * NS_PER_S  # a session that begins now needs the last minute, and people view the last hour
TRUE_SINCE_NS = 1_735_689_600 * NS_PER_S  # 2025: a clock that shows an earlier time is not set
STEP_CHUNKS = 20
LOOKED_AT = 200  # chunks read per step, of which the first ones are deleted
STEP_ROWS = 5000
LOW_SHARE = 0.1
_DAY_NS = 86_400 * NS_PER_S

_WINDOWS = """SELECT started_boot_id, started_monotonic_ns, ended_boot_id, ended_monotonic_ns FROM calibration_sessions
    ORDER BY started_boot_id, started_monotonic_ns"""
# In order of their ends, which are in the index. Chunks that wait to be decoded are kept.
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
_CLOCKS = (_CLOCK.format("DESC"), _CLOCK.format("ASC"))  # by the last and by the first capture of a boot
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
# All but the last of a device and kind, and of emergencies the last that voids values (see device_states). Alarms and
# warnings without a code are not the device's own.
_EVENTS = f"""DELETE FROM device_events WHERE id IN (SELECT id FROM device_events AS event
    WHERE device = ?6 AND kind = ?7 AND (boot_id, monotonic_ns) >= (?1, ?2) AND (boot_id, monotonic_ns) <= (?3, ?4)
        AND (kind NOT IN ('{EventKind.ALARM}', '{EventKind.WARNING}') OR code IS NOT NULL)
        AND EXISTS (SELECT 1 FROM device_events AS later WHERE device = ?6 AND kind = ?7 AND boot_id = event.boot_id
            AND (monotonic_ns, id) > (event.monotonic_ns, event.id) AND (boot_id, monotonic_ns) <= (?3, ?4)
            AND (later.code IS NOT NULL) >= (event.code IS NOT NULL)
            AND (later.text LIKE '%{VOIDS}') >= (event.text LIKE '%{VOIDS}'))
    LIMIT ?5)"""
REPEATED = (*STATES, EventKind.NMT_STATE)
"""Events that a faulty device may cause with each of its frames."""

SAMPLES = ("joint_samples", "signals", "decode_failures")


@dataclass(frozen=True)
class Room:
    """Free space for the store to grow.

    Attributes:
        disk_bytes: free space on its disk.
        inside_bytes: free pages in the store's file.
        log_bytes: space that the store's log takes while a reader keeps it from being emptied, and that no deletion
            frees; it becomes free once the reader ends and the log can be written to the database.
        least_bytes: smallest sum of these; below it the oldest data are deleted.
    """

    disk_bytes: int
    inside_bytes: int
    log_bytes: int
    least_bytes: int

    @property
    def is_short(self) -> bool:
        """True if data should be deleted."""
        return self.disk_bytes + self.inside_bytes + self.log_bytes < self.least_bytes


def room(store: Store, free_bytes: int) -> Room:
    """Return the free space of a store.

    Args:
        store: the store.
        free_bytes: free space wanted; a tenth of the disk is enough if that is less.

    Raises:
        OSError: the file system cannot be read.
    """
    disk = shutil.disk_usage(store.path.parent)
    inside = store.pragma("freelist_count") * store.pragma("page_size")
    log = max(0, log_bytes(store.path) - KEPT_BYTES)
    return Room(disk.free, inside, log, min(free_bytes, round(LOW_SHARE * disk.total)))


class Retention:
    """Deletion of data that no session needs, oldest first, in steps that block acquisition only for a moment.

    Args:
        store: the database, open for writing.
        clock: the computer's clock.
    """

    def __init__(self, store: Store, clock: Clock) -> None:
        self._store, self._clock = store, clock

    def delete_oldest(self, older_than_ns: int | None = None) -> int | None:
        """Delete the oldest data that may be deleted, in one step.

        Args:
            older_than_ns: UTC; delete only older data. None for no limit.

        Returns:
            UTC in ns of the newest deleted capture; None if nothing may be deleted.

        Raises:
            sqlite3.Error: the store cannot be read or written; each single deletion is atomic.
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
                # the next chunk whose clock was set shows how old they are
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
        """Return the UTC in ns of the oldest capture that may be deleted, by a clock that was set; None without one."""
        for begin, end in free_stretches(self._store):
            for shown_ns in (_ANY_NS, TRUE_SINCE_NS):
                for row in self._timed(self._store.rows(_CHUNKS, [*begin, *end, 1, shown_ns]), begin):
                    if row["last_utc_ns"] >= TRUE_SINCE_NS:
                        return int(row["last_utc_ns"])
        return None

    def aged_on(self) -> int:
        """Return the day, counted from 1970, on which records were last deleted by age; 0 if none were."""
        return self._store.pragma("user_version")

    def note_aged(self, day: int) -> None:
        """Store the day on which records are deleted by age, in the `user_version` of the file's header."""
        with self._store.transaction() as db:
            db.execute(f"PRAGMA user_version = {day:d}")

    def _timed(self, chunks: list[dict[str, int]], begin: Place) -> list[dict[str, int]]:
        """Return chunks with the latest plausible UTC of their capture; too early a UTC would delete young chunks.

        Candidates are a chunk's own UTC, the UTC computed by the monotonic clock from the first and from the last
        capture of its boot, and the latest UTC of the sessions before it. A UTC later than both the present one and
        that of the newest capture is wrong, unless it is the candidate nearest to them: then these two may be behind.

        Args:
            chunks: chunks of one stretch between sessions.
            begin: begin of the stretch.
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
        """Return the leading chunks that are old, and those between them whose clock was not set."""
        young = next((n for n, row in enumerate(chunks) if row["last_utc_ns"] >= than_ns), len(chunks))
        while young and chunks[young - 1]["last_utc_ns"] < TRUE_SINCE_NS:
            young -= 1  # perhaps as young as the chunk that follows
        return chunks[:young]

    def _delete(self, chunk_ids: list[int], begin: Place, end: Place) -> None:
        """Delete chunks after all rows decoded from them, so that the next step deletes the rest after a kill."""
        for table in SAMPLES:
            self._delete_rows(_ROWS.format(table), [*begin, *end, STEP_ROWS])
        for station in [row["name"] for row in self._store.rows(_STATIONS)]:
            self._delete_rows(_FIXES, [*begin, *end, STEP_ROWS, station])
        for device in [row["device"] for row in self._store.rows(DEVICES)]:
            for kind in REPEATED:
                self._delete_rows(_EVENTS, [*begin, *end, STEP_ROWS, device, kind.value])
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
    """Yield the stretches between sessions, oldest first, each as its begin and its end, the end excluded."""
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
    """Return the UTC before which data may be deleted; None if the computer's clock is not set.

    Args:
        now_utc_ns: present UTC.
        keep_days: days to keep.
    """
    return None if now_utc_ns < TRUE_SINCE_NS else now_utc_ns - round(keep_days * _DAY_NS)
