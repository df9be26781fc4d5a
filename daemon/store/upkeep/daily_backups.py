"""Makes a backup of a store every day, in its own thread, so that a disk that does not respond blocks nothing else."""

from __future__ import annotations

import logging
from pathlib import Path

from daemon.host.priority import UPKEEP_NICE, lower_priority
from daemon.host.safe_output import duration
from daemon.host.worker_thread import WorkerThread
from daemon.store.errors import StoreError
from daemon.store.upkeep.backup import backups, make_backup
from drivers.clock import NS_PER_S, Clock, SystemClock

log = logging.getLogger(__name__)

LOOK_S = 10.0  # real seconds between checks
STOP_S = 5.0
DAY_S = 86_400.0
BACKUP_AFTER_S = 600.0  # running time before the first backup, so that it does not slow down a start
BACKUP_RETRY_S = 3600.0
LONGEST_S = 6 * 3600.0  # a backup that takes longer is reported as an error


class _StoppedError(Exception):
    """The daemon is stopping; the running backup is cancelled."""


class DailyBackups(WorkerThread):
    """Makes daily backups, the first of a run after some minutes.

    Args:
        store: the database.
        models: directory of the models.
        directory: directory of the backups.
        keep: how many backups are kept.
        clock: clock for the age and the names of backups.

    Attributes:
        newest_utc_ns: when the newest backup was made; None without a backup, and before the first step.
    """

    def __init__(self, store: Path, models: Path, directory: Path, keep: int, clock: Clock) -> None:
        super().__init__("backups", STOP_S)
        self._store, self._models, self._directory, self._keep, self._clock = store, models, directory, keep, clock
        self._real = SystemClock()
        self._next_ns = self._real.monotonic_ns() + round(BACKUP_AFTER_S * NS_PER_S)
        self._is_known = False
        self._since_ns: int | None = None  # when the running step began
        self._error = ""
        self.newest_utc_ns: int | None = None

    def error(self) -> str:
        """Return why the last backup failed, or has not ended; "" if nothing is wrong."""
        since_ns = self._since_ns
        if since_ns is not None:
            held_s = (self._real.monotonic_ns() - since_ns) / NS_PER_S
            if held_s > LONGEST_S:
                return f"{self._directory}: the backup has run for {duration(held_s)}, or the disk does not respond"
        return self._error

    def step(self) -> None:
        """Find the existing backups, and make the next one if it is due, however long that takes."""
        self._since_ns = self._real.monotonic_ns()
        try:
            if not self._is_known:
                made = backups(self._directory)
                self.newest_utc_ns = made[-1].made_utc_ns if made else None
                self._is_known = True
            if self._is_due():
                self._make()
        except _StoppedError:
            pass
        except Exception as error:  # including faults of rigcal, which must not end the daily backups
            if str(error) != self._error:
                is_told = isinstance(error, StoreError | OSError)
                log.error("the backup failed: %s", error, exc_info=None if is_told else error)
            self._error = str(error)
        finally:
            self._since_ns = None

    def _is_due(self) -> bool:
        if self._real.monotonic_ns() < self._next_ns:
            return False
        newest = self.newest_utc_ns
        return newest is None or abs(self._clock.now().utc_ns - newest) >= DAY_S * NS_PER_S

    def _make(self) -> None:
        self._next_ns = self._real.monotonic_ns() + round(BACKUP_RETRY_S * NS_PER_S)
        now_ns = self._clock.now().utc_ns
        made = make_backup(self._store, self._models, self._directory, self._keep, now_ns, self._go_on)
        log.info("backup %s made and verified, %.0f MiB", made.path, made.size_bytes / 2**20)
        self._error, self.newest_utc_ns = "", made.made_utc_ns

    def _go_on(self) -> None:
        if self._stopping.is_set():
            raise _StoppedError

    def _run(self) -> None:
        lower_priority(UPKEEP_NICE)
        while not self._stopping.wait(LOOK_S):
            self.step()
