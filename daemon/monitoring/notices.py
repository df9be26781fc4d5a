"""Notices: alarms that are sent from the machine, by threads that nothing waits for.

Each target has a thread, so that none waits for another. One more writes notices to the store, so that they are also
sent while a write hangs.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from daemon.commands import CommandError, current_caller
from daemon.config.sections import NotifySection
from daemon.host.worker_thread import WokenThread
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
        self._writer = _Writer(self._outboxes)
        self._senders = [_Sender(outbox, self._writer.wake) for outbox in self._outboxes]

    def start(self) -> None:
        """Start to send."""
        if self._senders:
            for thread in (*self._senders, self._writer):
                thread.start()

    def stop(self) -> None:
        """Stop sending; pending notices stay in the store for the next start."""
        for sender in self._senders:
            sender.cancel()
        for thread in (*self._senders, self._writer):
            thread.stop()

    def take(self, notice: Notice) -> None:
        """Queue a notice; from any thread, without waiting."""
        for sender in self._senders:
            sender.take(notice)

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
        return [sender.status for sender in self._senders]

    def faults(self) -> dict[str, str]:
        """Return target -> error of its last delivery if that failed, or of its thread."""
        errors = {sender.status["target"]: sender.fault or sender.status["error"] for sender in self._senders}
        return {target: error for target, error in errors.items() if error}


class _Sender(WokenThread):
    """Sends the notices of one target.

    Args:
        outbox: the target's notices.
        write_soon: has changes of the outbox written to the store.

    Attributes:
        status: state of the outbox, as `Outbox.status` returns it.
        fault: last error of the thread itself; "" if it works.
    """

    def __init__(self, outbox: Outbox, write_soon: Callable[[], None]) -> None:
        super().__init__(f"notices-{outbox.target.name}", STOP_S)
        self._outbox, self._write_soon = outbox, write_soon
        self._inbox: deque[Notice] = deque()
        self.status, self.fault = outbox.status(), ""

    def take(self, notice: Notice) -> None:
        """Queue a notice; from any thread, without waiting."""
        self._inbox.append(notice)
        self.wake()

    def cancel(self) -> None:
        """End the present delivery, and ask the thread to end."""
        self._stopping.set()
        self._outbox.target.cancel()

    def _patience_s(self) -> float | None:
        return 0.0 if self._inbox else self._outbox.due_in_s()

    def _work(self) -> None:
        """Take in new notices and send what is due; go on after any error, as notices must not stop for months."""
        try:
            while self._inbox:
                self._outbox.add(self._inbox[0])
                self._inbox.popleft()
            if self._outbox.due_in_s() == 0.0 and not self._stopping.is_set():
                self._outbox.send()
            self.status, self.fault = self._outbox.status(), ""
        except Exception as error:
            fault = f"{type(error).__name__}: {error}"
            if fault != self.fault:
                log.exception("the thread %s has failed and will try again", self._thread.name)
            self.fault = fault
            self._stopping.wait(REWRITE_S)
        finally:
            self._write_soon()


class _Writer(WokenThread):
    """Writes the notices of all outboxes to the store; repeats writes that fail."""

    def __init__(self, outboxes: Sequence[Outbox]) -> None:
        super().__init__("notices-store", STOP_S)
        self._outboxes = outboxes
        self._is_told = False  # whether it was logged that the store cannot be written

    def _patience_s(self) -> float | None:
        return None if all(outbox.is_written for outbox in self._outboxes) else REWRITE_S

    def _work(self) -> None:
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
