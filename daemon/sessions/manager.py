"""Calibration sessions: the operator's commands combined with the instruments' records.

All state lives in the store. This module holds only what an open session needs between two fixes, and changes it after
the store: a change that the store refuses has no effect. `on_records` runs in the writer thread; methods named
`*_command` are called by the control socket's threads.
"""

from __future__ import annotations

import logging
import math
import sqlite3
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from calibration.rig.description import Rig
from daemon.acquisition.joiner import JoinedFix, ObservationJoiner
from daemon.commands import (
    HOW_TO_END,
    SESSION_KINDS,
    CommandError,
    CommandTurn,
    caller_columns,
    identifier,
    raise_if_cancelled,
    text_argument,
)
from daemon.config.sections import SessionsSection
from daemon.host.time_service import ClockState
from daemon.sessions.advice import SessionAdvice, after_a_move
from daemon.sessions.control_shot import Shot
from daemon.sessions.lifecycle import SessionLifecycle
from daemon.sessions.observing import ObservationMaker, PendingWrites
from daemon.sessions.open_session import OpenSession
from daemon.sessions.prism_watch import PrismWatch, as_dict
from daemon.sessions.prisms.guard import MotionLimit, Suspicion
from daemon.sessions.shot_times import ShotTimes
from daemon.sessions.station_setups import CONTROL_POINT_RADIUS_MM, StationSetups
from daemon.sessions.without_job import why_no_job
from daemon.store.errors import StoreError
from daemon.store.queries.jobs import JobTable
from daemon.store.queries.observations import ObservationTable, first_constants_mm
from daemon.store.store import Store
from drivers.clock import NS_PER_S, Clock, Stamp, lies_within
from drivers.readings import DeviceEvent, EventKind, Fix, Reading, Record
from drivers.stations.survey import position_mm

log = logging.getLogger(__name__)

LOAD_S = 3.0  # how long a session's start waits for the check of prisms to load; later loading is used as well
LATE_NS = 60 * NS_PER_S  # once a fix measured this long after a session's end is joined, all fixes of the session are


