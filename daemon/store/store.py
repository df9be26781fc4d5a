"""The one connection that writes.

WAL with synchronous=FULL: what `transaction` has committed survives power loss. One connection writes and
checkpoints, because SQLite up to 3.51.2 can corrupt a WAL that two connections reset at once; readers
(`daemon.store.reader`) are read-only.
"""

from __future__ import annotations

import importlib.metadata
import logging
import os
import sqlite3
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

from sqlite_utils import Database

from daemon.store.captures import decode_captures, encode_captures
from daemon.store.errors import StoreError, is_damage, storage_sentence
from daemon.store.identity import StoreFiles
from daemon.store.lock import WriterLock
from daemon.store.migrations import MIGRATIONS, unknown_migrations
from daemon.store.reader import Reader
from daemon.store.rows import (
    EXCERPT_BYTES,
    FIX_COLUMNS,
    SqlRow,
    SqlValue,
    counted_failures,
    fix_row,
    sample_row,
    sql_value,
    stamp_of,
    stored_text,
)
from drivers.clock import Stamp
from drivers.readings import Capture, DecodeFailure, DeviceEvent, Fix, Gap, GapReason, Reading, Record

log = logging.getLogger(__name__)

T = TypeVar("T")
ChannelKind = Literal["joint", "signal"]

OLDEST_SQLITE = (3, 38, 0)  # STRICT tables (3.37) and JSON built in (3.38)
CLOSE_TIMEOUT_S = 5.0  # a thread that hangs in a commit keeps its turn for ever
WHOLE_DAEMON = "daemon"  # the channel of gaps in which rigcal itself was not there

_SAMPLE_COLUMNS = "(channel_id, utc_ns, monotonic_ns, boot_id, value, status, raw_counts) VALUES (?, ?, ?, ?, ?, ?, ?)"
_SAMPLES = {
    "joint": f"INSERT INTO joint_samples {_SAMPLE_COLUMNS}",
    "signal": f"INSERT INTO signals {_SAMPLE_COLUMNS}",
}
_FIXES = f"INSERT INTO fixes ({', '.join(FIX_COLUMNS)}) VALUES ({', '.join('?' * len(FIX_COLUMNS))})"
_EVENTS = (
    "INSERT INTO device_events (device, utc_ns, monotonic_ns, boot_id, kind, text, code) VALUES (?, ?, ?, ?, ?, ?, ?)"
)
_FAILURES = (
    "INSERT INTO decode_failures (device, utc_ns, monotonic_ns, boot_id, reason, excerpt, count) "
    "VALUES (?, ?, ?, ?, ?, ?, ?)"
)
# A gap is reported when it opens and again when it closes: the second report completes the first one's row.
_GAPS = """INSERT INTO gaps (channel, reason, start_utc_ns, start_monotonic_ns, start_boot_id,
        end_utc_ns, end_monotonic_ns, end_boot_id, missed) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)
    ON CONFLICT (channel, reason, start_boot_id, start_monotonic_ns) DO UPDATE SET
        end_utc_ns = excluded.end_utc_ns, end_monotonic_ns = excluded.end_monotonic_ns,
        end_boot_id = excluded.end_boot_id, missed = coalesce(excluded.missed, missed)"""
_CHUNKS = """INSERT INTO raw_chunks (link_id, first_utc_ns, first_monotonic_ns, first_boot_id,
    last_utc_ns, last_monotonic_ns, last_boot_id, captures, bytes, chunk) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"""

_UNDECODED = """SELECT chunk_id, captures FROM undecoded_chunks LEFT JOIN raw_chunks ON raw_chunks.id = chunk_id
    WHERE chunk_id > ? ORDER BY chunk_id"""


