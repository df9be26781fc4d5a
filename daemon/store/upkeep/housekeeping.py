"""Maintenance of a store while the daemon writes to it: packing of captures, deletion by age and space, and backups.

All of it runs in threads of low priority, and packing and deletion in bounded steps, because acquisition comes first.
Backups have their own thread, because their disk may not respond for a long time.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from daemon.commands import CommandError, number_argument
from daemon.host.priority import UPKEEP_NICE, lower_priority
from daemon.host.worker_thread import WorkerThread
from daemon.store.errors import StoreError, storage_sentence
from daemon.store.store import Store
from daemon.store.upkeep.daily_backups import DailyBackups
from daemon.store.upkeep.packing import Packing
from daemon.store.upkeep.retention import Retention, cutoff_ns, room
from drivers.clock import NS_PER_S, Clock, SystemClock

log = logging.getLogger(__name__)

LOOK_S = 10.0  # real seconds between checks
PAUSE_S = 0.2  # between one step and the next
ROOM_S = 60.0  # between two checks of free space
STOP_S = 5.0
DAY_S = 86_400.0
LEAST_DAYS, MOST_DAYS = 1.0, 36_500.0  # limits of the days that a command keeps
# At most this many days of records are deleted by age in one day, so that a wrong clock cannot delete a year.
AGED_DAYS = 7.0


@dataclass(frozen=True)
class Keeping:
    """Limits of what the store keeps.

    Attributes:
        keep_days: older captures outside sessions are deleted; None for no limit.
        free_bytes: free space that the store should have.
        models: directory of the models.
        backup_directory: directory of daily backups; None for no backups.
        backups: how many backups are kept.
    """

    keep_days: float | None
    free_bytes: int
    models: Path
    backup_directory: Path | None
    backups: int


@dataclass(frozen=True)
class KeepingState:
    """State of housekeeping.

    Attributes:
        is_short: there is less free space than there should be.
        deleted_until_utc_ns: captures outside sessions up to this instant were deleted for lack of space; None if none
            were.
        has_nothing_left: there is too little space, and nothing more may be deleted.
        newest_backup_utc_ns: when the newest backup was made; None without one.
        backup_error: why the last backup failed; "" if it did not.
        has_backups: backups are configured.
    """

    is_short: bool = False
    deleted_until_utc_ns: int | None = None
    has_nothing_left: bool = False
    newest_backup_utc_ns: int | None = None
    backup_error: str = ""
    has_backups: bool = False


class Housekeeping(WorkerThread):
    """Maintains a store, in its own threads.

    Args:
        store: the database, open for writing.
        clock: clock for the age of captures and the names of backups.
        keeping: limits of what is kept.
    """

    def __init__(self, store: Store, clock: Clock, keeping: Keeping) -> None:
        super().__init__("housekeeping", STOP_S)
        self._store, self._clock, self._keeping = store, clock, keeping
        self._packing, self._retention = Packing(store), Retention(store, clock)
        self._real = SystemClock()
        self._told = ""
        self._told_of_room: set[str] = set()
        self._turn = threading.Lock()  # for steps, because a command may delete as well
        self._began_ns = self._real.monotonic_ns()
        self._next_room_s = 0.0
        self._aged_until: tuple[float, int] | None = None  # running time of the next pass by age, and where it ends
        self._room = KeepingState(has_backups=keeping.backup_directory is not None)
        self._backups = (
            None
            if keeping.backup_directory is None
            else DailyBackups(store.path, keeping.models, keeping.backup_directory, keeping.backups, clock)
        )

    @property
    def state(self) -> KeepingState:
        """State of free space and of the newest backup; may be read from any thread."""
        made = self._backups
        if made is None:
            return self._room
        return replace(self._room, newest_backup_utc_ns=made.newest_utc_ns, backup_error=made.error())

    def start(self) -> None:
        """Start the threads."""
        if self._backups is not None:
            self._backups.start()
        super().start()

    def stop(self) -> None:
        """Stop after the running step. Harmless when not started."""
        self._stopping.set()  # both end side by side
        if self._backups is not None:
            self._backups.stop()
        super().stop()

    def _run(self) -> None:
        lower_priority(UPKEEP_NICE)
        pause_s = LOOK_S
        while not self._stopping.wait(pause_s):
            pause_s = PAUSE_S if self.step() else LOOK_S

    def step(self) -> bool:
        """Do a bounded part of the work that is due.

        Returns:
            Whether there may be more.
        """
        try:
            with self._turn:
                return self._make_room() or self._packing.pack_next() or self._forget_old()
        except sqlite3.Error as error:
            log.warning("maintenance of the store failed; retrying: %s", storage_sentence(self._store.path, error))
        except (StoreError, OSError) as error:
            log.warning("maintenance of the store failed; retrying: %s", error)
        except Exception as error:  # a fault of rigcal must not end the maintenance for months
            if str(error) != self._told:
                log.exception("maintenance of the store failed; retrying")
            self._told = str(error)
        return False

    def prune_command(self, arguments: Mapping[str, Any], go_on: Callable[[], None]) -> dict[str, Any]:
        """Delete captures and readings outside sessions that are older than `days`; for operators, in any thread.

        Args:
            arguments: `days`.
            go_on: called between steps; an exception that it raises ends the work.
        """
        days = number_argument(arguments, "days")
        if days is None or not LEAST_DAYS <= days <= MOST_DAYS:
            raise CommandError(f"days must be {LEAST_DAYS:g} to {MOST_DAYS:g}, not {days!r:.80}")
        newest_ns = self._prune(self._clock.now().utc_ns - round(days * DAY_S * NS_PER_S), go_on)
        return {"deleted_until_utc_ns": newest_ns}

    def _prune(self, older_than_ns: int, go_on: Callable[[], None]) -> int | None:
        """Delete all older captures that may be deleted; return the UTC in ns of the newest one, or None."""
        newest: int | None = None
        while True:
            go_on()
            with self._turn:
                deleted = self._retention.delete_oldest(older_than_ns)
            if deleted is None:
                return newest
            newest = deleted

    def _running_s(self) -> float:
        return (self._real.monotonic_ns() - self._began_ns) / NS_PER_S

    def _make_room(self) -> bool:
        if self._running_s() < self._next_room_s:
            return False
        found = room(self._store, self._keeping.free_bytes)
        if not found.is_short:
            if self._room.is_short:
                log.info("%s: there is enough space again", self._store.path)
                self._told_of_room.clear()
                self._room = replace(self._room, is_short=False, has_nothing_left=False)
            self._next_room_s = self._running_s() + ROOM_S
            return False
        deleted = self._retention.delete_oldest()
        if deleted is None:
            self._tell_once("little space is left, and nothing more may be deleted")
            self._room = replace(self._room, is_short=True, has_nothing_left=True)
            self._next_room_s = self._running_s() + ROOM_S
            return False
        self._tell_once("little space is left; the oldest captures outside sessions are deleted")
        self._room = replace(self._room, is_short=True, has_nothing_left=False, deleted_until_utc_ns=deleted)
        return True

    def _tell_once(self, what: str) -> None:
        """Log an action for lack of space, once until there is enough space again."""
        if what not in self._told_of_room:
            self._told_of_room.add(what)
            log.warning("%s: %s", self._store.path, what)

    def _forget_old(self) -> bool:
        if self._keeping.keep_days is None:
            return False
        now_ns = self._clock.now().utc_ns
        limit_ns = cutoff_ns(now_ns, self._keeping.keep_days)
        if limit_ns is None:
            return False
        if self._aged_until is None or self._running_s() >= self._aged_until[0]:
            today = now_ns // round(DAY_S * NS_PER_S)
            if self._retention.aged_on() == today:  # by an earlier run
                return False
            oldest = self._retention.oldest_ns()
            if oldest is None:
                return False
            self._retention.note_aged(today)
            self._aged_until = self._running_s() + DAY_S, oldest + round(AGED_DAYS * DAY_S * NS_PER_S)
        return self._retention.delete_oldest(min(limit_ns, self._aged_until[1])) is not None
