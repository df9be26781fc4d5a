"""The one connection that writes: its lock, its transactions, and rows by table and column.

WAL with synchronous=FULL: what `transaction` has committed survives power loss. One connection writes and
checkpoints, because SQLite up to 3.51.2 can corrupt a WAL that two connections reset at once; readers
(`daemon.store.reader`, and `rows` outside a transaction) are read-only, and wait for no commit.
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
from drivers.clock import Stamp

log = logging.getLogger(__name__)

T = TypeVar("T")

OLDEST_SQLITE = (3, 38, 0)  # STRICT tables (3.37) and JSON built in (3.38)
CLOSE_TIMEOUT_S = 5.0  # a thread that hangs in a commit keeps its turn for ever


class Connection:
    """A database opened for writing, exclusively, created or migrated as needed.

    May be used by several threads: transactions take turns.

    Args:
        path: the database; by convention it ends in `.sqlite`.

    Attributes:
        files: which files it is made of, as they were when it was opened.
        damage: the first damage that was met while it was used; "" as long as there was none.

    Raises:
        StoreBusyError: another process writes to it.
        StoreError: it is no such database, is damaged or half restored, was made by a newer rigcal, its directory
            cannot be used, or the disk is full.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if sqlite3.sqlite_version_info < OLDEST_SQLITE:
            wanted = ".".join(map(str, OLDEST_SQLITE))
            raise StoreError(f"SQLite {sqlite3.sqlite_version} is too old; rigcal needs {wanted} or newer")
        self._turn = threading.RLock()
        self._transactions = threading.local()  # how many of this thread are open, one in the other
        self._afterwards: list[Callable[[], object]] = []  # of the transaction that is open
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
                self._reads.execute("PRAGMA schema_version").fetchall()  # opens its files, whose names may go
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
        connection.execute("PRAGMA journal_size_limit = 67108864")  # a WAL grown behind a slow reader shrinks again
        if later := unknown_migrations(self._db):
            raise StoreError(f"{self.path}: made by a newer rigcal (it has {later[0]}); install that version")
        if pending_migrations(self._db):
            drop_views(self._db)  # a table that a view reads cannot be changed
        MIGRATIONS.apply(self._db)
        self._show_views()
        # What a statement may undo needs no file, hence no descriptor. Not before: an index of a large store is sorted
        # in files, where memory would not hold it.
        connection.execute("PRAGMA temp_store = MEMORY")

    def _show_views(self) -> None:
        """Make the views for the joints and signals that the store knows; a damaged store is opened without."""
        try:
            make_views(self._db)
        except sqlite3.DatabaseError as error:
            if not is_damage(error):
                raise
            log.error("%s: damaged, so its views may not be those of its channels: %s", self.path, error)

    def close(self) -> None:
        """Close the database and let others write to it; harmless when it was closed before.

        Where a thread hangs in a commit, the database stays open and locked until the process ends.
        """
        if not self._turn.acquire(timeout=CLOSE_TIMEOUT_S):
            log.error("%s: a write does not end; the store is left open", self.path)
            return
        try:
            with self._reading:
                self._reads.close()  # first: the last one to close tidies the write-ahead log away
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
        """Do `work` when all transactions that this thread is in are committed, and never if one is rolled back.

        What is in memory thus changes after the store, and before another thread can store anything.

        Args:
            work: it must be quick, as other threads wait. Outside a transaction it is done at once.
        """
        if self._depth:
            self._afterwards.append(work)
        else:
            work()

    @property
    def _depth(self) -> int:
        """Number of transactions that this thread is in, one inside the other."""
        return getattr(self._transactions, "depth", 0)

    def _forget_rows(self) -> None:
        """Empty the caches of row numbers: a transaction that made some of these rows was rolled back."""
        self._boots.clear()
        self._boot_ids = {}  # a new one: another thread may be looking something up in the old one

    def reader(self) -> Reader:
        """A read-only view of this very store, for what the writing connection must not wait for.

        Raises:
            StoreError: its file was replaced, moved or removed.
        """
        return Reader(self.path, self.files.database)

    def insert(self, table: str, row: Mapping[str, object]) -> int:
        """Insert one row; numpy scalars, NaN, lists and mappings are made storable (`rows.sql_value`).

        Returns:
            its rowid.
        """
        names = ", ".join(f'"{name}"' for name in row)
        with self.transaction() as db:
            cursor = db.execute(
                f'INSERT INTO "{table}" ({names}) VALUES ({marks(row)})', [*map(sql_value, row.values())]
            )
            return cast(int, cursor.lastrowid)  # None only before a connection's first INSERT

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
        """The rows of a query: in a transaction of this thread with its changes, else as last committed, at once.

        What is read outside a transaction waits for no other thread's: a commit takes as long as the disk does.
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
        """Remember what was raised where the store was used, if it tells that the store is damaged."""
        if is_damage(error):
            self.damage = self.damage or str(error)

    def unless_damaged(self, work: Callable[[], T], otherwise: T) -> T:
        """Return what `work` returns; `otherwise` where a table is damaged: the daemon starts all the same.

        The damage is logged and remembered, so that an alarm tells of it.
        """
        try:
            return work()
        except sqlite3.DatabaseError as error:
            if not is_damage(error):
                raise
            self.note_damage(error)
            log.error("%s: %s", self.path, error)
            return otherwise

    def number(self, sql: str, parameters: Sequence[object]) -> int | None:
        """The integer in the first column of a query's first row; None where there is no row."""
        found = self.rows(sql, parameters)
        return int(next(iter(found[0].values()))) if found else None

    def pragma(self, name: str) -> int:
        """The number that SQLite tells of the database: `page_count`, `page_size`, `freelist_count`."""
        return self.number(f"PRAGMA {name}", []) or 0

    def instant(self, stamp: Stamp, prefix: str = "") -> dict[str, SqlValue]:
        """The three columns of an instant, to be merged into a row: `<prefix>utc_ns`, ..."""
        return {
            f"{prefix}utc_ns": stamp.utc_ns,
            f"{prefix}monotonic_ns": stamp.monotonic_ns,
            f"{prefix}boot_id": self.boot_row(stamp),
        }

    def stamp_or_none(self, row: Mapping[str, object], prefix: str = "") -> Stamp | None:
        """The instant in a row's `<prefix>utc_ns`, ...; None where they are NULL."""
        return None if row[f"{prefix}utc_ns"] is None else self.stamp(row, prefix)

    def stamp(self, row: Mapping[str, object], prefix: str = "") -> Stamp:
        """The instant in a row's `<prefix>utc_ns`, ..., which are not NULL."""
        known = self._boot_ids
        if row[f"{prefix}boot_id"] not in known:
            known = self._boot_ids = {boot["id"]: boot["kernel_boot_id"] for boot in self.rows("SELECT * FROM boots")}
        return stamp_of(row, known, prefix)

    def boot_row(self, stamp: Stamp) -> int:
        """The row of `boots` that `stamp` belongs to, made on first sight."""
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
        """Names of the boots that anything was stored in, oldest first."""
        return [str(row["kernel_boot_id"]) for row in self.rows("SELECT kernel_boot_id FROM boots ORDER BY id")]

    def rig_file(self, rig: str, text: str) -> str:
        """The SHA-256 of a rig file, which is stored on first sight."""
        sha256 = rig_sha256(text)
        with self.transaction() as db:
            row = [sha256, rig, text]
            db.execute("INSERT INTO rig_files (sha256, rig, text) VALUES (?, ?, ?) ON CONFLICT DO NOTHING", row)
        return sha256

    def order(self, stamp: Stamp) -> tuple[int, int]:
        """Place of an instant among all that the store knows (`drivers.clock.Order`)."""
        return self.boot_row(stamp), stamp.monotonic_ns


def rig_sha256(text: str) -> str:
    """Return the SHA-256 by which a rig file is known in the store."""
    return hashlib.sha256(text.encode()).hexdigest()
