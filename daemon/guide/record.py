"""The newest guide of a rig in the store: every event is stored before it takes effect."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import partial
from typing import Any

from daemon.commands import REFUSED, CommandError, CommandTurn, caller_columns
from daemon.guide.job import Job, Request
from daemon.guide.view import headline
from daemon.store.queries.guides import GuideRow, GuideTable
from daemon.store.store import Store
from drivers.clock import Clock

log = logging.getLogger(__name__)

GuideStep = tuple[int, str]
"""ID of a guide and of one of its steps; differs between all steps of all guides."""


class GuideRecord:
    """The newest guide, open or not.

    Args:
        store: the database.
        rig_name: name of the rig.
        clock: clock for the timestamps of events.

    Attributes:
        turn: to be held while several attributes are read or changed together.
        row, job: row and job of the newest guide; None before the first.
        taps: number of commands given to it.
        table: table of all guides.
    """

    def __init__(self, store: Store, rig_name: str, clock: Clock) -> None:
        self.turn = CommandTurn()
        self.row: GuideRow | None = None
        self.job: Job | None = None
        self.taps = 0
        self.table = GuideTable(store, rig_name)
        self._store, self._clock = store, clock

    @property
    def is_open(self) -> bool:
        """Return True while a guide is open."""
        job = self.job
        return job is not None and job.state == "open"

    def opened(self) -> tuple[GuideRow, Job] | None:
        """Return the open guide; None if there is none."""
        row, job = self.row, self.job
        return (row, job) if row is not None and job is not None and job.state == "open" else None

    @property
    def step(self) -> GuideStep | None:
        """The open guide and its step; None if there is none."""
        guide = self.opened()
        return None if guide is None else (guide[0].id, guide[1].step_id)

    def needs_step(self, arguments: Mapping[str, Any]) -> tuple[Job, str]:
        """Return the job and its step; CommandError without an open guide or if `step` names a different step."""
        job = self.job
        if job is None or job.state != "open":
            raise CommandError("no guide is open; `rigcal session guide --prisms w,b,r,s` starts one")
        meant = arguments.get("step")
        if meant is not None and meant != job.step_id:
            raise CommandError(f"the guide is now at a different step: {headline(job)}", REFUSED)
        return job, job.step_id

    def open(self, request: Request, setup_id: str, operator: str) -> None:
        """Open a guide."""
        with self._store.transaction():
            self.table.open(self._clock.now(), setup_id, operator, request.as_dict(), **caller_columns())
            self._store.once_committed(partial(self._take, self.table.newest(), Job.of(request)))
            self._store.once_committed(partial(self._count, 1))

    def tapped(self) -> None:
        """Count a command given to the guide."""
        taps = self.taps + 1
        with self._store.transaction():
            if self.row is not None:
                self.table.count_taps(self.row.id, taps)
            self._store.once_committed(partial(self._count, taps))

    def happen(self, kind: str, details: Mapping[str, Any], only_at: GuideStep | None = None) -> tuple[Job, Job] | None:
        """Store an event, which takes effect once it is committed.

        Args:
            kind: kind of the event, as in `job`.
            details: details of the event, as in `job`.
            only_at: step at which the event must happen; None for any.

        Returns:
            The states before and after; None if the guide is not open or at a step other than `only_at`.

        Raises:
            CommandError: the event cannot happen at the guide's step.
        """
        row, before = self.row, self.job
        if row is None or before is None or before.state != "open" or only_at not in (None, self.step):
            return None
        try:
            job, at = before.after(kind, details), self._clock.now()
        except ValueError as error:
            raise CommandError(f"{error}; the guide is at this step: {headline(before)}", REFUSED) from error
        with self._store.transaction():
            self.table.add(row.id, kind, details, at, **caller_columns())
            if job.state != "open":
                self.table.end(row.id, job.state, at)
            self._store.once_committed(partial(self._take, self.table.newest(), job))
        return before, job

    def _take(self, row: GuideRow | None, job: Job) -> None:
        self.row, self.job = row, job
        if row is not None and job.state != "open":
            log.info("guide %d is %s", row.id, job.state)

    def _count(self, taps: int) -> None:
        self.taps = taps

    def restore(self) -> None:
        """Restore the guide that an earlier run of the daemon left."""
        row = self.table.newest()
        if row is None:
            return
        job = Job.of(Request.of(row.request))
        for event in self.table.events(row.id):
            job = job.after(event.kind, event.details)
        self.row, self.job, self.taps = row, job, row.taps
        if job.state == "open":
            log.warning("guide %d was open when rigcal last ended; it continues: %s", row.id, headline(job))
