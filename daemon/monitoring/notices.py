"""Notices: alarms that are sent from the machine, by a separate thread that nothing waits for.

A second thread writes them to the store, so that they are also sent while a write hangs.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from daemon.commands import CommandError, current_caller
from daemon.config.sections import NotifySection
from daemon.host.worker_thread import WorkerThread
from daemon.monitoring.delivery import Command, Target, Webhook
from daemon.monitoring.notice import Notice
from daemon.monitoring.outbox import USUAL, Outbox, Pace
from daemon.store.queries.notices import NoticeTable
from drivers.clock import Clock

log = logging.getLogger(__name__)

STOP_S = 5.0
REWRITE_S = 5.0  # between attempts to write to a store that cannot be written


class Notices:
    """Sends events of alarms to all targets.

    Args:
        section: targets of notices; None to store and send nothing.
        table: the store's table of notices.
        active: rows of the alarms that an earlier run left active.
        rig: name of the machine.
        clock: for times in the store.
        pace: how often messages are sent; the default is described in docs/reference/alarms.md.
    """

    def __init__(
        self,
        section: NotifySection | None,
        table: NoticeTable,
        active: Sequence[Mapping[str, Any]],
        rig: str,
        clock: Clock,
        *,
        pace: Pace | None = None,
    ) -> None:
        self._clock = clock
        self._outboxes = (
            []
            if section is None
            else [Outbox(target, table, rig, clock, pace or USUAL, section.least) for target in targets_of(section)]
        )
        for outbox in self._outboxes:
            outbox.reconcile(active, clock.now())
        self._inbox: list[Notice] = []
        self._changed = threading.Condition()
        self._is_stopping = False
        self._fault = ""  # last error of the thread itself
        self._thread = threading.Thread(target=self._run, name="notices", daemon=True)
        self._writer = _Writer(self._outboxes)
        self._status = [outbox.status() for outbox in self._outboxes]

    def start(self) -> None:
        """Start to send."""
        if self._outboxes:
            self._thread.start()
            self._writer.start()

    def stop(self) -> None:
        """Stop sending; pending notices stay in the store for the next start."""
        with self._changed:
            self._is_stopping = True
            self._changed.notify()
        for outbox in self._outboxes:
            outbox.target.cancel()
        if self._thread.is_alive():
            self._thread.join(STOP_S)
        self._writer.stop()

    def take(self, notice: Notice) -> None:
        """Queue a notice; from any thread, without waiting."""
        if self._outboxes:
            with self._changed:
                self._inbox.append(notice)
                self._changed.notify()

    def try_command(self, _arguments: Mapping[str, Any]) -> str:
        """Send a test notice, to see whether notices arrive."""
        if not self._outboxes:
            raise CommandError("no notices are sent: the configuration has no section [notify]; add it")
        now, caller = self._clock.now(), current_caller()
        text = f"requested by {caller}" if caller is not None else "requested"
        self.take(Notice("test", "test", "notices", "warning", text, "Nothing is wrong.", now, now))
        names = " and ".join(outbox.target.name for outbox in self._outboxes)
        return f"a test notice is being sent by {names}; `rigcal status` shows if it cannot be delivered"

    def status(self) -> list[dict[str, Any]]:
        """Return `target`, `waiting`, `sent`, `failures` and `error` of each target."""
        return self._status

    def faults(self) -> dict[str, str]:
        """Return target -> error of its last delivery if that failed; all targets if the thread itself has failed."""
        errors = {one["target"]: self._fault or one["error"] for one in self._status}
        return {target: error for target, error in errors.items() if error}

    # ---- the thread --------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._is_stopping:
            self._go_on(self._step)
        self._go_on(self._take_in)

    def _go_on(self, work: Callable[[], None]) -> None:
        """Do a step and go on after any error, as an error of rigcal must not stop notices for months."""
        try:
            work()
            self._fault = ""
        except Exception as error:
            fault = f"{type(error).__name__}: {error}"
            if fault != self._fault:
                log.exception("the thread that sends notices has failed and will try again")
            self._fault = fault
            with self._changed:
                self._changed.wait_for(lambda: self._is_stopping, REWRITE_S)

    def _step(self) -> None:
        with self._changed:
            if not self._inbox and not self._is_stopping:
                self._changed.wait(self._patience_s())
        self._take_in()
        for outbox in self._outboxes:
            if outbox.due_in_s() == 0.0 and not self._is_stopping:
                outbox.send()
        self._writer.write_soon()
        self._status = [outbox.status() for outbox in self._outboxes]

    def _take_in(self) -> None:
        with self._changed:
            taken = list(self._inbox)
        for outbox in self._outboxes:
            for notice in taken:
                outbox.add(notice)
        with self._changed:
            del self._inbox[: len(taken)]
        self._writer.write_soon()

    def _patience_s(self) -> float | None:
        """Return how long the thread may sleep, seconds; None to sleep until it is woken."""
        return min((due for outbox in self._outboxes if (due := outbox.due_in_s()) is not None), default=None)


class _Writer(WorkerThread):
    """Writes the notices of all outboxes to the store; repeats writes that fail."""

    def __init__(self, outboxes: Sequence[Outbox]) -> None:
        super().__init__("notices-store", STOP_S)
        self._outboxes = outboxes
        self._to_write = threading.Event()
        self._is_told = False  # whether it was logged that the store cannot be written

    def write_soon(self) -> None:
        """Write all changes soon, without waiting for that."""
        self._to_write.set()

    def stop(self) -> None:
        """Write pending changes and end the thread."""
        self._stopping.set()
        self._to_write.set()
        super().stop()

    def _run(self) -> None:
        is_last = False
        while not is_last:
            self._to_write.wait(None if all(outbox.is_written for outbox in self._outboxes) else REWRITE_S)
            self._to_write.clear()
            is_last = self._stopping.is_set()  # asked before the write: what is pending at a stop is still written
            self._write()

    def _write(self) -> None:
        try:
            for outbox in self._outboxes:
                outbox.write()
        except Exception:
            if not self._is_told:
                log.warning("notices cannot be written to the store; they are still sent", exc_info=True)
            self._is_told = True
        else:
            self._is_told = False


def targets_of(section: NotifySection) -> list[Target]:
    """Return the configured targets of notices."""
    targets: list[Target] = []
    if section.webhook_url is not None:
        targets.append(Webhook(section.webhook_url))
    if section.command:
        targets.append(Command(section.command))
    return targets
