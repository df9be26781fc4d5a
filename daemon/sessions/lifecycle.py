"""All changes of a calibration session's state, and the decision whether calibration may use it.

A session is open, then closed or aborted. Once it is closed, it is decided whether calibration may use it. It may not

- if no control point shows that the station stood still from its start to its end, until an operator accepts it;
- if an operator has rejected it, until one accepts it;
- if a rig file other than the present one converted counts into its readings, until that file is in use again;
- if an encoder has jumped since, until the joint's zero has been checked.

Each change is one transaction.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any

from calibration.rig.decoding import without_decoding
from calibration.rig.description import Rig
from daemon.commands import HOW_TO_READ_AGAIN, NO_POSE, OTHER_RIG_FILE, REFUSED, CommandError, caller_columns
from daemon.host.time_service import ClockState
from daemon.rig_files import misreading
from daemon.sessions.open_session import CONSTANT_TOLERANCE_MM, OpenSession
from daemon.store.connection import rig_sha256
from daemon.store.queries.jobs import JobTable
from daemon.store.queries.models import ModelTable
from daemon.store.queries.observations import first_constants_mm, stations_of
from daemon.store.queries.poses import has_poses, has_poses_before_enclosed, is_enclosed
from daemon.store.queries.sessions import (
    OPEN_AT_NEXT,
    OPEN_IN_BACKUP,
    ZERO_LOST,
    SessionTable,
    session,
)
from daemon.store.queries.setups import SetupTable
from daemon.store.queries.zeros import Zeros, first_jumps
from daemon.store.store import Store
from drivers.clock import Clock, Stamp

log = logging.getLogger(__name__)

NOT_SHOT = "no control point was shot at both start and end, so nothing shows that the station stood still"
NOT_ENCLOSED = "most poses do not lie between a control point's shot at the session's start and its shot at the end"
NOT_THE_SAME = (
    "the control point shot at the session's start was not shot again at its end; the control point shot at the end "
    "was first shot after some poses, and the station may have moved before that"
)
LEAST_ENCLOSED = 0.25  # share of the poses; some are measured before the first shot or after the last one


class SessionLifecycle:
    """The sessions of a rig.

    Args:
        store: the database.
        rig: rig whose sessions are opened.
        clock: clock for the instants of changes.
        tolerance_mm: a control point that is off by more than this shows that the station has moved.
        clock_state: returns the state of the computer's clock; None if the session uses a different clock.

    Attributes:
        table: the sessions.
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
        self._jobs, self._models = JobTable(store, rig.name), ModelTable(store, rig.name, clock)

    def unfinished(self, rig_text: str, stations: Collection[str]) -> tuple[OpenSession | None, list[OpenSession]]:
        """Return the rig's open session, and ended sessions whose last captures are not yet decoded.

        A session belongs to one rig file and to the stations that measured in it. A session started with a different
        file, of this rig or of another one, is closed, and gets no more fixes. So is a session with fixes of a station
        that is not configured any more, because what is known of that station's target does not apply to another
        station. So is a session that another one followed: earlier versions left sessions of other rigs open. A session
        stored with the bare file, from before the store kept the decoding of channels, continues.

        Args:
            rig_text: the present rig file with the decoding of channels.
            stations: names of the configured stations.
        """
        opened: OpenSession | None = None
        ended: list[OpenSession] = []
        bare = without_decoding(rig_text)
        own = {rig_sha256(text) for text in (rig_text, bare, bare.removesuffix("\n"))}
        for row in self.table.unfinished():
            is_own = row["rig"] == self._rig.name and row["rig_sha256"] in own
            changed = self._what_changed(row, stations, is_own=is_own) if row["state"] == "open" else None
            if changed is not None:
                self._close_left_open(row, *changed)
            if changed is not None or not is_own:
                continue
            since, until = self._store.stamp(row, "started_"), self._store.stamp_or_none(row, "ended_")
            order = self._store.order
            found = OpenSession(row["id"], row["setup_id"], row["prism"], row["kind"], order, since, until)
            if until is None:
                opened = found
            else:
                ended.append(found)
        return opened, ended

    def _what_changed(
        self, row: Mapping[str, Any], stations: Collection[str], *, is_own: bool
    ) -> tuple[str, str | None] | None:
        """Return why a session left open by an earlier run must be closed, a clause; None if it continues.

        Returns:
            The clause, and the session that was started while this one was open, if there is one: the station may have
            been on its prism.
        """
        next_one = self.table.follower(row["id"])
        if row["rig"] != self._rig.name:
            return f"the rig was changed from {row['rig']} to {self._rig.name}", next_one
        if next_one is not None:
            return f"session {next_one} was started", next_one
        if not is_own:
            return "the rig file was changed", None
        gone = [station for station in stations_of(self._store, row["id"]) if station not in stations]
        return (f"station {gone[0]} was removed from the configuration or renamed", None) if gone else None

    def _close_left_open(self, row: Mapping[str, Any], changed: str, next_one: str | None) -> None:
        """Close a session left open by an earlier run, as of the end of the last run that measured in it."""
        why = f"closed by rigcal: {changed} while it was open"
        left_open = f"{OPEN_AT_NEXT}{next_one} was started" if next_one else None
        with self._store.transaction():
            self.table.change(
                row["id"],
                state="closed",
                note="; ".join(filter(None, (row["note"], why))),
                excluded=left_open or self._why_not_used(row["id"]),
                **self._store.instant(self.table.last_measured(row["id"]), "ended_"),
            )
        log.warning("session %s (prism %s): %s; start a new session", row["id"], row["prism"], why)

    def jumped(self, session: OpenSession) -> dict[str, Stamp]:
        """Return the devices whose encoders jumped during a session, each with the instant of its first jump."""
        jumps = first_jumps(self._store, session.since)
        return {jump.device: jump.at for jump in jumps if session.lasted(jump.at)}

    def start(self, started: Stamp, session_id: str, rig_text: str, **columns: object) -> None:
        """Add an open session.

        Args:
            started: start of the session.
            session_id: its id.
            rig_text: the rig file with the decoding of channels.
            columns: further columns of its row.
        """
        with self._store.transaction():
            self.table.start(started, rig_text, id=session_id, **columns)
            self._note_clock(session_id, "start")

    def _note_clock(self, session_id: str, phase: str) -> None:
        state = self._clock_state()
        if state is not None:
            self.table.note_clock(session_id, phase, state)

    def end(self, session_id: str, state: str) -> Stamp:
        """Close or abort a session.

        Args:
            session_id: the session.
            state: `closed` or `aborted`.

        Returns:
            Instant of its end: fixes measured later are not stored as its observations.
        """
        with self._store.transaction():
            ended = self._clock.now()  # in the transaction: the writer thread may have held the store for a long time
            excluded = self._why_not_used(session_id) if state == "closed" else None
            self.table.change(session_id, state=state, excluded=excluded, **self._store.instant(ended, "ended_"))
            self._note_clock(session_id, "end")
        return ended

    def judge_again(self, session_id: str) -> None:
        """Decide again whether calibration may use a closed session of which more was decoded after its end."""
        with self._store.transaction():
            self.table.exclude_closed(session_id, self._why_not_used(session_id))

    def judge_readings(self) -> None:
        """Decide again whether calibration may use the closed sessions: the rig file or zeros may have changed."""
        with self._store.transaction():
            for row in self.table.closed():
                self._judge_readings(row)

    def judge_zeros(self) -> None:
        """Decide again whether calibration may use the closed sessions, after an encoder has jumped.

        Only sessions whose lost zeros have changed are judged, as a faulty encoder may jump many times a second.
        """
        with self._store.transaction():
            zeros = Zeros(self._store, self._rig.name)
            for row in self.table.closed():
                first = (row["excluded"] or "").split("; ")[0]
                told = first if first.startswith(ZERO_LOST) else None
                if not first.startswith(OTHER_RIG_FILE) and told != self._why_zero_lost(row, zeros):
                    self._judge_readings(row)

    def _judge_readings(self, closed: Mapping[str, Any]) -> None:
        session_id, excluded = closed["id"], closed["excluded"]
        why = self._why_other_readings(self._row(session_id))
        if why is None and not _has_other_readings(excluded):
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
        """Return why a session's readings do not match the present rig, a clause; None where they match.

        An operator who accepts a session confirms that the zeros are the same as when it was measured.
        """
        if why := misreading(self._rig, row["rig_text"], row["prism"]):
            return f"{OTHER_RIG_FILE}{why}"
        return self._why_zero_lost(row, Zeros(self._store, self._rig.name))

    def _why_zero_lost(self, row: Mapping[str, Any], zeros: Zeros) -> str | None:
        """Return which joints' zeros are no longer known to be a session's, a clause; None if all are."""
        lost = zeros.lost(self.table.zeros_known(row))
        joints = [name for name in self._rig.joint_names if name in lost]
        return f"{ZERO_LOST}{', '.join(joints)}" if joints else None

    def accept(self, session_id: str, operator: str) -> str:
        """Let calibration use a closed session from now on, because an operator accepts it.

        Args:
            session_id: the session.
            operator: name of the operator; "" if unknown.

        Returns:
            The reason why it was not used.

        Raises:
            CommandError: the session is not closed, is used already, was recorded with a different rig file, or is
                not used because it has no usable pose.
            NotInStoreError: there is no such session.
        """
        with self._store.transaction():
            state, despite = self.table.state_and_exclusion(session_id)
            if state != "closed":
                why = "is open; stop it first" if state == "open" else "was aborted, and cannot be accepted"
                raise CommandError(f"session {session_id!r} {why}")
            if despite is None:
                raise CommandError(f"session {session_id!r} is already used by calibration; there is nothing to accept")
            if despite.startswith(OTHER_RIG_FILE):
                raise CommandError(f"session {session_id!r}: {despite}; {HOW_TO_READ_AGAIN}", REFUSED)
            if despite == NO_POSE:
                raise CommandError(f"session {session_id!r}: {NO_POSE}; hold another session", REFUSED)
            self._decide(session_id, operator, "accepted", instead_of="rejected")
            self._models.forget_drift(session_id)
            told = {"accepted_despite": despite, "accepted_after_job": self._jobs.newest_id()}
            self.table.change(session_id, excluded=None, rejected_reason=None, **told)
        return despite

    def reject(self, session_id: str, operator: str, reason: str) -> str:
        """Keep calibration from using a closed session from now on, until an operator accepts it.

        Training that has used the session is repeated without it, and so are the sums of drift.

        Args:
            session_id: the session.
            operator: name of the operator; "" if unknown.
            reason: why; "" if unknown.

        Returns:
            The reason why it is not used.

        Raises:
            CommandError: the session is not closed, or rejected already.
            NotInStoreError: there is no such session.
        """
        with self._store.transaction():
            state, excluded = self.table.state_and_exclusion(session_id)
            if state != "closed":
                why = (
                    "is open; abort it: `rigcal session abort`" if state == "open" else "was aborted, and is never used"
                )
                raise CommandError(f"session {session_id!r} {why}")
            if _why_rejected(self._row(session_id)):
                raise CommandError(f"session {session_id!r} is already rejected")
            self._decide(session_id, operator, "rejected", instead_of="accepted")
            self.table.change(session_id, rejected_reason=reason, accepted_despite=None)
            has_drift = self._models.forget_drift(session_id)
            if excluded is None or has_drift or _has_other_readings(excluded):  # it was used before
                self.table.change(session_id, accepted_after_job=self._jobs.newest_id())
            excluded = self._why_not_used(session_id)
            self.table.change(session_id, excluded=excluded)
        assert excluded is not None  # it is rejected
        return excluded

    def _decide(self, session_id: str, operator: str, decision: str, *, instead_of: str) -> None:
        """Store who decided on a session and when, in place of an earlier decision."""
        told = {"by": operator, **caller_columns(), **self._store.instant(self._clock.now())}
        untold = dict.fromkeys(told) | {"by": ""}
        self.table.change(
            session_id,
            **{f"{decision}_{key}": value for key, value in told.items()},
            **{f"{instead_of}_{key}": value for key, value in untold.items()},
        )

    def _why_not_used(self, session_id: str) -> str | None:
        """Return why calibration must not use a session, a clause; None if it may."""
        row = self._row(session_id)
        reasons = (
            self._why_other_readings(row),
            _why_rejected(row),
            _why_left_open(row),
            self._why_other_constant(row),
            self._why_moved(session_id),
        )
        return "; ".join(filter(None, reasons)) or None

    def _why_other_constant(self, row: Mapping[str, Any]) -> str | None:
        """Return a clause if a session's prism constant differs from that of other sessions, otherwise None.

        The constant is compared with the one in the set-up's description, or else in the newest used session there.
        """
        said_mm = self._setups.constants_mm(row["setup_id"]).get(row["prism"])
        like = self.table.used_like(row["id"])
        for station, mm in first_constants_mm(self._store, row["id"]).items():
            if said_mm is not None:
                other_mm, where = said_mm, f"set-up {row['setup_id']} gives"
            else:
                other_mm = mm if like is None else first_constants_mm(self._store, like).get(station, mm)
                where = f"session {like} has"
            if abs(mm - other_mm) > CONSTANT_TOLERANCE_MM:
                return f"{station} applied a prism constant of {mm:g} mm to {row['prism']}, but {where} {other_mm:g} mm"
        return None

    def _why_moved(self, session_id: str) -> str | None:
        """Return why a session's station may have moved, a clause; None if a control point shows that it did not."""
        for shot in self.table.shots(session_id):
            if shot["misclosure_mm"] is not None and shot["misclosure_mm"] > self._tolerance_mm:
                off = f"control point {shot['point']} was {shot['misclosure_mm']:.1f} mm off at the session's"
                return f"{off} {shot['phase']}, so the station had moved"
        again = self.table.moved_between(session_id)
        if again is not None and again[1] > self._tolerance_mm:
            return (
                f"control point {again[0]} was {again[1]:.1f} mm off when it was shot again, so the station had moved"
            )
        at_start, at_end = (self.table.points_shot(session_id, phase) for phase in ("start", "end"))
        if not at_start & at_end:
            # Without a pose, all shots are of the start.
            return NO_POSE if at_start and not has_poses(self._store, session_id) else NOT_SHOT
        if has_poses_before_enclosed(self._store, session_id):
            return NOT_THE_SAME
        return None if is_enclosed(self._store, session_id, LEAST_ENCLOSED) else NOT_ENCLOSED


def _why_rejected(row: Mapping[str, Any]) -> str | None:
    """Return that an operator has rejected a session, a clause; None if none has, or it was accepted since."""
    if row["rejected_utc_ns"] is None:
        return None
    reason = f": {row['rejected_reason']}" if row["rejected_reason"] else ""
    return f"it was rejected by {row['rejected_by'] or 'an operator'}{reason}"


def _why_left_open(row: Mapping[str, Any]) -> str | None:
    """Return the part of the reason why a session is not used that only an operator can end; None without one."""
    reasons = (row["excluded"] or "").split("; ")
    return next((reason for reason in reasons if reason.startswith((OPEN_AT_NEXT, OPEN_IN_BACKUP))), None)


def _has_other_readings(excluded: str | None) -> bool:
    """Return True if a session is not used because its readings do not match the present rig."""
    return (excluded or "").startswith((OTHER_RIG_FILE, ZERO_LOST))
