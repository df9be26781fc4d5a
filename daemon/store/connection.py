"""The single writing connection: its lock, its transactions, and rows by table and column.

WAL with synchronous=FULL: whatever `transaction` has committed survives power loss. Only one connection writes and
checkpoints, because SQLite up to 3.51.2 can corrupt a WAL that two connections reset at the same time. Readers
(`daemon.store.reader`, and `rows` outside a transaction) are read-only and do not wait for commits.
"""

from __future__ import annotations

import hashlib
import logging
import sqlite3
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

from sqlite_utils import Database

from daemon.store.errors import StoreError, is_damage, storage_sentence
from daemon.store.files import StoreFiles, WriterLock, require_no_half_restore
from daemon.store.migrations import MIGRATIONS, pending_migrations, unknown_migrations
from daemon.store.reader import Reader
from daemon.store.rows import SqlValue, marks, sql_value, stamp_of, stored_text
from daemon.store.views import drop_views, make_views
from daemon.store.write_ahead_log import KEPT_BYTES
from drivers.clock import Stamp

log = logging.getLogger(__name__)

T = TypeVar("T")

OLDEST_SQLITE = (3, 38, 0)  # STRICT tables (3.37) and built-in JSON (3.38)
CLOSE_TIMEOUT_S = 5.0  # a thread that hangs in a commit never releases its turn


