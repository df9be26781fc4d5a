"""Makes a backup of a store every day, in a thread of its own: a disk that does not answer holds up nothing else."""

from __future__ import annotations

import logging
import threading
from pathlib import Path

from daemon.host.priority import UPKEEP_NICE, lower_priority
from daemon.host.safe_output import duration
from daemon.store.errors import StoreError
from daemon.store.upkeep.backup import backups, make_backup
from drivers.clock import NS_PER_S, Clock, SystemClock

log = logging.getLogger(__name__)

LOOK_S = 10.0  # real seconds between looks
STOP_S = 5.0
DAY_S = 86_400.0
BACKUP_AFTER_S = 600.0  # of running: not in the midst of a start
BACKUP_RETRY_S = 3600.0
LONGEST_S = 6 * 3600.0  # that a disk may take without a word


class _StoppedError(Exception):
    """The daemon stops; a backup in work is given up."""


class DailyBackups:
    """Makes backups, the first of a run after some minutes.

    Args:
        store: the database.
        models: directory of the models.
        directory: where backups are.
        keep: how many are kept.
        clock: for the age and the names of backups.

    Attributes:
        newest_utc_ns: when the newest backup was made; None without one, and before the first step.
    """

    def __init__(self, store: Path, models: Path, directory: Path, keep: int, clock: Clock) -> None:
        self._store, self._models, self._directory, self._keep, self._clock = store, models, directory, keep, clock
        self._real = SystemClock()
        self._next_ns = self._real.monotonic_ns() + round(BACKUP_AFTER_S * NS_PER_S)
        self._is_known = False
        self._since_ns: int | None = None  # when the step in work began
        self._error = ""
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self.newest_utc_ns: int | None = None

    def start(self) -> None:
        """Begin."""
        self._thread = threading.Thread(target=self._run, name="backups", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End; a backup in work is given up. Harmless when not started."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(STOP_S)

    def error(self) -> str:
        """Return why the last backup could not be made, or is not made; "" where all is well."""
        since_ns = self._since_ns
        if since_ns is not None:
            held_s = (self._real.monotonic_ns() - since_ns) / NS_PER_S
            if held_s > LONGEST_S:
                return f"{self._directory} has been busy for {duration(held_s)}, or its disk does not answer"
        return self._error

    def step(self) -> None:
        """Look which backups there are, and make the next if it is due, however long that takes."""
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
        except Exception as error:  # a fault of rigcal, too: it must not end the backups of months
            if str(error) != self._error:
                is_told = isinstance(error, StoreError | OSError)
                log.error("no backup was made: %s", error, exc_info=None if is_told else error)
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
