"""Read-only connections: any number of them, in any process, while the daemon writes."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from sqlite_utils import Database

from daemon.store.captures import decode_captures
from daemon.store.errors import StoreError
from daemon.store.files import FileIdentity
from daemon.store.migrations import pending_migrations
from daemon.store.rows import sql_value, stamp_of, stored_text
from drivers.clock import Stamp
from drivers.readings import Capture

# Ids are found by the index alone and chunks read in order of id, so that not all chunks are read and none are sorted.
# A single statement, so that chunks that are packed meanwhile are read as they were.
CHUNKS = """SELECT id, chunk FROM raw_chunks WHERE id IN (SELECT id FROM raw_chunks
        WHERE (last_boot_id, last_monotonic_ns) >= (?1, ?2) AND (first_boot_id, first_monotonic_ns) <= (?3, ?4)
            AND (?5 IS NULL OR link_id = (SELECT id FROM links WHERE name = ?5)))
    ORDER BY id"""
_SAMPLE = "channels.name AS channel, unit, utc_ns, value, status, raw_counts"
_RECORDS = {
    "joint_samples": _SAMPLE,
    "signals": _SAMPLE,
    "fixes": "station, utc_ns, last_byte_utc_ns, status, lock, hz_angle_rad, zenith_angle_rad, slope_distance_m, "
    "north_m, east_m, up_m, face, prism_constant_mm, ppm, tilt_ok, edm_level, reason, raw",
    "device_events": "device, utc_ns, kind, text, code",
    "decode_failures": "device, utc_ns, reason, excerpt, count",
    "gaps": "channel, reason, start_utc_ns, end_utc_ns, missed",
}


class Reader:
    """A read-only view of a store; a context manager. For the thread that opened it only.

    Args:
        path: the database.
        identity: identity that the file must have; None for any.

    Raises:
        StoreError: there is no store at `path`, or the file is a different one.
    """

    def __init__(self, path: Path, identity: FileIdentity | None = None) -> None:
        self.path = path
        self._boots: dict[int, str] = {}
        if identity is not None and FileIdentity.of(path) != identity:
            raise StoreError(
                f"{path}: this is not the store that the daemon writes to: the file was replaced or removed while the "
                "daemon ran; `rigcal status` shows what to do"
            )
        if not path.is_file():
            raise StoreError(f"{path}: there is no store; the daemon creates one when it starts")
        # Never immutable=1: the file changes under a live daemon.
        self._connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
        self._connection.row_factory = sqlite3.Row
        self._connection.text_factory = stored_text
        try:
            self._connection.execute("PRAGMA query_only = ON")
            self._connection.execute("SELECT count(*) FROM boots")
        except sqlite3.Error as error:
            self._connection.close()
            raise StoreError(f"{path}: cannot be read as a store: {error}") from error

    def __enter__(self) -> Reader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        """Let all queries in a block see the store as it was at the first query."""
        self._connection.execute("BEGIN")
        try:
            yield
        finally:
            self._connection.rollback()

    def interrupt_by(self, look: Callable[[], None]) -> None:
        """Make long queries call `look` repeatedly, and end them with SQLITE_INTERRUPT if it raises."""

        def is_over() -> int:
            try:
                look()
            except Exception:  # noqa: BLE001 - the caller calls `look` itself again, and gets its exception
                return 1
            return 0

        self._connection.set_progress_handler(is_over, 100_000)

    def rows(self, sql: str, parameters: Sequence[object] = ()) -> Iterator[dict[str, Any]]:
        """Yield the rows of a query as mappings, one at a time.

        Args:
            sql: the query.
            parameters: values of its placeholders.

        Raises:
            StoreError: the store was made by an older rigcal, and lacks a table or column of the query.
            sqlite3.Error: the query is wrong, or would write.
        """
        try:
            cursor = self._connection.execute(sql, [*map(sql_value, parameters)])
        except sqlite3.OperationalError as error:
            if str(error).startswith("no such") and pending_migrations(Database(self._connection)):
                raise StoreError(
                    f"{self.path}: made by an older rigcal; the daemon of this version updates it when it starts"
                ) from error
            raise
        for row in cursor:
            yield dict(row)

    def boots(self) -> dict[int, str]:
        """Return kernel boot ids by row id, for `rows.stamp_of`."""
        return {row["id"]: row["kernel_boot_id"] for row in self._connection.execute("SELECT * FROM boots")}

    def links(self) -> list[dict[str, Any]]:
        """Return name and kind of every link with stored captures."""
        return list(self.rows("SELECT name, kind FROM links ORDER BY id"))

    def count(self, table: str) -> int:
        """Return the number of rows of a table."""
        return int(next(self.rows(f'SELECT count(*) AS n FROM "{table}"'))["n"])

    def records(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield all decoded records, with only those columns that depend on nothing but the captures.

        Yields:
            Name of the table and a row of it; the rows of a table in the order in which they were stored.
        """
        for table, columns in _RECORDS.items():
            join = " JOIN channels ON channels.id = channel_id" if "channels.name" in columns else ""
            for row in self.rows(f"SELECT {columns} FROM {table}{join} ORDER BY {table}.id"):
                yield table, row

    def captures(
        self, link: str | None = None, since: Stamp | None = None, until: Stamp | None = None
    ) -> Iterator[Capture]:
        """Yield the captures of one link, in the order of storing, or of all links, in the order of their chunks.

        Args:
            link: name of the link; None for all links.
            since: first instant, on the monotonic clock of its boot (the wall clock may have been set in between); None
                for no limit.
            until: last instant, likewise.

        Raises:
            StoreError: a chunk is damaged; the message names it.
        """
        boots = {kernel_boot_id: number for number, kernel_boot_id in self.boots().items()}

        def place(stamp: Stamp) -> tuple[int, int]:
            return boots.get(stamp.boot_id, 0), stamp.monotonic_ns

        first = place(since) if since is not None else (0, -(2**63))
        last = place(until) if until is not None else (2**63 - 1, 0)
        for chunk_id, blob in self._connection.execute(CHUNKS, [*first, *last, link]):
            try:
                captures = decode_captures(blob)
            except StoreError as error:
                raise StoreError(f"{self.path}: raw chunk {chunk_id}: {error}") from error
            yield from (c for c in captures if first <= place(c.stamp) <= last)

    def stamp(self, row: Mapping[str, object], prefix: str = "") -> Stamp:
        """Return the instant in a row's `<prefix>utc_ns`, `<prefix>monotonic_ns`, `<prefix>boot_id`."""
        if row[f"{prefix}boot_id"] not in self._boots:
            self._boots = self.boots()
        return stamp_of(row, self._boots, prefix)
