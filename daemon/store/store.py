"""The store that acquisition writes: runs of the daemon, raw captures, and the records decoded from them."""

from __future__ import annotations

import contextlib
import logging
import os
import sqlite3
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from sqlite_utils import Database

from daemon.store.captures import decode_captures, encode_captures
from daemon.store.connection import Connection
from daemon.store.errors import StoreError, is_damage
from daemon.store.rows import EXCERPT_BYTES, FIX_COLUMNS, SqlRow, counted_failures, fix_row, sample_row, sql_value
from daemon.version import VERSION
from drivers.clock import Stamp
from drivers.readings import Capture, DecodeFailure, DeviceEvent, EventKind, Fix, Gap, GapReason, Reading, Record

log = logging.getLogger(__name__)

ChannelKind = Literal["joint", "signal"]

WHOLE_DAEMON = "daemon"  # channel of gaps during which rigcal itself was not running

_NEWEST_RUN = "SELECT * FROM daemon_runs ORDER BY id DESC LIMIT 1"
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


class _TriedError(Exception):
    """Rolls back a transaction that was only tried."""


class Store(Connection):
    """A store opened for writing.

    Args:
        path: the database; by convention it ends in `.sqlite`.

    Attributes:
        run_id: row of `daemon_runs`; 0 before a run has begun, and if its row cannot be written.
        begun: when the run began; None before.
        previous_end: when the previous run ended, or was last known to be alive; None for the first run.
        ended_in_order: whether the previous run shut down cleanly; known once a run has begun, True before that and for
            the first run.

    Raises:
        StoreError: as for a Connection.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._links: dict[str, int] = {}
        self._channels: dict[tuple[str, str], tuple[int, ChannelKind]] = {}
        self._joints: frozenset[str] = frozenset()
        self._left_out: set[str] = set()  # statements that have met damage
        self._are_events_unread = False
        self.run_id = 0
        self.begun: Stamp | None = None
        self.previous_end: Stamp | None = None
        self.ended_in_order = True

    def _forget_rows(self) -> None:
        super()._forget_rows()
        self._links.clear()
        self._channels.clear()

    # ---- runs of the daemon ----------------------------------------------------------------------------------------

    def begin_run(self, now: Stamp) -> None:
        """Begin a run of the daemon: record a gap since the previous run last read its links, and close its open gaps.

        If the table of runs or gaps is damaged, the run begins without it, as after an unclean shutdown.
        """
        self.begun = now
        try:
            with self.transaction() as db:
                self._note_gap(db, now)
                run_id = self._note_run(now)
        except sqlite3.DatabaseError as error:
            if not is_damage(error):
                raise
            log.error("%s: damaged, so the state left by the previous run cannot be read: %s", self.path, error)
            self.ended_in_order = False
            run_id = self.unless_damaged(lambda: self._note_run(now), 0)
        self.run_id = run_id

    def _note_run(self, now: Stamp) -> int:
        run = {
            "pid": os.getpid(),
            "software_version": VERSION,
            "sqlite_version": sqlite3.sqlite_version,
        }
        return self.insert("daemon_runs", run | self.instant(now, "started_") | self.instant(now, "alive_"))

    def _note_gap(self, db: Database, now: Stamp) -> None:
        """Store the gap since the previous run, and close the gaps that it left open."""
        runs = self.rows(_NEWEST_RUN)
        if not runs:
            return
        self.ended_in_order = bool(runs[0]["clean"])
        since = self.stamp(runs[0], "alive_")
        self.previous_end = last = self._end_of(runs[0])
        ended = self.instant(last, "end_")
        settings = ", ".join(f"{name} = ?" for name in ended)
        # A gap that began after the last known instant ends where it began, because nothing more is known
        itself = ", ".join(f"{name} = {name.replace('end_', 'start_')}" for name in ended)
        began_later = "end_utc_ns IS NULL AND start_boot_id = ? AND start_monotonic_ns > ?"
        db.execute(f"UPDATE gaps SET {itself} WHERE {began_later}", [ended["end_boot_id"], ended["end_monotonic_ns"]])
        db.execute(f"UPDATE gaps SET {settings} WHERE end_utc_ns IS NULL", [*ended.values()])
        self.insert_records([Gap(WHOLE_DAEMON, GapReason.NOT_RUNNING, since, now)])

    def _end_of(self, run: Mapping[str, Any]) -> Stamp:
        """Return the last instant of the newest run: its end, its last heartbeat, or that of its last captures."""
        last = self.stamp_or_none(run, "ended_") or self.stamp(run, "alive_")
        # A killed run may have stored captures after its last heartbeat, but perhaps not all that arrived.
        for row in self.rows(
            "SELECT last_utc_ns, last_monotonic_ns, last_boot_id FROM raw_chunks ORDER BY id DESC LIMIT 1"
        ):
            captured = self.stamp(row, "last_")
            if captured.boot_id == last.boot_id and captured.monotonic_ns > last.monotonic_ns:
                last = captured
        return last

    def last_utc_ns(self) -> int:
        """Return the latest UTC that an earlier run of the daemon has stored, in ns; 0 for a new store."""
        return self.unless_damaged(
            lambda: max((self._end_of(run).utc_ns for run in self.rows(_NEWEST_RUN)), default=0), 0
        )

    def note_alive(self, until: Stamp) -> None:
        """Record the instant up to which all received data are stored; only later data can be lost.

        Does nothing if no run has begun.
        """
        if self.run_id:
            self.update("daemon_runs", {"id": self.run_id}, self.instant(until, "alive_"))

    def end_run(self, now: Stamp) -> None:
        """Record a clean shutdown of the run; does nothing if no run has begun."""
        if self.run_id:
            self.update("daemon_runs", {"id": self.run_id}, {**self.instant(now, "ended_"), "clean": True})
            self.run_id = 0

    # ---- raw captures ----------------------------------------------------------------------------------------------

    def append_captures(self, captures: Sequence[Capture]) -> list[int]:
        """Store captures as chunks that wait to be decoded.

        Returns:
            Ids of the chunks, for `mark_decoded`.
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
                ids.append(db.execute(_CHUNKS, values).lastrowid or 0)
            for table in ("undecoded_chunks", "small_chunks"):
                db.conn.executemany(f"INSERT INTO {table} (chunk_id) VALUES (?)", [(i,) for i in ids])
        return ids

    def _link_row(self, link: str, kind: str) -> int:
        row = self._links.get(link)
        if row is None:
            row = self.number("SELECT id FROM links WHERE name = ?", [link])
            if row is None:
                row = self.insert("links", {"name": link, "kind": kind})
            self._links[link] = row
        return row

    def mark_decoded(self, chunk_ids: Iterable[int]) -> None:
        """Note that the records of these chunks are stored (in the same transaction, or before)."""
        with self.transaction() as db:
            db.conn.executemany("DELETE FROM undecoded_chunks WHERE chunk_id = ?", [(i,) for i in chunk_ids])

    def undecoded_chunks(self, after: int = 0, captures: int = 2**62) -> list[int]:
        """Return the ids of chunks that wait to be decoded, oldest first.

        Args:
            after: only chunks with a greater id.
            captures: stop once the chunks contain this many captures; at least one chunk is returned.
        """
        ids: list[int] = []
        with self._turn:
            for chunk_id, held in self._db.execute(_UNDECODED, [after]):
                ids.append(chunk_id)
                captures -= held or 0  # NULL if the chunk is missing, which is reported when it is read
                if captures <= 0:
                    break
        return ids

    def newest_undecoded(self) -> int:
        """Return the id of the newest chunk that waits to be decoded; 0 if there is none."""
        return self.number("SELECT coalesce(max(chunk_id), 0) FROM undecoded_chunks", []) or 0

    def chunk_captures(self, chunk_id: int) -> list[Capture]:
        """Return the captures of one chunk.

        Raises:
            StoreError: the chunk is damaged; the message names it.
            sqlite3.OperationalError: the disk cannot be read at present.
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
        """Declare which channels are joints and which are signals; other channels count as signals.

        Args:
            joints: joint -> unit.
            signals: signal -> unit.
        """
        with self.transaction():
            self._joints = frozenset(joints)
            self._channels.clear()
            for name, unit in (*joints.items(), *signals.items()):
                self._channel(name, unit)
            self._show_views()

    def _channel(self, name: str, unit: str) -> tuple[int, ChannelKind]:
        found = self._channels.get((name, unit))
        if found is None:
            kind: ChannelKind = "joint" if name in self._joints else "signal"
            key = {"name": name, "unit": unit, "kind": kind}
            row = self.number("SELECT id FROM channels WHERE name = ? AND unit = ? AND kind = ?", [*key.values()])
            found = self.insert("channels", key) if row is None else row, kind
            self._channels[name, unit] = found
        return found

    def insert_records(self, records: Iterable[Record]) -> None:
        """Insert records, each kind into its table; a gap that closes completes the row of its opening."""
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
                    self._insert_rows(db, statement, rows)

    def _insert_rows(self, db: Database, statement: str, rows: Sequence[SqlRow]) -> None:
        """Insert rows; damage of the tables of gaps or events must not prevent captures from being stored.

        It prevents the commit of this transaction. From then on nothing is inserted into the damaged table.
        """
        if statement in self._left_out:
            return
        try:
            db.conn.executemany(statement, rows)
        except sqlite3.DatabaseError as error:
            if statement in (_GAPS, _EVENTS) and is_damage(error):
                self._left_out.add(statement)
                what = "gaps" if statement == _GAPS else "events of devices"
                log.error("%s: damaged, so %s are not stored any more: %s", self.path, what, error)
            raise

    @property
    def knows_events(self) -> bool:
        """False once events of devices could not be stored or read because their table is damaged."""
        return _EVENTS not in self._left_out and not self._are_events_unread

    def events(self, read: Callable[[], list[DeviceEvent]]) -> list[DeviceEvent]:
        """Return the events that `read` returns; none if it meets damage, which ends `knows_events`."""
        found = self.unless_damaged(read, None)
        self._are_events_unread |= found is None
        return found or []

    def try_events(self, now: Stamp, devices: Iterable[str]) -> None:
        """Find out whether jumps of devices can be stored, which ends `knows_events` if they meet damage."""
        tried = [DeviceEvent(device, now, EventKind.PRESET_JUMP, "") for device in devices]
        with contextlib.suppress(_TriedError, sqlite3.DatabaseError), self.transaction():
            self.insert_records(tried)
            raise _TriedError

    def newest_events(self, most: int) -> list[dict[str, Any]]:
        """Return device, utc_ns, kind and text of the newest device events, newest first."""
        return self.rows("SELECT device, utc_ns, kind, text FROM device_events ORDER BY id DESC LIMIT ?", (most,))

    def fix_id(self, fix: Fix) -> int | None:
        """Return the row of `fixes` that contains `fix`; None if it is not stored."""
        return self.number(
            "SELECT id FROM fixes WHERE station = ? AND boot_id = ? AND monotonic_ns = ? ORDER BY id DESC LIMIT 1",
            [fix.station, self.boot_row(fix.stamp), fix.stamp.monotonic_ns],
        )
