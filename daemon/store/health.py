"""Health of the store: its files are those that were opened, sound, and have room to grow.

A run that ended without order (a power cut, a kill, a full disk), or that met with damage, is followed by SQLite's
`quick_check`, beside acquisition. Files are looked at with every beat of the daemon.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import sqlite3
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from daemon.host.priority import UPKEEP_NICE, lower_priority
from daemon.store.errors import storage_sentence
from daemon.store.files import FileIdentity
from daemon.store.store import Store
from drivers.clock import Clock, Stamp, TimeBudget

log = logging.getLogger(__name__)

HealthState = Literal["ok", "checking", "damaged", "replaced", "missing"]

AT_START_S = 3.0  # a small store is checked by then, and its state known from the beginning
STOP_S = 5.0
LOW_BYTES = 2**30
LOW_SHARE = 0.05
LOW_SHARE_MOST_BYTES = 10 * 2**30
FINDINGS = 5
RETRY_S = 5.0
# What keeps a check from being made and says nothing of the store: no descriptors, no memory, a lock, a full disk.
_HINDRANCES = {
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_NOMEM,
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_FULL,
}
SOUND = "ok"


@dataclass(frozen=True)
class StoreHealth:
    """Health of the store.

    Attributes:
        state: ok; checking: it is being searched for damage; damaged: damage was found; replaced, missing: a file of
            it is not the one that the daemon has open, or has no name any more.
        text: what is wrong and what to do, a sentence; "" when all is well.
        since: when it came to be so.
        free_bytes: free space where the store lies; None where the file system does not tell.
        is_low: less than 1 GiB is free, or less than 5 % of the disk and 10 GiB.
    """

    state: HealthState
    text: str
    since: Stamp
    free_bytes: int | None
    is_low: bool

    @property
    def is_unsound(self) -> bool:
        """True if the store cannot be trusted."""
        return self.state in ("damaged", "replaced", "missing")

    def as_dict(self) -> dict[str, Any]:
        """As `status` tells it."""
        return {
            "state": self.state,
            "text": self.text,
            "since_utc_ns": self.since.utc_ns,
            "free_bytes": self.free_bytes,
            "is_low": self.is_low,
        }


class StoreWatch:
    """Watches over a store that is open for writing.

    Args:
        store: with a run begun.
        clock: for when what was found.

    Attributes:
        health: how the store is; to be read from any thread.
    """

    def __init__(self, store: Store, clock: Clock) -> None:
        self._store, self._clock = store, clock
        self._findings: str | None = None  # of the check; None until it has come to its end
        self._told = ""  # the fault of the check that the log has last
        self._stopping = threading.Event()
        self._connection: sqlite3.Connection | None = None
        self._check: threading.Thread | None = None
        self.health = StoreHealth("ok", "", clock.now(), None, is_low=False)

    def start(self) -> None:
        """Begin the check for damage, if one is due, and wait a moment for its end."""
        if not self._store.ended_in_order or self._is_unsettled():
            self._check = threading.Thread(target=self._search, name="store-check", daemon=True)
            self._check.start()
            self._check.join(AT_START_S)
        self.look()

    def stop(self) -> None:
        """End a check that is under way; the next start makes it again."""
        self._stopping.set()
        budget = TimeBudget(STOP_S)
        while self._check is not None and self._check.is_alive() and not budget.is_over:
            if self._connection is not None:
                with contextlib.suppress(sqlite3.ProgrammingError):  # closed meanwhile
                    self._connection.interrupt()
            self._check.join(0.05)

    def look(self) -> None:
        """Look at files and free space; costs microseconds, unless the file system hangs."""
        state, text = self._state()
        free_bytes, is_low = _space(self._store.path.parent)
        before = self.health
        if state == before.state:
            self.health = replace(before, text=text, free_bytes=free_bytes, is_low=is_low)
            return
        self.health = StoreHealth(state, text, self._clock.now(), free_bytes, is_low)
        if text:
            log.log(logging.INFO if state == "checking" else logging.CRITICAL, "%s", text)
        else:
            log.info("%s: the store is well again", self._store.path)

    def _state(self) -> tuple[HealthState, str]:
        path = self._store.path
        try:
            changed = self._store.files.changed()
        except OSError as error:
            return "missing", f"{path}: cannot be looked at ({error.strerror}): check the disk, `dmesg` may tell why"
        if changed is not None:
            name, is_replaced = changed
            found = "another file lies in place of the one" if is_replaced else "the file is gone"
            return "replaced" if is_replaced else "missing", (
                f"{name}: {found} that rigcal writes to, and what it records now is lost when it stops: move the file "
                f"back if it was moved; else save it first{self._copies()}, and then restart rigcal"
            )
        if damage := self._findings or self._store.damage:
            return "damaged", (
                f"{path}: the store is damaged ({damage}); acquisition goes on, jobs do not run, and nothing "
                "that is read from it can be trusted: stop rigcal, keep the file, and restore the store from a backup"
            )
        if self._check is not None and self._findings is None:
            return "checking", (
                f"{path}: the last run did not end in order, so the store is being checked for damage; acquisition "
                "goes on, and jobs wait"
            )
        return "ok", ""

    def _copies(self) -> str:
        """Commands that copy the open files, which have no name any more; "" where they cannot be told."""
        open_files = {}
        for fd in _descriptors():
            with contextlib.suppress(OSError):
                open_files[FileIdentity.of(Path(f"/proc/self/fd/{fd}"))] = f"/proc/{os.getpid()}/fd/{fd}"
        database, wal, _ = self._store.files.identities
        commands = [
            f"cp {open_files[file]} saved.sqlite{suffix}"
            for file, suffix in ((database, ""), (wal, "-wal"))
            if file is not None and file in open_files
        ]
        return f" (`{' && '.join(commands)}`)" if commands else ""

    # ---- the check for damage ----------------------------------------------------------------------------------------

    def _is_unsettled(self) -> bool:
        """True if the newest check never came to its end, or found damage."""
        try:
            checks = self._store.rows("SELECT result FROM store_checks ORDER BY id DESC LIMIT 1")
        except sqlite3.Error:
            return True
        return bool(checks) and checks[0]["result"] != SOUND

    def _search(self) -> None:
        lower_priority(UPKEEP_NICE)
        check = _CheckRow(self._store)
        while not self._has_searched(check):
            if self._stopping.wait(RETRY_S):
                return

    def _has_searched(self, check: _CheckRow) -> bool:
        """Make the check; False if it was stopped or cannot be made."""
        try:
            check.note(self._clock.now(), "started_")  # without a result, until there is one
            self._findings = self._damage()
            if self._findings is not None:
                check.note(self._clock.now(), "ended_", result=self._findings or SOUND)
        except Exception as error:  # a fault of rigcal: a store that nobody has checked is not known to be sound
            if str(error) != self._told:
                log.exception("%s: the check for damage has failed; it is made again", self._store.path)
            self._told = str(error)
        return self._findings is not None

    def _damage(self) -> str | None:
        """Search for damage: its description, "" if there is none; None if the check was stopped or cannot be made."""
        try:
            uri = f"{self._store.path.absolute().as_uri()}?mode=ro"
            connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
            with contextlib.closing(connection):
                self._connection = connection
                if self._stopping.is_set():
                    return None
                found = [str(row[0]) for row in connection.execute(f"PRAGMA quick_check({FINDINGS})")]
        except MemoryError:
            return None
        except sqlite3.DatabaseError as error:
            code = getattr(error, "sqlite_errorcode", None)  # a text that is none has no code, and is damage
            if self._stopping.is_set() or (code is not None and code & 0xFF in _HINDRANCES):
                return None
            return str(error)
        finally:
            self._connection = None
        return "" if found == ["ok"] else "; ".join(" ".join(line.split()) for line in found)


class _CheckRow:
    """A check's row in the store, written as soon as the store takes it: a full disk keeps no check from being made."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._row: dict[str, object] = {}
        self._id: int | None = None

    def note(self, now: Stamp, prefix: str, **about: str) -> None:
        """Write down that the check has begun or ended."""
        try:
            self._row |= {**self._store.instant(now, prefix), **about}
            if self._id is None:
                self._id = self._store.insert("store_checks", self._row)
            else:
                self._store.update("store_checks", {"id": self._id}, self._row)
        except sqlite3.Error as error:
            log.error("the store's check is not written down: %s", storage_sentence(self._store.path, error))


def _space(directory: Path) -> tuple[int | None, bool]:
    try:
        usage = shutil.disk_usage(directory)
    except OSError:
        return None, False
    return usage.free, usage.free < max(LOW_BYTES, min(LOW_SHARE * usage.total, LOW_SHARE_MOST_BYTES))


def _descriptors() -> list[str]:
    try:
        return os.listdir("/proc/self/fd")
    except OSError:
        return []
