"""Health of the store: its files are the opened ones, are sound, and have space to grow.

After an unclean shutdown (a power cut, a kill, a full disk), or after damage was found, SQLite's `quick_check` is run
at the next start, in parallel with acquisition. The files are checked with every heartbeat of the daemon.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import sqlite3
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from daemon.host.priority import UPKEEP_NICE, lower_priority
from daemon.store.errors import storage_sentence
from daemon.store.files import FileIdentity
from daemon.store.store import Store
from daemon.store.write_ahead_log import log_bytes, reader_of
from drivers.clock import Clock, Stamp, TimeBudget

log = logging.getLogger(__name__)

HealthState = Literal["ok", "checking", "damaged", "replaced", "missing"]

AT_START_S = 3.0  # wait for the check at the start, so that the state of a small store is known from the beginning
STOP_S = 5.0
LOW_BYTES = 2**30
LOW_SHARE = 0.05
LOW_SHARE_MOST_BYTES = 10 * 2**30
LONG_LOG_BYTES = 256 * 2**20  # several minutes in which the log could not be emptied
FINDINGS = 5
RETRY_S = 5.0
# Errors that prevent a check but do not concern the store: no descriptors, no memory, a lock, a full disk.
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
        state: ok; checking: it is being checked for damage; damaged: damage was found; replaced, missing: a file of it
            is not the one that the daemon has open, or was removed.
        text: what is wrong and what to do, a sentence; "" if nothing is wrong.
        since: when it entered this state.
        free_bytes: free space on the store's disk; None if the file system cannot be read.
        is_low: less than 1 GiB is free, or less than both 5 % of the disk and 10 GiB.
        log_fault: why the store's log, which has grown long, cannot be emptied, a clause; "" if it can.
        is_log_stuck: the log needs more free space to be emptied than there is.
    """

    state: HealthState
    text: str
    since: Stamp
    free_bytes: int | None
    is_low: bool
    log_fault: str = ""
    is_log_stuck: bool = False

    @property
    def is_unsound(self) -> bool:
        """True if the store cannot be trusted."""
        return self.state in ("damaged", "replaced", "missing")

    def as_dict(self) -> dict[str, Any]:
        """Return the health as `status` shows it."""
        return {
            "state": self.state,
            "text": self.text,
            "since_utc_ns": self.since.utc_ns,
            "free_bytes": self.free_bytes,
            "is_low": self.is_low,
            "log_fault": self.log_fault,
        }


