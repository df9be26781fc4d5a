"""Checks in each session that its stations stay on its prism, and takes an operator's confirmation that they do."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from calibration.rig.description import Rig
from daemon.acquisition.joiner import JoinedFix
from daemon.commands import caller_columns
from daemon.sessions.open_session import OpenSession
from daemon.sessions.prisms.evidence import Finding, PrismEvidence, Stretch, Verdict
from daemon.sessions.prisms.guard import UNTIL, MotionLimit, OperatorConfirmation, PrismGuard, Suspicion, Turn
from daemon.sessions.prisms.identity_loader import IdentityLoader
from daemon.sessions.prisms.sightings import sightings_of
from daemon.sessions.prisms.standstill_places import Exclusions
from daemon.sessions.station_setups import Place
from daemon.store.queries.observations import fixes_since_used
from daemon.store.queries.sessions import SessionTable, prism_confirmations
from daemon.store.queries.zeros import newest_jumps
from daemon.store.store import Store
from drivers.clock import Clock, Stamp, lies_within
from drivers.readings import DeviceEvent, EventKind, Fix, LockState, Status
from drivers.stations.survey import position_mm

log = logging.getLogger(__name__)

_NUMBERS = ("hz_angle_rad", "zenith_angle_rad", "slope_distance_m", "north_m", "east_m", "up_m")


class PrismWatch:
    """The guards of sessions' prisms.

    Args:
        store: store of the operators' confirmations, the fixes and the observations.
        rig: rig whose sessions are checked.
        clock: clock for the instants of confirmations and events.
        limits: station -> limits of its prism's motion.
        tell: called with each event for the operator, to store it.
        measured: returns when a fix was measured, which is before it arrived.
    """

    def __init__(
        self,
        store: Store,
        rig: Rig,
        clock: Clock,
        limits: Mapping[str, MotionLimit],
        tell: Callable[[DeviceEvent], None],
        measured: Callable[[Fix], Stamp],
    ) -> None:
        self._store, self._rig, self._clock, self._limits, self._keep = store, rig, clock, limits, tell
        self._measured = measured
        self._table = SessionTable(store, rig.name)
        self._loader = IdentityLoader(rig)

    def prepare(self, wait_s: float = 0.0) -> None:
        """Start loading the check against the joints, and wait for its end for at most `wait_s` seconds."""
        self._loader.start(wait_s)

    def trouble(self) -> str | None:
        """Return why prisms cannot be checked against the joints, a clause; None if they can, or have not been yet."""
        return self._loader.trouble

    def begin(self, session: OpenSession) -> None:
        """Load what earlier sessions measured in the session's set-up."""
        session.evidence = self._evidence(session)

    def _evidence(self, session: OpenSession) -> PrismEvidence:
        jumped = [jump.at for jump in newest_jumps(self._store) if jump.device in self._rig.joint_names]
        since = max(jumped, key=self._store.order, default=None)
        groups: dict[str, list[tuple[str, Mapping[str, float], Place]]] = {}
        for row in self._table.standstill_observations(session.setup_id, since):
            place_mm = row["x_mm"], row["y_mm"], row["z_mm"]
            groups.setdefault(row["session_id"], []).append((row["prism"], json.loads(row["values_json"]), place_mm))
        earlier = [sightings_of(self._rig, rows) for rows in groups.values()]
        return PrismEvidence(self._rig, session.prism, self._loader, earlier)

    def see(self, session: OpenSession, fix: Fix) -> None:
        """Add a fix of the session, in order."""
        event = self._take(session, fix)
        if event is not None:
            self._tell(event)

    def ask_joints(self, session: OpenSession, joined: JoinedFix, place_mm: Place) -> Exclusions:
        """Compare a fix given to `see` with the joints, and return the exclusions of earlier observations that change.

        Args:
            session: session in which the fix was measured.
            joined: the fix with its joints.
            place_mm: place of its target in the station's frame.
        """
        if (followed := _followed(session, joined)) is None:
            return {}
        _, evidence, turn = followed
        changed: Exclusions = {}
        stretch = evidence.stretch(joined.fix.station, turn.at, turn.is_believed)

        def is_doubted(known: Stretch) -> bool:
            return session.guards[known.station].doubt(known.since) is not None

        for finding in evidence.take(stretch, joined, place_mm, is_doubted):
            changed |= self._heed(session, finding)
        changed |= self._stray(session, joined, turn, stretch)
        stretch.instants_ns.append(joined.stamp.monotonic_ns)
        return changed

    def note_moving(self, session: OpenSession, joined: JoinedFix) -> None:
        """Note a fix given to `see` of a moving boom: later verdicts on its target apply to it as well."""
        if (followed := _followed(session, joined)) is not None:
            _, evidence, turn = followed
            stretch = evidence.stretch(joined.fix.station, turn.at, turn.is_believed)
            stretch.instants_ns.append(joined.stamp.monotonic_ns)

    def follow(self, session: OpenSession, joined: JoinedFix, place_mm: Place) -> None:
        """Compare a fix given to `see`, used or not, with the motion of the joints since the previous fix.

        A target that has moved differently is another target, even if a prism could have moved as far. Which of the two
        is the session's prism is decided by the joints over the whole stretch, or by an operator; until then the fixes
        are not used.

        Args:
            session: session in which the fix was measured.
            joined: the fix with its joints.
            place_mm: place of its target in the station's frame.
        """
        if (followed := _followed(session, joined)) is None:
            return
        guard, evidence, turn = followed
        is_suspected = guard.doubt(joined.stamp) is not None
        jump_m = evidence.jump_m(joined, place_mm, turn, is_suspected=is_suspected)
        if jump_m is None:
            return
        is_told = guard.may_turn(joined.stamp)
        turn = guard.part(joined.stamp)
        if is_told:
            return
        text = _moved_otherwise(jump_m, session.prism)
        if not is_suspected:
            guard.suspect(turn, jump_m, text)
        self._tell_of_jump(joined.fix.station, text)

    def _stray(self, session: OpenSession, joined: JoinedFix, turn: Turn, stretch: Stretch) -> Exclusions:
        """Suspect all fixes since a turn if the target strayed from the joints' motion; return their exclusions.

        A target that strays gradually shows no jump. It was another target from the turn on, even where an operator had
        confirmed the prism, because the lock may have been lost just afterwards.
        """
        guard, station = session.guards[joined.fix.station], joined.fix.station
        if guard.doubt(joined.stamp) is not None or session.evidence is None:
            return {}
        stray_m = session.evidence.stray_m(station)
        if stray_m is None:
            return {}
        text = _moved_otherwise(stray_m, session.prism)
        suspicion = guard.suspect(turn, stray_m, text)
        self._tell_of_jump(station, text)
        return dict.fromkeys(stretch.instants_ns, suspicion.reason)

    def _heed(self, session: OpenSession, finding: Finding) -> Exclusions:
        """Suspect or clear a stretch by the verdict of the joints, and return the exclusions that change."""
        stretch, station = finding.stretch, finding.stretch.station
        guard = session.guards[station]
        turn, is_suspected = Turn(stretch.since, stretch.is_believed), guard.doubt(stretch.since) is not None
        if is_suspected == (stretch.verdict is Verdict.OTHER):
            return {}
        if stretch.verdict is Verdict.OTHER:
            fits = f", and fits {finding.is_like}" if finding.is_like else ""
            evidence = f"the target is {finding.distance_m:.2f} m from where the joints place {session.prism}{fits}"
            reason: str | None = guard.suspect(turn, finding.distance_m, evidence).reason
            self._tell_of_jump(station, evidence)
        else:
            guard.clear(turn)
            reason = None
            text = f"the target is where the joints place {session.prism}; its fixes are used"
            self._tell(DeviceEvent(station, self._clock.now(), EventKind.LOCK_ACQUIRED, text))
        return dict.fromkeys(stretch.instants_ns, reason)

    def _tell_of_jump(self, station: str, what: str) -> None:
        text = f"{what}; its fixes are not used {UNTIL}"
        self._tell(DeviceEvent(station, self._clock.now(), EventKind.PRISM_JUMP, text))

    def _tell(self, event: DeviceEvent) -> None:
        log.warning("station %s: %s", event.device, event.text)
        self._keep(event)

    def doubt(self, session: OpenSession, joined: JoinedFix) -> str | None:
        """Return why a fix given to `see` must not be used; None if it may."""
        guard = session.guards.get(joined.fix.station)
        suspicion = guard.doubt(joined.stamp) if guard is not None else None
        return suspicion.reason if suspicion is not None else None

    def suspicions(self, session: OpenSession) -> list[Suspicion]:
        """Return the session's lasting suspicions."""
        return [guard.suspicion for guard in list(session.guards.values()) if guard.suspicion is not None]

    def confirm(self, session: OpenSession, operator: str) -> dict[str, Any]:
        """Note the confirmation that the session's stations are on its prism: their fixes are used from now on."""
        ended = self.suspicions(session)
        at = self._clock.now()
        who = operator or "an operator"
        text = f"{who} confirms that the station is on prism {session.prism}; its fixes are used from now on"
        stations = [suspicion.station for suspicion in ended] or [*self._limits]
        events = [DeviceEvent(station, at, EventKind.PRISM_CONFIRMED, text) for station in stations]
        with self._store.transaction():
            self._table.add_confirmation(session.id, at, operator=operator, turning=False, **caller_columns())
            self._store.insert_records(events)
            self._store.once_committed(partial(session.confirmations.append, OperatorConfirmation(at)))
        log.info("session %s: %s", session.id, text)
        advice = [
            f"fixes that {suspicion.station} measured before its target jumped by {suspicion.distance_m:.2f} m stay in "
            "use: if it was on another prism then, reject the session after its end: `rigcal session reject "
            f"{session.id}`"
            for suspicion in ended
        ]
        return {
            "session": session.id,
            "prism": session.prism,
            "text": text,
            "ended": [as_dict(suspicion) for suspicion in ended],
            "advice": advice,
        }

    def turned(self, session: OpenSession, at: Stamp) -> None:
        """Note that the station was turned to the session's prism by a program that knows the prism's place."""
        self._table.add_confirmation(session.id, at, turning=True)
        self._store.once_committed(partial(session.confirmations.append, OperatorConfirmation(at, is_turning=True)))

    def restore(self, session: OpenSession) -> None:
        """Restore the state of an earlier run of the daemon from the store.

        A restart ends no suspicion, and a change of target while the daemon was down may begin one.
        """
        self.prepare()
        with self._store.reader() as reader:
            rows = prism_confirmations(reader, session.id)
            session.confirmations += [OperatorConfirmation(reader.stamp(row), bool(row["turning"])) for row in rows]
        self.judge_again(session)

    def judge_again(self, session: OpenSession, until: Stamp | None = None) -> None:
        """Judge the stored fixes of a session anew; the next fix is treated as a new lock.

        Args:
            session: the session, of which more has become known; left as it is if the store cannot be read.
            until: fixes that arrived from this instant on are left out, because they are still to be given to `see`.
        """
        evidence, guards = self._evidence(session), dict[str, PrismGuard]()
        with self._store.reader() as reader:
            for station in self._limits:
                guard = guards[station] = self._new_guard(session, station)
                for row in fixes_since_used(reader, session.id, station):
                    arrived = reader.stamp(row)
                    if until is not None and lies_within(session.order, arrived, until, None):
                        break
                    fix = self._as_measured(_fix(station, row, arrived))
                    if self._is_of_target(session, fix):
                        guard.see(fix)
                        guard.suspect_again(fix.stamp, row["excluded"] or "")
                    else:
                        guard.look_away()
                guard.look_away()
        session.evidence, session.guards, session.is_outdated = evidence, guards, False
        for suspicion in self.suspicions(session):
            log.warning("session %s: %s; %s", session.id, suspicion.reason, suspicion.remedy)

    def _take(self, session: OpenSession, fix: Fix) -> DeviceEvent | None:
        guard = self._guard(session, fix.station)
        measured = self._as_measured(fix)
        if self._is_of_target(session, measured):
            return guard.see(measured)
        guard.look_away()
        return None

    def _as_measured(self, fix: Fix) -> Fix:
        """Return a fix stamped with when it was measured, which is what confirmations and shots are compared with."""
        return replace(fix, stamp=self._measured(fix))

    def _is_of_target(self, session: OpenSession, fix: Fix) -> bool:
        """Return False for a fix, stamped as measured, that is known to be of a control point."""
        place_mm = position_mm(fix)
        return session.has(fix.stamp) and not (place_mm is not None and session.is_control_point(place_mm))

    def _guard(self, session: OpenSession, station: str) -> PrismGuard:
        if station not in session.guards:
            session.guards[station] = self._new_guard(session, station)
        return session.guards[station]

    def _new_guard(self, session: OpenSession, station: str) -> PrismGuard:
        limit = self._limits.get(station, MotionLimit())
        return PrismGuard(station, limit, session.confirmations, self._store.order)


def _followed(session: OpenSession, joined: JoinedFix) -> tuple[PrismGuard, PrismEvidence, Turn] | None:
    """Return guard, evidence and turn of the target that a fix given to `see` is of; None if nothing is known of it."""
    guard, evidence = session.guards.get(joined.fix.station), session.evidence
    turn = None if guard is None else guard.turn(joined.stamp)
    return None if guard is None or evidence is None or turn is None else (guard, evidence, turn)


def as_dict(suspicion: Suspicion) -> dict[str, Any]:
    """Return a suspicion as `status` shows it."""
    return {
        "station": suspicion.station,
        "since_utc_ns": suspicion.since.utc_ns,
        "distance_m": suspicion.distance_m,
        "text": suspicion.reason,
        "remedy": suspicion.remedy,
    }


def _fix(station: str, row: Mapping[str, Any], stamp: Stamp) -> Fix:
    """Return a stored fix with the fields that a guard uses."""
    numbers = {name: row[name] for name in _NUMBERS}
    return Fix(station, stamp, stamp, Status(row["status"]), LockState(row["lock"]), **numbers)


def _moved_otherwise(distance_m: float, prism: str) -> str:
    return f"the target's motion differs by {distance_m:.2f} m from the motion of {prism} computed from the joints"