class Connection:
    """A database opened for writing, exclusively, created or migrated as needed.

    May be used by several threads: transactions take turns.

    Args:
        path: the database; by convention it ends in `.sqlite`.

    Attributes:
        files: the files of the database, as they were when it was opened.
        damage: the first damage found while it was used; "" if there was none.

    Raises:
        StoreBusyError: another process writes to it.
        StoreError: the file is not a store, is damaged or only partly restored, or was made by a newer rigcal; or its
            directory cannot be used, or the disk is full.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if sqlite3.sqlite_version_info < OLDEST_SQLITE:
            wanted = ".".join(map(str, OLDEST_SQLITE))
            raise StoreError(f"SQLite {sqlite3.sqlite_version} is too old; rigcal needs {wanted} or newer")
        self._turn = threading.RLock()
        self._transactions = threading.local()  # number of nested open transactions of this thread
        self._afterwards: list[Callable[[], object]] = []  # calls to make once the open transaction is committed
        self._reading = threading.Lock()
        self._lock = WriterLock(path)
        try:
            require_no_half_restore(path)
            # Transactions take turns under `_turn`, so the connection need not belong to one thread.
            connection = sqlite3.connect(path, check_same_thread=False)
            connection.text_factory = stored_text
            try:
                self._db = Database(connection)
                self._prepare(connection)
                self._reads = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True, check_same_thread=False)
                self._reads.text_factory = stored_text
                self._reads.execute("PRAGMA schema_version").fetchall()  # opens its files before they may be renamed
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
        self.files = StoreFiles.of(path)
        self.damage = ""
        log.info("store %s open, SQLite %s", path, sqlite3.sqlite_version)

    def _prepare(self, connection: sqlite3.Connection) -> None:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("PRAGMA secure_delete = OFF")  # Debian's default: pages that are freed are written once more
        # A log that has grown behind a slow reader shrinks again
        connection.execute(f"PRAGMA journal_size_limit = {KEPT_BYTES}")
        if later := unknown_migrations(self._db):
            raise StoreError(f"{self.path}: made by a newer rigcal (it has {later[0]}); install that version")
        if pending_migrations(self._db):
            drop_views(self._db)  # a table cannot be changed while a view reads it
        MIGRATIONS.apply(self._db)
        self._show_views()
        # Statement journals then need no file, and so no descriptor. Set only now, because a migration may sort the
        # index of a large store in files where the memory is too small.
        connection.execute("PRAGMA temp_store = MEMORY")

    def _show_views(self) -> None:
        """Create the views for the joints and signals of the store; a damaged store is opened without them."""
        try:
            make_views(self._db)
        except sqlite3.DatabaseError as error:
            if not is_damage(error):
                raise
            log.error("%s: damaged, so its views may not match its channels: %s", self.path, error)

    def close(self) -> None:
        """Close the database and release its lock; harmless if it is closed already.

        If a thread hangs in a commit, the database stays open and locked until the process ends.
        """
        if not self._turn.acquire(timeout=CLOSE_TIMEOUT_S):
            log.error("%s: a write does not finish; the store is left open", self.path)
            return
        try:
            with self._reading:
                self._reads.close()  # first, because the last connection to close removes the write-ahead log
            self._db.close()
            self._lock.release()
        finally:
            self._turn.release()

    # ---- transactions and rows -------------------------------------------------------------------------------------

    @contextmanager
    def transaction(self) -> Iterator[Database]:
        """Open a transaction: committed durably when the block ends, rolled back when it raises.

        Nested transactions are savepoints of the outermost one. Other threads wait for their turn.
        """
        with self._turn:
            depth, due = self._depth, len(self._afterwards)
            self._transactions.depth = depth + 1
            try:
                with self._db.atomic() as db:
                    yield db
            except BaseException as error:
                del self._afterwards[due:]
                self.note_damage(error)
                self._forget_rows()
                raise
            finally:
                self._transactions.depth = depth
            if not depth:
                afterwards, self._afterwards = self._afterwards, []
                for work in afterwards:
                    work()

    def once_committed(self, work: Callable[[], object]) -> None:
        """Call `work` once all open transactions of this thread are committed; never if one is rolled back.

        Memory thus changes after the store, and before another thread can store anything.

        Args:
            work: must be quick, because other threads wait. Outside a transaction it is called at once.
        """
        if self._depth:
            self._afterwards.append(work)
        else:
            work()

    @property
    def _depth(self) -> int:
        """Number of nested open transactions of this thread."""
        return getattr(self._transactions, "depth", 0)

    def _forget_rows(self) -> None:
        """Empty the caches of row numbers, because a transaction that created some of the rows was rolled back."""
        self._boots.clear()
        self._boot_ids = {}  # a new one: another thread may be looking something up in the old one

    def reader(self) -> Reader:
        """Open a read-only view of this store, for queries that must not delay the writing connection.

        Raises:
            StoreError: the store's file was replaced, moved or removed.
        """
        return Reader(self.path, self.files.database)

    def insert(self, table: str, row: Mapping[str, object]) -> int:
        """Insert one row; numpy scalars, NaN, lists and mappings are converted (`rows.sql_value`).

        Args:
            table: name of the table.
            row: column -> value.

        Returns:
            Its rowid.
        """
        names = ", ".join(f'"{name}"' for name in row)
        with self.transaction() as db:
            cursor = db.execute(
                f'INSERT INTO "{table}" ({names}) VALUES ({marks(row)})', [*map(sql_value, row.values())]
            )
            return cast(int, cursor.lastrowid)  # None only before a connection's first INSERT

    def update(self, table: str, where: Mapping[str, object], changes: Mapping[str, object]) -> int:
        """Change the rows whose columns equal `where`.

        Args:
            table: name of the table.
            where: column -> value that selects the rows.
            changes: column -> new value.

        Returns:
            Number of rows changed.
        """
        settings = ", ".join(f'"{name}" = ?' for name in changes)
        conditions = " AND ".join(f'"{name}" IS ?' for name in where)
        values = [*map(sql_value, changes.values()), *map(sql_value, where.values())]
        with self.transaction() as db:
            return db.execute(f'UPDATE "{table}" SET {settings} WHERE {conditions}', values).rowcount

    def rows(self, sql: str, parameters: Sequence[object] = ()) -> list[dict[str, Any]]:
        """Return the rows of a query: with the changes of this thread's open transaction, otherwise as last committed.

        Outside a transaction the query does not wait for transactions of other threads, whose commits may be slow.

        Args:
            sql: the query.
            parameters: values of its placeholders.
        """
        lock, connection = (self._turn, self._db.conn) if self._depth else (self._reading, self._reads)
        with lock:
            try:
                cursor = connection.execute(sql, [*map(sql_value, parameters)])
                names = [column[0] for column in cursor.description]
                return [dict(zip(names, row, strict=True)) for row in cursor]
            except sqlite3.Error as error:
                self.note_damage(error)
                raise

    def note_damage(self, error: BaseException) -> None:
        """Remember an error raised while using the store, if it shows that the store is damaged."""
        if is_damage(error):
            self.damage = self.damage or str(error)

    def unless_damaged(self, work: Callable[[], T], otherwise: T) -> T:
        """Return the result of `work`, or `otherwise` if a table is damaged, so that the daemon can still start.

        The damage is logged and remembered, so that an alarm is raised.
        """
        try:
            return work()
        except sqlite3.DatabaseError as error:
            if not is_damage(error):
                raise
            self.note_damage(error)
            log.error("%s: %s", self.path, error)
            return otherwise

    def despite_damage(self, work: Callable[[], T]) -> T:
        """Return the result of `work`, which is repeated once if it met damage and leaves out by then what met it.

        A transaction that has met damage cannot be committed any more, whatever else it contains.
        """
        try:
            return work()
        except sqlite3.DatabaseError as error:
            if not is_damage(error):
                raise
            return work()

    def number(self, sql: str, parameters: Sequence[object]) -> int | None:
        """Return the integer in the first column of a query's first row; None if there is no row."""
        found = self.rows(sql, parameters)
        return int(next(iter(found[0].values()))) if found else None

    def pragma(self, name: str) -> int:
        """Return a number that SQLite reports about the database: `page_count`, `page_size`, `freelist_count`."""
        return self.number(f"PRAGMA {name}", []) or 0

    def instant(self, stamp: Stamp, prefix: str = "") -> dict[str, SqlValue]:
        """Return the three columns of an instant, to be merged into a row: `<prefix>utc_ns`, ..."""
        return {
            f"{prefix}utc_ns": stamp.utc_ns,
            f"{prefix}monotonic_ns": stamp.monotonic_ns,
            f"{prefix}boot_id": self.boot_row(stamp),
        }

    def stamp_or_none(self, row: Mapping[str, object], prefix: str = "") -> Stamp | None:
        """Return the instant in a row's columns `<prefix>utc_ns`, ...; None if they are NULL."""
        return None if row[f"{prefix}utc_ns"] is None else self.stamp(row, prefix)

    def stamp(self, row: Mapping[str, object], prefix: str = "") -> Stamp:
        """Return the instant in a row's columns `<prefix>utc_ns`, ..., which must not be NULL."""
        known = self._boot_ids
        if row[f"{prefix}boot_id"] not in known:
            known = self._boot_ids = {boot["id"]: boot["kernel_boot_id"] for boot in self.rows("SELECT * FROM boots")}
        return stamp_of(row, known, prefix)

    def boot_row(self, stamp: Stamp) -> int:
        """Return the row of `boots` to which `stamp` belongs; it is created if it does not exist."""
        row = self._boots.get(stamp.boot_id)
        if row is None:
            with self.transaction():
                row = self.number("SELECT id FROM boots WHERE kernel_boot_id = ?", [stamp.boot_id])
                if row is None:
                    booted = {"kernel_boot_id": stamp.boot_id, "booted_utc_ns": stamp.utc_ns - stamp.monotonic_ns}
                    row = self.insert("boots", booted)
                self._boots[stamp.boot_id] = row
        return row

    def boots(self) -> list[str]:
        """Return the kernel boot ids of all boots in the store, oldest first."""
        return [str(row["kernel_boot_id"]) for row in self.rows("SELECT kernel_boot_id FROM boots ORDER BY id")]

    def rig_file(self, rig: str, text: str) -> str:
        """Return the SHA-256 of a rig file, and store the file if it is new.

        Args:
            rig: name of the rig.
            text: text of the rig file.
        """
        sha256 = rig_sha256(text)
        with self.transaction() as db:
            row = [sha256, rig, text]
            db.execute("INSERT INTO rig_files (sha256, rig, text) VALUES (?, ?, ?) ON CONFLICT DO NOTHING", row)
        return sha256

    def order(self, stamp: Stamp) -> tuple[int, int]:
        """Return the sort key of an instant among all instants in the store (`drivers.clock.Order`)."""
        return self.boot_row(stamp), stamp.monotonic_ns


def rig_sha256(text: str) -> str:
    """Return the SHA-256 that identifies a rig file in the store."""
    return hashlib.sha256(text.encode()).hexdigest()
