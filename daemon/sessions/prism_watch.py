"""Watches in each session that its stations stay on its prism, and takes an operator's word that they are."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from calibration.rig.description import Rig
from daemon.acquisition.joiner import JoinedFix
from daemon.commands import caller_columns
from daemon.sessions.open_session import OpenSession
from daemon.sessions.prisms.evidence import Finding, IdentityLoader, PrismEvidence, Stretch, Verdict, sightings_of
from daemon.sessions.prisms.guard import CONFIRM, MotionLimit, PrismGuard, Suspicion, Turn, Word
from daemon.sessions.prisms.standstill_places import Exclusions
from daemon.sessions.station_setups import Place
from daemon.store.queries.observations import fixes_since_used
from daemon.store.queries.sessions import SessionTable, prism_confirmations
from daemon.store.queries.zeros import preset_jumps
from daemon.store.store import Store
from drivers.clock import Clock, Stamp
from drivers.readings import DeviceEvent, EventKind, Fix, LockState, Status
from drivers.stations.survey import position_mm

log = logging.getLogger(__name__)

_NUMBERS = ("hz_angle_rad", "zenith_angle_rad", "slope_distance_m", "north_m", "east_m", "up_m")


class PrismWatch:
    """The guards of sessions' prisms.

    Args:
        store: where operators' words are kept; fixes and observations are there.
        rig: whose sessions are watched.
        clock: for when they were given.
        limits: station -> what motion can do to its prism.
        tell: takes what there is to tell an operator, to be stored.
    """

    def __init__(
        self,
        store: Store,
        rig: Rig,
        clock: Clock,
        limits: Mapping[str, MotionLimit],
        tell: Callable[[DeviceEvent], None],
    ) -> None:
        self._store, self._rig, self._clock, self._limits, self._keep = store, rig, clock, limits, tell
        self._table = SessionTable(store, rig.name)
        self._loader = IdentityLoader(rig)

    def prepare(self, wait_s: float = 0.0) -> None:
        """Be ready to ask the joints of a session's prism, and wait for that at most so long."""
        self._loader.start(wait_s)

    def trouble(self) -> str | None:
        """Return why the joints cannot be asked of prisms, a clause; None where they can, or nobody has wanted to."""
        return self._loader.trouble

    def begin(self, session: OpenSession) -> None:
        """Take a session's set-up into account: what was measured there before."""
        jumps = [jump for jump in preset_jumps(self._store, None) if jump.device in self._rig.joint_names]
        groups: dict[str, list[tuple[str, Mapping[str, float], Place]]] = {}
        for row in self._table.standstill_observations(session.setup_id, jumps[-1].at if jumps else None):
            place_mm = row["x_mm"], row["y_mm"], row["z_mm"]
            groups.setdefault(row["session_id"], []).append((row["prism"], json.loads(row["values_json"]), place_mm))
        earlier = [sightings_of(self._rig, rows) for rows in groups.values()]
        session.evidence = PrismEvidence(self._rig, session.prism, self._loader, earlier)

    def see(self, session: OpenSession, fix: Fix) -> None:
        """Take a fix of the session, in order."""
        event = self._take(session, fix)
        if event is not None:
            self._tell(event)

    def ask_joints(self, session: OpenSession, joined: JoinedFix, place_mm: Place) -> Exclusions:
        """Ask the joints of a fix that was seen; why earlier observations must not be used, where that has changed."""
        guard, evidence = session.guards.get(joined.fix.station), session.evidence
        turn = None if guard is None else guard.turn(joined.fix.stamp)
        if guard is None or evidence is None or turn is None:
            return {}
        changed: Exclusions = {}
        stretch = evidence.stretch(joined.fix.station, turn.at, turn.is_believed)
        for finding in evidence.take(stretch, joined, place_mm):
            changed |= self._heed(session, finding)
        changed |= self._stray(session, joined, turn, stretch)
        stretch.instants_ns.append(joined.stamp.monotonic_ns)
        return changed

    def follow(self, session: OpenSession, joined: JoinedFix, place_mm: Place) -> None:
        """Hold a fix that was seen, whether it is used or not, against what the joints did since the one before.

        A target that has moved otherwise is another one, although it is no further than a prism might move. Which of
        both is meant is left to what the joints say of the whole stretch, or to an operator: its fixes do not count.
        """
        guard, evidence = session.guards.get(joined.fix.station), session.evidence
        turn = None if guard is None else guard.turn(joined.fix.stamp)
        if guard is None or evidence is None or turn is None:
            return
        is_suspected = guard.doubt(joined.fix.stamp) is not None
        jump_m = evidence.jump_m(joined, place_mm, turn, is_suspected=is_suspected)
        if jump_m is None:
            return
        is_told = guard.may_turn(joined.fix.stamp)
        turn = guard.part(joined.fix.stamp)
        if is_told:
            return
        text = _moved_otherwise(jump_m, session.prism)
        if not is_suspected:
            guard.suspect(turn, jump_m, text)
        self._tell_of_jump(joined.fix.station, text)

    def _stray(self, session: OpenSession, joined: JoinedFix, turn: Turn, stretch: Stretch) -> Exclusions:
        """Suspect all since a turn where the target strayed from what the joints did; the turn's observations.

        What strays little by little jumps nowhere: it was another target from the turn on, also where an operator had
        confirmed the prism: the lock may have been lost just after.
        """
        guard, station = session.guards[joined.fix.station], joined.fix.station
        if guard.doubt(joined.fix.stamp) is not None or session.evidence is None:
            return {}
        stray_m = session.evidence.stray_m(station)
        if stray_m is None:
            return {}
        text = _moved_otherwise(stray_m, session.prism)
        suspicion = guard.suspect(turn, stray_m, text)
        self._tell_of_jump(station, text)
        return dict.fromkeys(stretch.instants_ns, suspicion.reason)

    def _heed(self, session: OpenSession, finding: Finding) -> Exclusions:
        """Suspect a stretch, or suspect it no more, as the joints say; its observations for which that is news."""
        stretch, station = finding.stretch, finding.stretch.station
        guard = session.guards[station]
        turn, is_suspected = Turn(stretch.since, stretch.is_believed), guard.doubt(stretch.since) is not None
        if is_suspected == (stretch.verdict is Verdict.OTHER):
            return {}
        if stretch.verdict is Verdict.OTHER:
            fits = f"; it fits {finding.is_like}" if finding.is_like else ""
            evidence = f"{finding.distance_m:.2f} m from where the joints put {session.prism}{fits}"
            reason: str | None = guard.suspect(turn, finding.distance_m, evidence).reason
            self._tell_of_jump(station, f"the target is {evidence}")
        else:
            guard.clear(turn)
            reason = None
            text = f"the target is where the joints put {session.prism}; its fixes count"
            self._tell(DeviceEvent(station, self._clock.now(), EventKind.LOCK_ACQUIRED, text))
        return dict.fromkeys(stretch.instants_ns, reason)

    def _tell_of_jump(self, station: str, what: str) -> None:
        text = f"{what}; its fixes do not count until the station is back, or until {CONFIRM}"
        self._tell(DeviceEvent(station, self._clock.now(), EventKind.PRISM_JUMP, text))

    def _tell(self, event: DeviceEvent) -> None:
        log.warning("station %s: %s", event.device, event.text)
        self._keep(event)

    def doubt(self, session: OpenSession, fix: Fix) -> str | None:
        """Why a fix that was seen must not be used; None when it may."""
        guard = session.guards.get(fix.station)
        suspicion = guard.doubt(fix.stamp) if guard is not None else None
        return suspicion.reason if suspicion is not None else None

    def suspicions(self, session: OpenSession) -> list[Suspicion]:
        """Return the suspicions of the session that last."""
        return [guard.suspicion for guard in list(session.guards.values()) if guard.suspicion is not None]

    def confirm(self, session: OpenSession, operator: str) -> dict[str, Any]:
        """Take the word that the session's stations are on its prism: their fixes count from now on."""
        ended = self.suspicions(session)
        at = self._clock.now()
        who = operator or "an operator"
        text = f"{who} confirms that the station is on prism {session.prism}; its fixes count from now on"
        stations = [suspicion.station for suspicion in ended] or [*self._limits]
        events = [DeviceEvent(station, at, EventKind.PRISM_CONFIRMED, text) for station in stations]
        with self._store.transaction():
            self._table.add_confirmation(session.id, at, operator=operator, turning=False, **caller_columns())
            self._store.insert_records(events)
            self._store.once_committed(partial(session.words.append, Word(at)))
        log.info("session %s: %s", session.id, text)
        advice = [
            f"what {suspicion.station} measured before it jumped by {suspicion.distance_m:.2f} m counts too: if it was "
            "on another prism then, abort the session and hold a new one"
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
        """The station was turned to the session's prism by something that knows where that is."""
        self._table.add_confirmation(session.id, at, turning=True)
        self._store.once_committed(partial(session.words.append, Word(at, is_turning=True)))

    def restore(self, session: OpenSession) -> None:
        """Restore the knowledge of an earlier run of the daemon from the store; the next fix is a new lock.

        A restart ends no suspicion, and what happened while nobody listened may begin one.
        """
        self.prepare()
        self.begin(session)
        with self._store.reader() as reader:
            words = prism_confirmations(reader, session.id)
            session.words += [Word(reader.stamp(row), bool(row["turning"])) for row in words]
            for station in self._limits:
                for row in fixes_since_used(reader, session.id, station):
                    self._take(session, _fix(station, row, reader.stamp(row)))
                self._guard(session, station).look_away()
        for suspicion in self.suspicions(session):
            log.warning("session %s: %s; %s", session.id, suspicion.reason, suspicion.remedy)

    def _take(self, session: OpenSession, fix: Fix) -> DeviceEvent | None:
        guard = self._guard(session, fix.station)
        place_mm = position_mm(fix)
        if not session.has(fix.stamp) or (place_mm is not None and session.is_control_point(place_mm)):
            guard.look_away()
            return None
        return guard.see(fix)

    def _guard(self, session: OpenSession, station: str) -> PrismGuard:
        if station not in session.guards:
            limit = self._limits.get(station, MotionLimit())
            session.guards[station] = PrismGuard(station, limit, session.words, self._store.order)
        return session.guards[station]


def as_dict(suspicion: Suspicion) -> dict[str, Any]:
    """A suspicion as `status` shows it."""
    return {
        "station": suspicion.station,
        "since_utc_ns": suspicion.since.utc_ns,
        "distance_m": suspicion.distance_m,
        "text": suspicion.reason,
        "remedy": suspicion.remedy,
    }


def _fix(station: str, row: Mapping[str, Any], stamp: Stamp) -> Fix:
    """As much of a stored fix as a guard looks at."""
    numbers = {name: row[name] for name in _NUMBERS}
    return Fix(station, stamp, stamp, Status(row["status"]), LockState(row["lock"]), **numbers)


def _moved_otherwise(distance_m: float, prism: str) -> str:
    return f"the target moved {distance_m:.2f} m otherwise than the joints moved {prism}"
