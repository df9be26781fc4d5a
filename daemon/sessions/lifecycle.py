"""Every way in which a calibration session changes its state, and whether calibration may use it.

A session is open, then closed or aborted. When it is closed it is decided whether calibration may use it: where no
control point shows that the station stood still from its start to its end, it may not, until an operator accepts it;
where another rig file than today's turned counts into its readings, it may not as long as that file is not in use; and
where an encoder has jumped since, as long as nobody has checked the joint's zero.
Each change is one transaction.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from calibration.rig.decoding import without_decoding
from calibration.rig.description import Rig
from daemon.commands import REFUSED, CommandError, caller_columns
from daemon.host.time_service import ClockState
from daemon.rig_files import HOW_TO_READ_AGAIN, misreading
from daemon.sessions.open_session import CONSTANT_TOLERANCE_MM, OpenSession
from daemon.store.connection import rig_sha256
from daemon.store.queries.jobs import JobTable
from daemon.store.queries.observations import first_constants_mm
from daemon.store.queries.sessions import OTHER_RIG_FILE, ZERO_LOST, SessionTable, session
from daemon.store.queries.setups import SetupTable
from daemon.store.queries.zeros import lost_zeros, preset_jumps
from daemon.store.store import Store
from drivers.clock import Clock, Stamp

log = logging.getLogger(__name__)

NOT_SHOT = "no control point was shot at its start and again at its end, so nothing shows that the station stood still"
NOT_ENCLOSED = "most of its poses do not lie between a control point's shots at its start and at its end"
NOT_THE_SAME = (
    "the control point that was shot at its start was not shot at its end, and another one was, whose first shot came "
    "after some poses: those may have been measured from another place"
)
LEAST_ENCLOSED = 0.25  # of its poses; some come before the operator gets to the first shot, or after the last


class SessionLifecycle:
    """The sessions of a rig.

    Args:
        store: the database.
        rig: whose sessions are opened.
        clock: time of the changes.
        tolerance_mm: a control point further off than this says that the station moved.
        clock_state: returns how the computer's clock is; None where it is not that of the session.

    Attributes:
        table: of the sessions.
    """

    def __init__(
        self,
        store: Store,
        rig: Rig,
        clock: Clock,
        tolerance_mm: float,
        clock_state: Callable[[], ClockState | None] = lambda: None,
    ) -> None:
        self._store, self._rig, self._clock, self._tolerance_mm = store, rig, clock, tolerance_mm
        self._clock_state = clock_state
        self.table, self._setups = SessionTable(store, rig.name), SetupTable(store, rig.name)
        self._jobs = JobTable(store, rig.name)

    def unfinished(self, rig_text: str) -> tuple[OpenSession | None, list[OpenSession]]:
        """The rig's open session, and those that have ended and whose last captures were not decoded yet.

        A session is of one rig file: one that was started with another is closed, and gets no more fixes. One that has
        the file alone, as the store kept it before it kept the decoding of channels, goes on.
        """
        opened: OpenSession | None = None
        ended: list[OpenSession] = []
        bare = without_decoding(rig_text)
        own = {rig_sha256(text) for text in (rig_text, bare, bare.removesuffix("\n"))}
        for row in self.table.unfinished():
            if row["rig"] != self._rig.name:
                if row["state"] == "open":
                    log.warning(
                        "session %s of rig %s is open; it goes on when rigcal runs that rig", row["id"], row["rig"]
                    )
                continue
            if row["rig_sha256"] not in own:
                if row["state"] == "open":
                    self._close_of_another_file(row)
                continue
            since, until = self._store.stamp(row, "started_"), self._store.stamp_or_none(row, "ended_")
            order = self._store.order
            found = OpenSession(row["id"], row["setup_id"], row["prism"], row["kind"], order, since, until)
            if until is None:
                opened = found
            else:
                ended.append(found)
        return opened, ended

    def _close_of_another_file(self, row: Mapping[str, Any]) -> None:
        """Close a session that was open when the last run ended, as of then, since the rig's file has changed."""
        why = "closed by rigcal: the rig file was changed while it was open"
        last = self._store.previous_end or self._clock.now()
        ended = max(self._store.stamp(row, "started_"), last, key=self._store.order)
        with self._store.transaction():
            self.table.change(
                row["id"],
                state="closed",
                note="; ".join(filter(None, (row["note"], why))),
                excluded=self._why_not_used(row["id"]),
                **self._store.instant(ended, "ended_"),
            )
        log.warning("session %s (prism %s): %s; start another one", row["id"], row["prism"], why)

    def jumped(self, session: OpenSession) -> dict[str, Stamp]:
        """Devices whose encoders have jumped in a session, since when."""
        jumped: dict[str, Stamp] = {}
        for jump in preset_jumps(self._store, session.since):
            if session.lasted(jump.at):
                jumped.setdefault(jump.device, jump.at)
        return jumped

    def start(self, started: Stamp, session_id: str, rig_text: str, **columns: object) -> None:
        """Add an open session of the rig, which its file describes."""
        with self._store.transaction():
            self.table.start(started, rig_text, id=session_id, **columns)
            self._note_clock(session_id, "start")

    def _note_clock(self, session_id: str, phase: str) -> None:
        state = self._clock_state()
        if state is not None:
            self.table.note_clock(session_id, phase, state)

    def end(self, session_id: str, state: str) -> Stamp:
        """Close or abort a session.

        Returns:
            When: no fix that was measured later is stored as its observation.
        """
        with self._store.transaction():
            ended = self._clock.now()  # in the transaction: the writer's thread may have held the store for long
            excluded = self._why_not_used(session_id) if state == "closed" else None
            self.table.change(session_id, state=state, excluded=excluded, **self._store.instant(ended, "ended_"))
            self._note_clock(session_id, "end")
        return ended

    def judge_again(self, session_id: str) -> None:
        """Decide anew whether calibration may use a closed session, of which more was decoded after its end."""
        with self._store.transaction():
            self.table.exclude_closed(session_id, self._why_not_used(session_id))

    def judge_readings(self) -> None:
        """Decide anew whether calibration may use the closed sessions: rig file or zeros may be others than theirs."""
        with self._store.transaction():
            for row in self.table.closed():
                self._judge_readings(row)

    def judge_zeros(self) -> None:
        """Decide anew whether calibration may use closed sessions: an encoder has jumped, maybe once again."""
        with self._store.transaction():
            for row in self.table.closed():
                if not (row["excluded"] or "").startswith(OTHER_RIG_FILE):
                    self._judge_readings(row)

    def _judge_readings(self, closed: Mapping[str, Any]) -> None:
        session_id, excluded = closed["id"], closed["excluded"]
        why = self._why_other_readings(self._row(session_id))
        if why is None and not _has_other_readings(closed):
            return
        if closed["accepted_despite"] is None:
            why = self._why_not_used(session_id)
        if why != excluded:
            self.table.change(session_id, excluded=why)
            told = f"is not used: {why}" if why else "is used again"
            self._store.once_committed(partial(log.warning, "session %s %s", session_id, told))

    def _row(self, session_id: str) -> dict[str, Any]:
        row = session(self._store, session_id)
        assert row is not None  # no session is ever deleted
        return row

    def _why_other_readings(self, row: Mapping[str, Any]) -> str | None:
        """Return why a session's readings are not those of the rig as it is now, a clause; None where they are.

        An operator who accepts a session says that the zeros are those that it was measured with.
        """
        if why := misreading(self._rig, row["rig_text"], row["prism"]):
            return f"{OTHER_RIG_FILE}{why}"
        lost = lost_zeros(self._store, self._rig.name, self.table.zeros_known(row))
        joints = [name for name in self._rig.joint_names if name in lost]
        return f"{ZERO_LOST}{', '.join(joints)}" if joints else None

    def accept(self, session_id: str, operator: str) -> str:
        """Let calibration use a closed session from now on, on an operator's word.

        Returns:
            The reason for which it was not used.

        Raises:
            CommandError: it is not closed, or it is used anyway.
            NotInStoreError: there is no such session.
        """
        with self._store.transaction():
            state, despite = self.table.state_and_exclusion(session_id)
            if state != "closed":
                why = "open; stop it first" if state == "open" else "aborted, and stays so"
                raise CommandError(f"session {session_id!r} is {why}")
            if despite is None:
                raise CommandError(f"session {session_id!r} is used by calibration; there is nothing to accept")
            if despite.startswith(OTHER_RIG_FILE):
                raise CommandError(f"session {session_id!r}: {despite}; {HOW_TO_READ_AGAIN}", REFUSED)
            self.table.change(
                session_id,
                excluded=None,
                accepted_despite=despite,
                accepted_by=operator,
                accepted_after_job=self._jobs.newest_id(),
                **caller_columns("accepted_"),
                **self._store.instant(self._clock.now(), "accepted_"),
            )
        return despite

    def _why_not_used(self, session_id: str) -> str | None:
        """Why calibration must not use a session, a clause; None where a control point shows that it may."""
        row = self._row(session_id)
        reasons = self._why_other_readings(row), self._why_other_constant(row), self._why_moved(session_id)
        return "; ".join(filter(None, reasons)) or None

    def _why_other_constant(self, row: Mapping[str, Any]) -> str | None:
        """Return why a session's distances do not fit those of others, a clause: another prism constant was set.

        It is held against what the set-up's description says, else against the newest session that is used there.
        """
        said_mm = self._setups.constants_mm(row["setup_id"]).get(row["prism"])
        like = self.table.used_like(row["id"])
        for station, mm in first_constants_mm(self._store, row["id"]).items():
            if said_mm is not None:
                other_mm, where = said_mm, f"set-up {row['setup_id']} says"
            else:
                other_mm = mm if like is None else first_constants_mm(self._store, like).get(station, mm)
                where = f"session {like} has"
            if abs(mm - other_mm) > CONSTANT_TOLERANCE_MM:
                return f"{station} applied a prism constant of {mm:g} mm to {row['prism']}, and {where} {other_mm:g} mm"
        return None

    def _why_moved(self, session_id: str) -> str | None:
        """Return why a session's station may have moved, a clause; None where a control point shows that it did not."""
        for shot in self.table.shots(session_id):
            if shot["misclosure_mm"] is not None and shot["misclosure_mm"] > self._tolerance_mm:
                off = f"control point {shot['point']} was {shot['misclosure_mm']:.1f} mm off at its {shot['phase']}"
                return f"{off}, so the station had moved"
        again = self.table.moved_between(session_id)
        if again is not None and again[1] > self._tolerance_mm:
            return (
                f"control point {again[0]} was {again[1]:.1f} mm off when it was shot again, so the station had moved"
            )
        if not self.table.points_shot(session_id, "start") & self.table.points_shot(session_id, "end"):
            return NOT_SHOT
        if self.table.has_poses_before_enclosed(session_id):
            return NOT_THE_SAME
        poses, enclosed = self.table.count_poses(session_id)
        return NOT_ENCLOSED if enclosed < LEAST_ENCLOSED * poses else None


def _has_other_readings(closed: Mapping[str, Any]) -> bool:
    """Return True if a session is not used since its readings are not those of the rig as it is now."""
    return (closed["excluded"] or "").startswith((OTHER_RIG_FILE, ZERO_LOST))