class StoreWatch:
    """Monitors a store that is open for writing.

    Args:
        store: the store; a run must have begun.
        clock: clock for the instants of findings.

    Attributes:
        health: present health of the store; may be read from any thread.
    """

    def __init__(self, store: Store, clock: Clock) -> None:
        self._store, self._clock = store, clock
        self._findings: str | None = None  # result of the check; None until it has finished
        self._told = ""  # the error of the check that was logged last
        self._size_bytes = 0  # of the database, at the last look
        self._stopping = threading.Event()
        self._connection: sqlite3.Connection | None = None
        self._check: threading.Thread | None = None
        self.health = StoreHealth("ok", "", clock.now(), None, is_low=False)

    def start(self) -> None:
        """Start the check for damage, if one is due, and wait a short time for its end."""
        if not self._store.ended_in_order or self._is_unsettled():
            self._check = threading.Thread(target=self._search, name="store-check", daemon=True)
            self._check.start()
            self._check.join(AT_START_S)
        self.look()

    def stop(self) -> None:
        """Stop a running check; the next start repeats it."""
        self._stopping.set()
        budget = TimeBudget(STOP_S)
        while self._check is not None and self._check.is_alive() and not budget.is_over:
            if self._connection is not None:
                with contextlib.suppress(sqlite3.ProgrammingError):  # closed meanwhile
                    self._connection.interrupt()
            self._check.join(0.05)

    def look(self) -> None:
        """Check files and free space; takes microseconds, unless the file system hangs."""
        state, text = self._state()
        free_bytes, is_low = _space(self._store.path.parent)
        before = self.health
        since = before.since if state == before.state else self._clock.now()
        self.health = StoreHealth(state, text, since, free_bytes, is_low, *self._log_fault(free_bytes))
        if state == before.state:
            return
        if text:
            log.log(logging.INFO if state == "checking" else logging.CRITICAL, "%s", text)
        else:
            log.info("%s: the store is sound again", self._store.path)

    def _state(self) -> tuple[HealthState, str]:
        path = self._store.path
        try:
            changed = self._store.files.changed()
            size_bytes = path.stat().st_size if changed is None else self._size_bytes
        except OSError as error:
            return "missing", f"{path}: cannot be accessed ({error.strerror}): check the disk; `dmesg` may show why"
        if changed is not None:
            name, is_replaced = changed
            found = "was replaced by another file" if is_replaced else "is gone"
            return "replaced" if is_replaced else "missing", (
                f"{name}: the file that rigcal writes to {found}, and its data are lost when rigcal stops: move the "
                f"file back if it was moved; otherwise save it first{self._copies()}, then restart rigcal"
            )
        if size_bytes < self._size_bytes:
            self._store.damage = self._store.damage or "the file has become smaller: another program has overwritten it"
        self._size_bytes = size_bytes
        if damage := self._findings or self._store.damage:
            return "damaged", (
                f"{path}: the store is damaged: stop rigcal, keep the file, and restore the store from a backup; "
                f"acquisition continues, but jobs do not run, and stored data cannot be trusted ({damage})"
            )
        if self._check is not None and self._findings is None:
            return "checking", (
                f"{path}: the last shutdown was unclean, so the store is being checked for damage; acquisition "
                "continues, and jobs wait"
            )
        return "ok", ""

    def _log_fault(self, free_bytes: int | None) -> tuple[str, bool]:
        """Return why a long log cannot be emptied, and whether there is too little free space for that."""
        try:
            size_bytes = log_bytes(self._store.path)
        except OSError:
            return "", False
        if size_bytes <= LONG_LOG_BYTES:
            return "", False
        reader = reader_of(self._store.path)
        is_stuck = free_bytes is not None and free_bytes < size_bytes
        reasons = [f"{reader} does not finish reading the store"] if reader is not None else []
        if is_stuck:
            reasons.append(f"that may need {size_bytes / 2**20:.0f} MiB of free space, and the disk has less")
        return "; ".join(reasons), is_stuck

    def _copies(self) -> str:
        """Return shell commands that copy the open files, which have lost their names; "" if they are not found."""
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
        """Return True if the newest check did not finish, or found damage."""
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
        """Run the check; return False if it was stopped or cannot be run."""
        try:
            check.note(self._clock.now(), "started_")  # the result is added at the end
            self._findings = self._damage()
            if self._findings is not None:
                check.note(self._clock.now(), "ended_", result=self._findings or SOUND)
        except Exception as error:  # a fault of rigcal: without a finished check the store is not known to be sound
            if str(error) != self._told:
                log.exception("%s: the check for damage has failed; retrying", self._store.path)
            self._told = str(error)
        return self._findings is not None

    def _damage(self) -> str | None:
        """Return a description of damage, "" if there is none; None if the check was stopped or cannot be run."""
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
            code = getattr(error, "sqlite_errorcode", None)  # no code: invalid text, which is damage
            if self._stopping.is_set() or (code is not None and code & 0xFF in _HINDRANCES):
                return None
            return str(error)
        finally:
            self._connection = None
        return "" if found == ["ok"] else "; ".join(" ".join(line.split()) for line in found)


class _CheckRow:
    """A check's row in the store, written as soon as possible: a check also runs while the disk is full."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._row: dict[str, object] = {}
        self._id: int | None = None

    def note(self, now: Stamp, prefix: str, **about: str) -> None:
        """Store the start or the end of the check.

        Args:
            now: the instant.
            prefix: `started_` or `ended_`.
            about: further columns of the row.
        """
        try:
            self._row |= {**self._store.instant(now, prefix), **about}
            if self._id is None:
                self._id = self._store.insert("store_checks", self._row)
            else:
                self._store.update("store_checks", {"id": self._id}, self._row)
        except sqlite3.Error as error:
            log.error("the store's check cannot be recorded: %s", storage_sentence(self._store.path, error))


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