class Store:
    """A store opened for writing, exclusively, created or migrated as needed.

    May be used by several threads: transactions take turns.

    Args:
        path: the database; by convention it ends in `.sqlite`.

    Attributes:
        run_id: row of `daemon_runs`, 0 while no run has begun.
        begun: when the run began; None while none has.
        ended_in_order: whether the run before this one did; known once a run has begun, true before and without one.
        files: which files it is made of, as they were when it was opened.
        damage: what was found damaged while it was used; "" as long as nothing was.

    Raises:
        StoreBusyError: another process writes to it.
        StoreError: it is no such database, is damaged, was made by a newer rigcal, its directory cannot be used, or
            the disk is full.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if sqlite3.sqlite_version_info < OLDEST_SQLITE:
            wanted = ".".join(map(str, OLDEST_SQLITE))
            raise StoreError(f"SQLite {sqlite3.sqlite_version} is too old; rigcal needs {wanted} or newer")
        self._turn = threading.RLock()
        self._lock = WriterLock(path)
        try:
            # Transactions take turns under `_turn`, so the connection need not belong to one thread.
            connection = sqlite3.connect(path, check_same_thread=False)
            connection.text_factory = stored_text
            try:
                self._db = Database(connection)
                self._prepare(connection)
            except BaseException:
                connection.close()
                raise
        except sqlite3.Error as error:
            self._lock.release()
            raise StoreError(storage_sentence(path, error)) from error
        except BaseException:
            self._lock.release()
            raise
        self._boots: dict[str, int] = {}
        self._boot_ids: dict[int, str] = {}
        self._links: dict[str, int] = {}
        self._channels: dict[tuple[str, str], tuple[int, ChannelKind]] = {}
        self._joints: frozenset[str] = frozenset()
        self.run_id = 0
        self.begun: Stamp | None = None
        self.ended_in_order = True
        self.files = StoreFiles.of(path)
        self.damage = ""
        log.info("store %s open, SQLite %s", path, sqlite3.sqlite_version)

    def _prepare(self, connection: sqlite3.Connection) -> None:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("PRAGMA temp_store = MEMORY")  # what a statement may undo needs no file, hence no descriptor
        connection.execute("PRAGMA journal_size_limit = 67108864")  # a WAL grown behind a slow reader shrinks again
        if later := unknown_migrations(self._db):
            raise StoreError(f"{self.path}: made by a newer rigcal (it has {later[0]}); install that version")
        MIGRATIONS.apply(self._db)

    def close(self) -> None:
        """Close the database and let others write to it; harmless when it was closed before.

        Where a thread hangs in a commit, the database stays open and locked until the process ends.
        """
        if not self._turn.acquire(timeout=CLOSE_TIMEOUT_S):
            log.error("%s: a write does not end; the store is left open", self.path)
            return
        try:
            self._db.close()
            self._lock.release()
        finally:
            self._turn.release()

    # ---- transactions and rows -------------------------------------------------------------------------------------

    @contextmanager
    def transaction(self) -> Iterator[Database]:
        """A transaction: committed, durably, when the block ends, rolled back when it raises.

        Nested transactions are savepoints of the outermost one. Other threads wait for their turn.
        """
        with self._turn:
            try:
                with self._db.atomic() as db:
                    yield db
            except BaseException as error:
                self.note_damage(error)
                # Rows that the caches know may have been rolled back.
                self._boots.clear()
                self._boot_ids.clear()
                self._links.clear()
                self._channels.clear()
                raise

    def reader(self) -> Reader:
        """A read-only view of this very store, for what the writing connection must not wait for.

        Raises:
            StoreError: its file was replaced, moved or removed.
        """
        return Reader(self.path, self.files.database)

    def write(self, work: Callable[[Database], T]) -> T:
        """What `work` returns, its changes committed in one transaction."""
        with self.transaction() as db:
            return work(db)

    def insert(self, table: str, row: Mapping[str, object]) -> int:
        """Insert one row; numpy scalars, NaN, lists and mappings are made storable (`rows.sql_value`).

        Returns:
            its rowid.
        """
        names = ", ".join(f'"{name}"' for name in row)
        marks = ", ".join("?" * len(row))
        with self.transaction() as db:
            cursor = db.execute(f'INSERT INTO "{table}" ({names}) VALUES ({marks})', [*map(sql_value, row.values())])
            return _rowid(cursor)

    def update(self, table: str, where: Mapping[str, object], changes: Mapping[str, object]) -> int:
        """Change the rows whose columns equal `where`.

        Returns:
            how many there were.
        """
        settings = ", ".join(f'"{name}" = ?' for name in changes)
        conditions = " AND ".join(f'"{name}" IS ?' for name in where)
        values = [*map(sql_value, changes.values()), *map(sql_value, where.values())]
        with self.transaction() as db:
            return db.execute(f'UPDATE "{table}" SET {settings} WHERE {conditions}', values).rowcount

    def rows(self, sql: str, parameters: Sequence[object] = ()) -> list[dict[str, Any]]:
        """The rows of a query, on the writing connection: it sees the open transaction's own changes."""
        with self._turn:
            try:
                cursor = self._db.execute(sql, [*map(sql_value, parameters)])
                names = [column[0] for column in cursor.description]
                return [dict(zip(names, row, strict=True)) for row in cursor]
            except sqlite3.Error as error:
                self.note_damage(error)
                raise

    def note_damage(self, error: BaseException) -> None:
        """Remember what was raised where the store was used, if it tells that the store is damaged."""
        if is_damage(error):
            self.damage = self.damage or str(error)

    def _number(self, sql: str, parameters: Sequence[object]) -> int | None:
        """The integer in the first column of a query's first row; None where there is no row."""
        with self._turn:
            row = self._db.execute(sql, [*parameters]).fetchone()
        return None if row is None else int(row[0])

    def instant(self, stamp: Stamp, prefix: str = "") -> dict[str, SqlValue]:
        """The three columns of an instant, to be merged into a row: `<prefix>utc_ns`, ..."""
        return {
            f"{prefix}utc_ns": stamp.utc_ns,
            f"{prefix}monotonic_ns": stamp.monotonic_ns,
            f"{prefix}boot_id": self.boot_row(stamp),
        }

    def stamp(self, row: Mapping[str, object], prefix: str = "") -> Stamp | None:
        """The instant in a row's `<prefix>utc_ns`, ...; None where they are NULL."""
        if row[f"{prefix}utc_ns"] is None:
            return None
        with self._turn:
            if row[f"{prefix}boot_id"] not in self._boot_ids:
                self._boot_ids = {boot["id"]: boot["kernel_boot_id"] for boot in self.rows("SELECT * FROM boots")}
            return stamp_of(row, self._boot_ids, prefix)

    def boot_row(self, stamp: Stamp) -> int:
        """The row of `boots` that `stamp` belongs to, made on first sight."""
        row = self._boots.get(stamp.boot_id)
        if row is None:
            with self.transaction():
                row = self._number("SELECT id FROM boots WHERE kernel_boot_id = ?", [stamp.boot_id])
                if row is None:
                    booted = {"kernel_boot_id": stamp.boot_id, "booted_utc_ns": stamp.utc_ns - stamp.monotonic_ns}
                    row = self.insert("boots", booted)
                self._boots[stamp.boot_id] = row
        return row

    def order(self, stamp: Stamp) -> tuple[int, int]:
        """Where an instant lies among all that the store knows (`drivers.clock.Order`)."""
        return self.boot_row(stamp), stamp.monotonic_ns

    # ---- runs of the daemon ----------------------------------------------------------------------------------------

    def begin_run(self, now: Stamp) -> None:
        """A run of the daemon begins: the time since the last one ended is a gap, and ends all gaps left open."""
        with self.transaction() as db:
            before = self.rows("SELECT clean FROM daemon_runs ORDER BY id DESC LIMIT 1")
            self.ended_in_order = not before or bool(before[0]["clean"])
            last = self._last_alive()
            if last is not None:
                ended = self.instant(last, "end_")
                settings = ", ".join(f"{name} = ?" for name in ended)
                db.execute(f"UPDATE gaps SET {settings} WHERE end_utc_ns IS NULL", [*ended.values()])
                self.insert_records([Gap(WHOLE_DAEMON, GapReason.NOT_RUNNING, last, now)])
            run = {
                "pid": os.getpid(),
                "software_version": importlib.metadata.version("rigcal"),
                "sqlite_version": sqlite3.sqlite_version,
            }
            run_id = self.insert("daemon_runs", run | self.instant(now, "started_") | self.instant(now, "alive_"))
        self.run_id = run_id
        self.begun = now

    def _last_alive(self) -> Stamp | None:
        """When the last run was last known to be alive; None before the first."""
        runs = self.rows("SELECT * FROM daemon_runs ORDER BY id DESC LIMIT 1")
        if not runs:
            return None
        alive = self.stamp(runs[0], "ended_") or self.stamp(runs[0], "alive_")
        for row in self.rows(
            "SELECT last_utc_ns, last_monotonic_ns, last_boot_id FROM raw_chunks ORDER BY id DESC LIMIT 1"
        ):
            captured = self.stamp(row, "last_")
            if captured and alive and captured.boot_id == alive.boot_id and captured.monotonic_ns > alive.monotonic_ns:
                return captured
        return alive

    def note_alive(self, now: Stamp) -> None:
        """The running daemon is alive; without it the end of a killed run is known by its last capture alone.

        Harmless when no run has begun.
        """
        if self.run_id:
            self.update("daemon_runs", {"id": self.run_id}, self.instant(now, "alive_"))

    def end_run(self, now: Stamp) -> None:
        """The run ends in order; harmless when none has begun."""
        if self.run_id:
            self.update("daemon_runs", {"id": self.run_id}, {**self.instant(now, "ended_"), "clean": True})
            self.run_id = 0

    # ---- raw captures ----------------------------------------------------------------------------------------------

    def append_captures(self, captures: Sequence[Capture]) -> list[int]:
        """Store captures as chunks that wait to be decoded.

        Returns:
            ids of the chunks, for `mark_decoded`.
        """
        ids = []
        with self.transaction() as db:
            for chunk in encode_captures(captures):
                first, last = chunk.first, chunk.last
                boot = self.boot_row(first)
                values = (
                    *(self._link_row(chunk.link, chunk.kind), first.utc_ns, first.monotonic_ns, boot),
                    *(last.utc_ns, last.monotonic_ns, boot, chunk.captures, chunk.payload_bytes, chunk.blob),
                )
                ids.append(_rowid(db.execute(_CHUNKS, values)))
            db.conn.executemany("INSERT INTO undecoded_chunks (chunk_id) VALUES (?)", [(i,) for i in ids])
        return ids

    def _link_row(self, link: str, kind: str) -> int:
        row = self._links.get(link)
        if row is None:
            row = self._number("SELECT id FROM links WHERE name = ?", [link])
            if row is None:
                row = self.insert("links", {"name": link, "kind": kind})
            self._links[link] = row
        return row

    def mark_decoded(self, chunk_ids: Iterable[int]) -> None:
        """The records of these chunks are stored (in the same transaction, or before)."""
        with self.transaction() as db:
            db.conn.executemany("DELETE FROM undecoded_chunks WHERE chunk_id = ?", [(i,) for i in chunk_ids])

    def undecoded_chunks(self, after: int = 0, captures: int = 2**62) -> list[int]:
        """Ids of chunks that wait to be decoded, oldest first.

        Args:
            after: only those with a greater id.
            captures: no more of them than hold this many, and at least one.
        """
        ids: list[int] = []
        with self._turn:
            for chunk_id, held in self._db.execute(_UNDECODED, [after]):
                ids.append(chunk_id)
                captures -= held or 0  # none: the chunk itself is gone, which reading it will tell
                if captures <= 0:
                    break
        return ids

    def newest_undecoded(self) -> int:
        """Id of the newest chunk that waits to be decoded; 0 where none does."""
        return self._number("SELECT coalesce(max(chunk_id), 0) FROM undecoded_chunks", []) or 0

    def chunk_captures(self, chunk_id: int) -> list[Capture]:
        """The captures of one chunk.

        Raises:
            StoreError: the chunk is damaged; the message names it.
            sqlite3.OperationalError: the disk does not give it at present.
        """
        try:
            (row,) = self.rows("SELECT chunk FROM raw_chunks WHERE id = ?", [chunk_id])
            return decode_captures(row["chunk"])
        except (StoreError, ValueError) as error:
            raise StoreError(f"{self.path}: raw chunk {chunk_id}: {error}") from error
        except sqlite3.OperationalError:
            raise
        except sqlite3.DatabaseError as error:
            raise StoreError(f"{self.path}: raw chunk {chunk_id}: {error}; restore the store from a backup") from error

    # ---- records ---------------------------------------------------------------------------------------------------

    def declare_channels(self, joints: Mapping[str, str], signals: Mapping[str, str]) -> None:
        """Say which channels are joints and which are signals, each with its unit; others are taken for signals."""
        with self.transaction():
            self._joints = frozenset(joints)
            self._channels.clear()
            for name, unit in (*joints.items(), *signals.items()):
                self._channel(name, unit)

    def _channel(self, name: str, unit: str) -> tuple[int, ChannelKind]:
        found = self._channels.get((name, unit))
        if found is None:
            kind: ChannelKind = "joint" if name in self._joints else "signal"
            key = {"name": name, "unit": unit, "kind": kind}
            row = self._number("SELECT id FROM channels WHERE name = ? AND unit = ? AND kind = ?", [*key.values()])
            found = self.insert("channels", key) if row is None else row, kind
            self._channels[name, unit] = found
        return found

    def insert_records(self, records: Iterable[Record]) -> None:
        """Insert records, each kind into its table; a gap that closes completes the row that its opening made."""
        samples: dict[str, list[SqlRow]] = {"joint": [], "signal": []}
        fixes: list[SqlRow] = []
        events: list[SqlRow] = []
        failures: list[DecodeFailure] = []
        gaps: list[SqlRow] = []
        with self.transaction() as db:
            for record in records:
                if isinstance(record, Reading):
                    channel_id, kind = self._channel(record.channel, record.unit)
                    samples[kind].append(sample_row(record, channel_id, self.boot_row(record.stamp)))
                elif isinstance(record, Fix):
                    fixes.append(fix_row(record, self.boot_row(record.stamp), self.boot_row(record.last_byte)))
                elif isinstance(record, DeviceEvent):
                    when = self.instant(record.stamp).values()
                    events.append((record.device, *when, record.kind.value, record.text, sql_value(record.code)))
                elif isinstance(record, DecodeFailure):
                    failures.append(record)
                else:
                    start = self.instant(record.start).values()
                    end = self.instant(record.end).values() if record.end is not None else (None, None, None)
                    gaps.append((record.channel, record.reason.value, *start, *end, sql_value(record.missed)))
            counted = [
                (f.device, *self.instant(f.stamp).values(), f.reason, f.raw[:EXCERPT_BYTES], count)
                for f, count in counted_failures(failures)
            ]
            for statement, rows in (
                (_SAMPLES["joint"], samples["joint"]),
                (_SAMPLES["signal"], samples["signal"]),
                (_FIXES, fixes),
                (_EVENTS, events),
                (_FAILURES, counted),
                (_GAPS, gaps),
            ):
                if rows:
                    db.conn.executemany(statement, rows)

    def fix_id(self, fix: Fix) -> int | None:
        """The row of `fixes` that holds `fix`; None if it is not stored."""
        return self._number(
            "SELECT id FROM fixes WHERE station = ? AND boot_id = ? AND monotonic_ns = ? ORDER BY id DESC LIMIT 1",
            [fix.station, self.boot_row(fix.stamp), fix.stamp.monotonic_ns],
        )


def _rowid(cursor: sqlite3.Cursor) -> int:
    return cast(int, cursor.lastrowid)  # None only before a connection's first INSERT
