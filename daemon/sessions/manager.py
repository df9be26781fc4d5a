"""Calibration sessions: what the operator says, joined with what the instruments give.

All state lives in the store; this module holds only what an open session needs between two fixes, and changes it after
the store: what the store has refused has not happened. `on_records` runs in the writer thread; methods named
`*_command` are called by the control socket's threads.
"""

from __future__ import annotations

import logging
import math
import sqlite3
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from calibration.rig.description import Rig
from daemon.acquisition.joiner import JoinedFix, ObservationJoiner
from daemon.commands import (
    HOW_TO_END,
    SESSION_KINDS,
    CommandError,
    caller_columns,
    go_on_for_caller,
    identifier,
    text_argument,
)
from daemon.config.sections import SessionsSection
from daemon.host.time_service import ClockState
from daemon.sessions.advice import SessionAdvice, after_a_move
from daemon.sessions.control_shot import Shot
from daemon.sessions.lifecycle import SessionLifecycle
from daemon.sessions.observing import ObservationMaker, PendingWrites
from daemon.sessions.open_session import CONTROL_POINT_RADIUS_MM, OpenSession
from daemon.sessions.prism_watch import PrismWatch, as_dict
from daemon.sessions.prisms.guard import MotionLimit, Suspicion
from daemon.sessions.station_setups import AXES, StationSetups
from daemon.sessions.without_job import why_no_job
from daemon.store.errors import is_unwritable
from daemon.store.queries.jobs import JobTable
from daemon.store.queries.observations import ObservationTable, first_constants_mm
from daemon.store.store import Store
from drivers.clock import NS_PER_S, Clock, Stamp, lies_within
from drivers.readings import DeviceEvent, EventKind, Fix, Record
from drivers.stations.survey import position_mm

log = logging.getLogger(__name__)

LOAD_S = 3.0  # how long a session's start waits for what tells prisms apart; it is heeded later as well
LATE_NS = 60 * NS_PER_S  # once a fix was joined that was measured so long after a session's end, it has all of its own