class SessionManager:
    """Keeps the one open session and turns joined fixes into its observations.

    Args:
        rig, rig_text: the machine, and the file that describes it.
        store: store of sessions and observations.
        setups: the station set-ups in the store.
        joiner: joins fixes with joints.
        settings: tolerances and timeouts.
        clock: clock of the rig.
        run_id: number of this run of the daemon; poses are numbered within a run.
        limits: station -> limits of its prism's motion, for each configured station.
        aim: turns the station to a prism or control point, on a simulated rig; None where the operator does it.
        are_jobs_enabled: closed sessions start jobs.
        clock_state: returns the state of the computer's clock, noted with a session; None for a different clock.
        why_no_fix: returns why no fix can arrive at present, a clause; None if fixes can arrive.

    Attributes:
        turn: held while a command is carried out, and entered before a transaction of several commands.
        pending: what `on_records` has concluded, to be stored together with the records.
    """

    def __init__(
        self,
        rig: Rig,
        rig_text: str,
        store: Store,
        setups: StationSetups,
        joiner: ObservationJoiner,
        settings: SessionsSection,
        clock: Clock,
        *,
        run_id: int,
        limits: Mapping[str, MotionLimit],
        aim: Callable[[str], None] | None = None,
        are_jobs_enabled: bool = True,
        clock_state: Callable[[], ClockState | None] = lambda: None,
        why_no_fix: Callable[[], str | None] = lambda: None,
    ) -> None:
        self._rig, self._rig_text = rig, rig_text
        self._store, self._joiner, self._settings, self._clock = store, joiner, settings, clock
        self._setups, self._are_jobs_enabled, self._measured = setups, are_jobs_enabled, joiner.measured
        self._lifecycle = SessionLifecycle(store, rig, clock, settings.control_tolerance_mm, clock_state)
        self._table, self._observations = self._lifecycle.table, ObservationTable(store)
        self._jobs = JobTable(store, rig.name)
        self._aim, self._why_no_fix = aim, why_no_fix
        self.turn = CommandTurn()
        self._shot: Shot | None = None
        self.pending = PendingWrites(store)
        self._prisms = PrismWatch(store, rig, clock, limits, self.pending.add_event, joiner.measured)
        self._observing = ObservationMaker(rig, store, self._observations, self.pending, self._prisms, run_id)
        self._shot_times = ShotTimes(store, clock, limits, aim, self._prisms.turned, self.pending.add)
        self._advice = SessionAdvice(rig, setups, self._table, self._prisms)
        self._late: set[str] = set()  # sessions that got fixes after their end, and must be judged again
        # Fixes measured in ended sessions may still arrive, or wait for their joints
        self._open: OpenSession | None = None
        self._ended: list[OpenSession] = []
        store.unless_damaged(partial(self._go_on, limits), None)

    # ---- the writer thread -------------------------------------------------------------------------------------------

    def on_records(self, records: Sequence[Record]) -> None:
        """Process records that are about to be stored: complete a shot, or make observations of the open session."""
        has_jumped = False
        self._judge_again(records)
        for record in records:
            if isinstance(record, Fix):
                if (shot := self._shot) is not None:  # a shot names its fixes, which must be stored before
                    self.pending.once_stored(partial(shot.take, record, self._measured(record), self._store.order))
                self._watch_prism(record)
            elif isinstance(record, DeviceEvent) and record.kind is EventKind.PRESET_JUMP:
                for session in self._taking():
                    if session.lasted(record.stamp):
                        session.jumped.setdefault(record.device, record.stamp)
                has_jumped = True
        if has_jumped:
            self.pending.add(self._lifecycle.judge_zeros)
        observing = [self._observe(joined) for joined in self._joiner.feed(records)]
        late = [session.id for session in observing if session is not None and session.until is not None]
        self._late.update(late)
        if not late:  # no late fixes at present
            for session_id in self._late:
                self.pending.add(partial(self._lifecycle.judge_again, session_id))
            self._late.clear()

    def is_of_session(self, record: Reading | Fix) -> bool:
        """Return True if a record was measured in the open session, or in an ended one that may still get fixes."""
        at = self._measured(record) if isinstance(record, Fix) else record.stamp
        return any(session.lasted(at) for session in self._taking())

    def _judge_again(self, records: Sequence[Record]) -> None:
        """Judge sessions again of which more has become known, while all fixes before these records are stored.

        A computer that lacks a descriptor or memory keeps the judgement so far; it is tried again at the next fix.
        """
        fixes = [record for record in records if isinstance(record, Fix)]
        for session in [session for session in self._taking() if session.is_outdated]:
            first = next((fix.stamp for fix in fixes if session.lasted(self._measured(fix))), None)
            if first is None:
                continue
            try:
                self._prisms.judge_again(session, first)
                self._observing.restore(session)
            except (OSError, sqlite3.Error, StoreError, MemoryError) as error:
                session.is_outdated = True
                log.warning("session %s: earlier fixes cannot be judged again yet: %s", session.id, error)

    def _watch_prism(self, fix: Fix) -> None:
        for session in self._taking():
            if session.lasted(self._measured(fix)):
                self._prisms.see(session, fix)

    def _taking(self) -> list[OpenSession]:
        """Return the sessions to which arriving records may belong, oldest first."""
        opened = self._open
        return [*self._ended, *([] if opened is None else [opened])]

    def _observe(self, joined: JoinedFix) -> OpenSession | None:
        """Make an observation of the session in which a fix was measured, and return that session, if there is one."""
        for ended in list(self._ended):
            if ended.until is not None and lies_within(
                self._store.order, joined.stamp, ended.until.shifted(LATE_NS), None
            ):
                self._ended.remove(ended)
        session = next((session for session in self._taking() if session.has(joined.stamp)), None)
        place_mm = position_mm(joined.fix)
        if session is None or place_mm is None:
            return None
        self._observing.observe(session, joined, place_mm)
        return session

    # ---- sessions ----------------------------------------------------------------------------------------------------

    def start_command(self, arguments: Mapping[str, Any], *, is_aimed: bool = True) -> dict[str, Any]:
        """Open a session: good fixes become its observations from now on, or from `look_back` on if not `is_aimed`."""
        with self.turn:
            if self._open is not None:
                raise CommandError(f"session {self._open.id!r} is open; {HOW_TO_END}")
            prism, kind = str(arguments.get("prism", "")), str(arguments.get("kind", "static_poses"))
            if prism not in self._rig.prism_names:
                raise CommandError(
                    f"rig {self._rig.name!r} has no prism {prism!r:.80}; it has {', '.join(self._rig.prism_names)}"
                )
            if kind not in SESSION_KINDS:
                raise CommandError(f"there is no kind {kind!r:.80}; kinds: {', '.join(SESSION_KINDS)}")
            self._setups.usable(arguments.get("setup"))  # fails before any waiting
            self._prisms.prepare(LOAD_S)
            if self._aim is not None:
                self._aim(prism)
            raise_if_cancelled()
            with self._store.transaction():
                session = self._new_session(prism, kind, arguments, is_aimed=is_aimed)
            return {
                "id": session.id,
                "setup": session.setup_id,
                "prism": prism,
                "kind": kind,
                "advice": self._advice.at_start(session),
            }

    def stop_command(self, _arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Close the open session; its jobs start by themselves."""
        with self.turn:
            session = self._close("closed")
            return self._table.summary(session.id, self._observations.tally) | {"advice": self._advice.at_end(session)}

    def abort_command(self, _arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Close the open session as unusable: it is kept, but never used for calibration."""
        with self.turn:
            return self._table.summary(self._close("aborted").id, self._observations.tally)

    def accept_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Let calibration use a closed session that it would otherwise not use."""
        with self.turn:
            session_id, operator = str(arguments.get("id", "")), text_argument(arguments, "operator")
            despite = self._lifecycle.accept(session_id, operator)
            log.warning(
                "session %s is used, accepted by %s despite: %s", session_id, operator or "an operator", despite
            )
            return self._table.summary(session_id)

    def reject_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Keep calibration from using a closed session, until an operator accepts it."""
        with self.turn:
            session_id, operator = str(arguments.get("id", "")), text_argument(arguments, "operator")
            why = self._lifecycle.reject(session_id, operator, text_argument(arguments, "reason").strip())
            log.warning("session %s is not used: %s", session_id, why)
            return self._table.summary(session_id)

    def shoot_command(self, arguments: Mapping[str, Any], *, most_off_mm: float = math.inf) -> dict[str, Any]:
        """Measure a control point: the mean of the next good fixes. The first shot of a point defines its place.

        A target further than `most_off_mm` from the known place is not the point, and the shot is refused.
        """
        with self.turn:
            session = self._needs_open()
            name = identifier(arguments, "point", "a control point's name")
            if name in self._rig.prism_names:
                raise CommandError(f"{name!r} is a prism of the rig; name a control point, which does not move with it")
            with self._shot_times.on_point(session, name, self._settings.fixes_per_shot) as shot:
                self._shot = shot
                try:
                    shot.wait(self._clock, self._settings.shot_timeout_s, self._why_no_fix)
                    result = self._keep_shot(session, name, shot, most_off_mm)
                finally:
                    self._shot = None
            return result | {"advice": after_a_move(session.id) if result["moved"] else []}

    def zeros_checked(self) -> None:
        """Decide again whether calibration may use closed sessions, after an operator has checked the joints' zeros."""
        self._lifecycle.judge_readings()

    def confirm_prism_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Note the operator's confirmation that the station is on the session's prism; its fixes are used again."""
        with self.turn:
            return self._prisms.confirm(self._needs_open(), text_argument(arguments, "operator"))

    def turned_command(self, _arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Note, in a replay, that the station was turned to the session's prism at this instant."""
        with self.turn:
            session = self._needs_open()
            self._prisms.turned(session, self._clock.now())
            return {"session": session.id}

    def list_command(self, _arguments: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Return all sessions with their contents, oldest first."""
        return [session | self._without_job(session) for session in self._table.all()]

    def show_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return one session: its contents, its exclusions with reasons, the control points of its set-up, its jobs."""
        session_id = str(arguments.get("id", ""))
        session = self._table.summary(session_id)
        about = {
            "jobs": self._jobs.of_session(session_id, self._clock),
            "latency": self._jobs.latencies().get(session_id),
        }
        return session | about | self._without_job(session)

    def _without_job(self, session: Mapping[str, Any]) -> dict[str, str | None]:
        return {"no_job": why_no_job(session, self._jobs, are_jobs_enabled=self._are_jobs_enabled)}

    def open_session(self) -> dict[str, Any] | None:
        """Return the open session as `status` shows it; None without one."""
        session = self._open
        if session is None:
            return None
        suspicions = [as_dict(suspicion) for suspicion in self.prism_suspicions()]
        shown = {"prism_suspicions": suspicions, "jumped": [j for j in self._rig.joint_names if j in session.jumped]}
        return self._table.summary(session.id, self._observations.tally) | shown

    def aim_again(self) -> None:
        """Aim the station again if it may be on another prism and a program can aim it."""
        session = self._open
        if self._aim is None or session is None or not self._prisms.suspicions(session):
            return
        if self.turn.enter_if_free():  # otherwise a command is working on the session: retry later
            try:
                if session is self._open:
                    self._aim(session.prism)
                    self._prisms.turned(session, self._clock.now())
            except (CommandError, sqlite3.Error) as error:  # a fault of the station or the disk: retry later
                log.warning("the station could not be aimed at prism %s again: %s", session.prism, error)
            finally:
                self.turn.leave()

    def look_away(self) -> None:
        """Exclude fixes of the open session from now on, because the station is not on its prism."""
        session = self._open
        if session is not None:
            session.shots.append(Shot(0, self._clock.now()))

    def was_away(self, times: Callable[[str], Iterable[tuple[Stamp, Stamp | None]]]) -> None:
        """Exclude fixes that are decoded from now on and were measured at times when the station was on no prism.

        Args:
            times: returns for a session when the station was turned away from its prism, and when it was back; None
                if it was not back by the session's end, or is not yet.
        """
        for session in self._taking():
            away = [Shot(0, since, until) for since, until in times(session.id)]
            if away:
                session.shots += away
                self._prisms.judge_again(session)

    def look_back(self, operator: str) -> None:
        """Use the fixes of the open session again, after an operator has confirmed that the station is on its prism."""
        session = self._needs_open()
        with self._store.transaction():
            self._prisms.confirm(session, operator)
            self._store.once_committed(partial(session.end_shots, self._clock.now()))

    def prism_suspicions(self) -> list[Suspicion]:
        """Return stations that may be on a wrong prism, unless a guide has turned them away; callable by any thread."""
        session = self._open
        if session is None or session.is_away:
            return []
        return self._prisms.suspicions(session) or self._shot_times.suspicions(session)

    def prisms_fault(self) -> str | None:
        """Return why stations' prisms cannot be checked against the joints, a clause; None if they can."""
        return self._prisms.trouble()

    def not_counting(self, within_s: float = math.inf) -> str | None:
        """Return why the newest fix of the open session is not used; may be called from any thread.

        Args:
            within_s: largest time since the fix was measured, real seconds; for an older fix None is returned.
        """
        opened, newest = self._open, self._observing.newest
        if opened is None or newest is None or newest[0] != opened.id:
            return None
        age_s = self._clock.now().since(newest[1]) / NS_PER_S
        return newest[2] if self._clock.real_seconds(age_s) <= within_s else None

    # ---- parts -------------------------------------------------------------------------------------------------------

    def _new_session(self, prism: str, kind: str, arguments: Mapping[str, Any], *, is_aimed: bool) -> OpenSession:
        """Store a session in the named or the current set-up; it is open once the transaction is committed."""
        setup_id, now = self._setups.usable(arguments.get("setup")), self._clock.now()
        session_id = identifier(arguments, "id", "a session's id", default=self._table.free_id(prism))
        if session_id in self._table.ids():
            raise CommandError(f"session {session_id!r} exists already; choose another --id")
        points = self._setups.control_points(setup_id, session_id)
        session = OpenSession(session_id, setup_id, prism, kind, self._store.order, now, control_points=points)
        self._prisms.begin(session)
        if not is_aimed:
            session.shots.append(Shot(0, now))
        row = {
            "setup_id": setup_id,
            "prism": prism,
            "operator": text_argument(arguments, "operator"),
            **caller_columns(),
            "kind": kind,
            "note": text_argument(arguments, "note"),
        }
        self._lifecycle.start(now, session_id, self._rig_text, **row)
        if self._aim is not None:
            self._prisms.turned(session, now)
        self._store.once_committed(partial(self._has_begun, session))
        return session

    def _has_begun(self, session: OpenSession) -> None:
        self._open = session

    def _keep_shot(self, session: OpenSession, name: str, shot: Shot, most_off_mm: float) -> dict[str, Any]:
        """Store a shot before it ends, and judge earlier fixes near its point again if this shot has located it."""
        with self._store.transaction():
            phase = self._table.phase(session.id, name)
            result = self._setups.store_shot(
                session.setup_id, session.id, name, phase, shot.fixes, shot.places_mm, most_off_mm=most_off_mm
            )
            points = self._setups.control_points(session.setup_id, session.id)
            for place in session.control_points:
                if place not in points:  # an earlier shot of this point was not of the point
                    self._observations.include_near(session.id, name, place, CONTROL_POINT_RADIUS_MM)
            if result["misclosure_mm"] is None:
                for place in points:
                    self._observations.exclude_near(session.id, place, CONTROL_POINT_RADIUS_MM)
            self._store.once_committed(partial(session.know, points, first_constants_mm(self._store, session.id)))
        return result

    def _close(self, state: str) -> OpenSession:
        """End the open session, in the store and then in memory; if the store refuses, it stays open in both."""
        session = self._needs_open()
        with self._store.transaction():
            until = self._lifecycle.end(session.id, state)
            self._store.once_committed(partial(self._has_ended, session, until))
        return session

    def _has_ended(self, session: OpenSession, until: Stamp) -> None:
        session.until = until
        self._ended.append(session)
        self._open = None

    def _needs_open(self) -> OpenSession:
        if self._open is None:
            raise CommandError("no session is open; start one with `rigcal session start`")
        return self._open

    def _go_on(self, stations: Collection[str]) -> None:
        """Resume the sessions of an earlier run: the open one, and ended ones whose captures were not all decoded."""
        self._open, self._ended = self._lifecycle.unfinished(self._rig_text, stations)
        self._lifecycle.judge_readings()
        for session in self._taking():
            points = self._setups.control_points(session.setup_id, session.id)
            session.know(points, first_constants_mm(self._store, session.id))
            session.jumped = self._lifecycle.jumped(session)
            session.cut_off = self._shot_times.cut_off(session)
            self._prisms.restore(session)
            self._observing.restore(session)
        if (opened := self._open) is None:
            return
        log.warning("session %s (prism %s) was open when rigcal last ended; it continues", opened.id, opened.prism)
        if self._aim is not None:  # the aiming program may have lost its state; an operator's station has kept its lock
            self._aim(opened.prism)
            self._prisms.turned(opened, self._clock.now())