class SessionManager:
    """Keeps the one open session and turns joined fixes into its observations.

    Args:
        rig, rig_text: the machine, and the file that describes it.
        store: where everything is kept.
        setups: the station set-ups in it.
        joiner: joins fixes with joints.
        settings: tolerances and time-outs.
        clock: time.
        run_id: of this run of the daemon; poses are numbered within it.
        aim: turns the station to a prism or control point where something can (a simulated rig); None where the
            operator does it.
        limits: station -> what motion can do to its prism.
        are_jobs_enabled: closed sessions start jobs.
        clock_state: returns how the computer's clock is, to be noted with a session; None where it is another clock.

    Attributes:
        turn: held while a command is carried out; whoever gives several within a transaction takes it before that.
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
        aim: Callable[[str], None] | None = None,
        limits: Mapping[str, MotionLimit] | None = None,
        are_jobs_enabled: bool = True,
        clock_state: Callable[[], ClockState | None] = lambda: None,
    ) -> None:
        self._rig, self._rig_text = rig, rig_text
        self._store, self._joiner, self._settings, self._clock = store, joiner, settings, clock
        self._setups, self._are_jobs_enabled = setups, are_jobs_enabled
        self._lifecycle = SessionLifecycle(store, rig, clock, settings.control_tolerance_mm, clock_state)
        self._table, self._observations = self._lifecycle.table, ObservationTable(store)
        self._jobs = JobTable(store, rig.name)
        self._aim = aim
        self.turn = threading.RLock()
        self._shot: Shot | None = None
        self._pending = PendingWrites(store)
        self._prisms = PrismWatch(store, rig, clock, limits or {}, self._pending.add_event)
        self._observing = ObservationMaker(rig, store, self._pending, self._prisms, run_id)
        self._advice = SessionAdvice(rig, setups, self._table, self._prisms)
        self._late: set[str] = set()  # sessions that got fixes after their end, and must be judged again
        # Fixes measured in those that have ended may still come, or wait for their joints
        self._open: OpenSession | None = None
        self._ended: list[OpenSession] = []
        store.unless_damaged(self._go_on, None)

    # ---- the writer thread -------------------------------------------------------------------------------------------

    def on_records(self, records: Sequence[Record]) -> None:
        """Take records that are stored now: complete a shot, or store observations of the open session."""
        has_jumped = False
        for record in records:
            if isinstance(record, Fix):
                if self._shot is not None:
                    self._shot.take(record, self._store.order)
                self._watch_prism(record)
            elif isinstance(record, DeviceEvent) and record.kind is EventKind.PRESET_JUMP:
                for session in self._taking():
                    if session.lasted(record.stamp):
                        session.jumped.setdefault(record.device, record.stamp)
                has_jumped = True
        if has_jumped:
            self._pending.add(self._lifecycle.judge_zeros)
        observing = [self._observe(joined) for joined in self._joiner.feed(records)]
        late = [session.id for session in observing if session is not None and session.until is not None]
        self._late.update(late)
        if not late:  # no more of them at present
            for session_id in self._late:
                self._pending.add(partial(self._lifecycle.judge_again, session_id))
            self._late.clear()
        self._pending.store()

    def is_of_session(self, stamp: Stamp) -> bool:
        """Return True if an instant lies in the open session, or in one that ended and may still get fixes."""
        return any(session.lasted(stamp) for session in self._taking())

    def _watch_prism(self, fix: Fix) -> None:
        for session in self._taking():
            if session.lasted(fix.stamp):
                self._prisms.see(session, fix)

    def _taking(self) -> list[OpenSession]:
        """The sessions that may have measured what comes now, oldest first."""
        opened = self._open
        return [*self._ended, *([] if opened is None else [opened])]

    def _observe(self, joined: JoinedFix) -> OpenSession | None:
        """Make an observation of the session in which a fix was measured, if any; that session."""
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
        """Open a session: from now on good fixes become its observations; from `look_back` on where not `is_aimed`."""
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
            self._setups.usable(arguments.get("setup"))  # before anything is waited for
            self._prisms.prepare(LOAD_S)
            if self._aim is not None:
                self._aim(prism)
            go_on_for_caller()
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
        """Close the open session; its jobs follow by themselves."""
        with self.turn:
            session = self._close("closed")
            return self._table.summary(session.id) | {"advice": self._advice.at_end(session)}

    def abort_command(self, _arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Close the open session as unusable: kept, never calibrated with."""
        with self.turn:
            return self._table.summary(self._close("aborted").id)

    def accept_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Let calibration use a closed session although nothing shows that the station stood still."""
        with self.turn:
            session_id, operator = str(arguments.get("id", "")), text_argument(arguments, "operator")
            despite = self._lifecycle.accept(session_id, operator)
            log.warning("session %s is used, by the word of %s: %s", session_id, operator or "an operator", despite)
            return self._table.summary(session_id)

    def shoot_command(self, arguments: Mapping[str, Any], *, most_off_mm: float = math.inf) -> dict[str, Any]:
        """Measure a control point: the mean of the next good fixes. The first shot of a point defines its place.

        What lies further than `most_off_mm` from the known place is something else, and refused.
        """
        with self.turn:
            session = self._needs_open()
            name = identifier(arguments, "point", "a control point's name")
            if name in self._rig.prism_names:
                raise CommandError(f"{name!r} is a prism of the rig; a control point stands still beside it")
            shot = Shot(self._settings.fixes_per_shot, self._clock.now())
            session.shots.append(shot)
            try:
                if self._aim is not None:
                    self._aim(name)
                shot.aimed = self._clock.now()
                self._shot = shot
                shot.wait(self._clock, self._settings.shot_timeout_s)
                result = self._keep_shot(session, name, shot, most_off_mm)
            finally:
                self._shot = None
                if self._aim is not None:
                    self._aim(session.prism)
                shot.until = self._clock.now()
                self._note_turned(session, shot.until)
            return result | {"advice": after_a_move(session.id) if result["moved"] else []}

    def zeros_checked(self) -> None:
        """Decide anew whether calibration may use closed sessions: an operator has checked the joints' zeros."""
        self._lifecycle.judge_readings()

    def confirm_prism_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Take the operator's word that the station is on the session's prism: its fixes count from now on."""
        with self.turn:
            return self._prisms.confirm(self._needs_open(), text_argument(arguments, "operator"))

    def turned_command(self, _arguments: Mapping[str, Any]) -> dict[str, Any]:
        """In a replay: the station was turned to the session's prism at this instant."""
        with self.turn:
            session = self._needs_open()
            self._prisms.turned(session, self._clock.now())
            return {"session": session.id}

    def list_command(self, _arguments: Mapping[str, Any]) -> list[dict[str, Any]]:
        """All sessions with what they hold, oldest first."""
        return [session | self._without_job(session) for session in self._table.all()]

    def show_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """One session: what it holds, what was excluded and why, how its set-up kept its place, and its jobs."""
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
        suspicions = [as_dict(suspicion) for suspicion in self._prisms.suspicions(session)]
        return self._table.summary(session.id) | {"prism_suspicions": suspicions}

    def aim_again(self) -> None:
        """Aim the station again when it may be on another prism, where something can."""
        session = self._open
        if self._aim is None or session is None or not self._prisms.suspicions(session):
            return
        if self.turn.acquire(blocking=False):  # else a command is at work on the session: another time
            try:
                if session is self._open:
                    self._aim(session.prism)
                    self._prisms.turned(session, self._clock.now())
            except (CommandError, sqlite3.Error) as error:  # another time: the station, or the disk, is not well
                log.warning("station not aimed at prism %s again: %s", session.prism, error)
            finally:
                self.turn.release()

    # ---- for a guide -------------------------------------------------------------------------------------------------

    def look_away(self, since: Stamp | None = None, until: Stamp | None = None) -> None:
        """Count no fix of the open session from an instant on, now by default: the station is not on its prism.

        Args:
            since: when it was turned away.
            until: when it was back, where that is over already.
        """
        session = self._open
        if session is not None:
            session.shots.append(Shot(0, since or self._clock.now(), until))

    def look_back(self, operator: str) -> None:
        """Count the fixes of the open session again, on an operator's word that the station is on its prism."""
        session = self._needs_open()
        with self._store.transaction():
            self._prisms.confirm(session, operator)
            self._store.once_committed(partial(session.end_shots, self._clock.now()))

    def prism_suspicions(self) -> list[Suspicion]:
        """Stations that may be on another prism than that of the open session; from any thread."""
        session = self._open
        return [] if session is None else self._prisms.suspicions(session)

    def prisms_fault(self) -> str | None:
        """Return why joints do not tell whether a station is on its prism, a clause; None where they do."""
        return self._prisms.trouble()

    def not_counting(self, fresh_s: float) -> str | None:
        """Return why the newest fix of the open session does not count; from any thread.

        Args:
            fresh_s: how old it may be, real seconds; of an older one nothing is said.
        """
        opened, newest = self._open, self._observing.newest
        if opened is None or newest is None or newest[0] != opened.id:
            return None
        age_s = self._clock.now().since(newest[1]) / NS_PER_S
        return newest[2] if self._clock.real_seconds(age_s) <= fresh_s else None

    # ---- parts -------------------------------------------------------------------------------------------------------

    def _new_session(self, prism: str, kind: str, arguments: Mapping[str, Any], *, is_aimed: bool) -> OpenSession:
        """Store a session in the set-up that is the current one now, or that is named; it is open once committed."""
        setup_id, now = self._setups.usable(arguments.get("setup")), self._clock.now()
        session_id = identifier(arguments, "id", "a session's id", default=self._table.free_id(prism))
        if session_id in self._table.ids():
            raise CommandError(f"session {session_id!r} exists already; choose another --id")
        points = self._setups.control_points(setup_id)
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
        """Store a shot before it is over, and what it tells of fixes that came before anything told where its point is.

        Fixes that come late are of the point, and known to be.
        """
        with self._store.transaction():
            phase = self._table.phase(session.id, name)
            result = self._setups.store_shot(
                session.setup_id, session.id, name, phase, shot.fixes, shot.places_mm, most_off_mm=most_off_mm
            )
            if result["misclosure_mm"] is None:  # nothing told before
                self._observations.exclude_near(session.id, [result[axis] for axis in AXES], CONTROL_POINT_RADIUS_MM)
            points = self._setups.control_points(session.setup_id)
            constants_mm = first_constants_mm(self._store, session.id)
            self._store.once_committed(partial(session.know, points, constants_mm))
        return result

    def _note_turned(self, session: OpenSession, at: Stamp) -> None:
        """Note that the station was turned to the prism, where something can: it was, also if that cannot be stored."""
        if self._aim is None:
            return
        try:
            self._prisms.turned(session, at)
        except sqlite3.Error as error:
            if not is_unwritable(error):
                raise
            log.warning("it cannot be stored that the station was turned to prism %s: %s", session.prism, error)

    def _close(self, state: str) -> OpenSession:
        """End the open session, in the store and then here; what the store refuses leaves it open in both."""
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

    def _go_on(self) -> None:
        """Ready the sessions that an earlier run left to take fixes: of those that ended, what it did not decode."""
        self._open, self._ended = self._lifecycle.unfinished(self._rig_text)
        self._lifecycle.judge_readings()
        for session in self._taking():
            session.know(self._setups.control_points(session.setup_id), first_constants_mm(self._store, session.id))
            session.jumped = self._lifecycle.jumped(session)
            self._prisms.restore(session)
        opened = self._open
        if opened is None:
            return
        log.warning("session %s (prism %s) was open when rigcal last ended; it goes on", opened.id, opened.prism)
        if self._aim is not None:  # what aims may have forgotten; an operator's station has kept its lock
            self._aim(opened.prism)
            self._prisms.turned(opened, self._clock.now())
