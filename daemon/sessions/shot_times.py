"""Times at which the station is on a control point, not on a session's prism; stored, so that a restart knows them."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager

from daemon.sessions.control_shot import Shot
from daemon.sessions.open_session import OpenSession
from daemon.sessions.prisms.guard import Suspicion
from daemon.store.errors import is_unwritable
from daemon.store.queries.setups import shot_events
from daemon.store.store import Store
from drivers.clock import Clock, Stamp
from drivers.readings import DeviceEvent, EventKind

log = logging.getLogger(__name__)

_CUT_OFF = "rigcal ended while the station was on a control point"


class ShotTimes:
    """Turns of the station to control points and back.

    Args:
        store: store of the turns, as events of the stations.
        clock: clock of the rig.
        stations: names of the configured stations.
        aim: turns the station to a prism or control point; None where the operator does it.
        turned: called with a session and the instant at which `aim` has turned the station back to its prism.
        later: takes a change that the store has refused, and makes it as soon as the store can be written.
    """

    def __init__(
        self,
        store: Store,
        clock: Clock,
        stations: Collection[str],
        aim: Callable[[str], None] | None,
        turned: Callable[[OpenSession, Stamp], None],
        later: Callable[[Callable[[], object]], None],
    ) -> None:
        self._store, self._clock, self._stations, self._aim, self._turned = store, clock, stations, aim, turned
        self._later = later

    @contextmanager
    def on_point(self, session: OpenSession, point: str, wanted: int) -> Iterator[Shot]:
        """Add a shot to a session; its fixes in the block are not of the prism.

        Args:
            session: the open session.
            point: the control point.
            wanted: number of fixes needed.
        """
        shot = Shot(wanted, self._clock.now())
        self._note(EventKind.SHOT_BEGUN, shot.since, f"shot of control point {point} begun")
        session.shots.append(shot)
        try:
            if self._aim is not None:
                self._aim(point)
            shot.aimed = self._clock.now()
            yield shot
        finally:
            if self._aim is not None:
                self._aim(session.prism)
            try:
                self._note_end(session, point, self._clock.now())
            finally:
                shot.until = self._clock.now()  # only now, because until then the shot's caller waits

    def _note(self, kind: EventKind, at: Stamp, text: str) -> None:
        self._store.insert_records([DeviceEvent(station, at, kind, text) for station in self._stations])

    def _note_end(self, session: OpenSession, point: str, at: Stamp) -> None:
        """Store the end of a shot, and that a program turned the station, if one does; later if the disk refuses it."""

        def note() -> None:
            with self._store.transaction():
                self._note(EventKind.SHOT_ENDED, at, f"shot of control point {point} ended")
                if self._aim is not None:
                    self._turned(session, at)

        try:
            note()
        except sqlite3.Error as error:
            if not is_unwritable(error):
                raise
            log.warning("the end of a shot of control point %s will be stored later: %s", point, error)
            self._later(note)

    def cut_off(self, session: OpenSession) -> Stamp | None:
        """Return the start of a shot of a session that the end of an earlier run cut off; None without one."""
        for station in self._stations:
            events = [event for event in shot_events(self._store, station, session.since) if session.lasted(event[1])]
            if events and events[-1][0] == EventKind.SHOT_BEGUN:
                log.warning("session %s: %s", session.id, _CUT_OFF)
                return events[-1][1]
        return None

    def suspicions(self, session: OpenSession) -> list[Suspicion]:
        """Return the suspicion that a shot that was cut off leaves; none while a guide knows where the station is."""
        since = session.cut_off
        if since is None or session.back() is not None or any(shot.until is None for shot in session.shots):
            return []
        return [Suspicion(station, since, 0.0, evidence=_CUT_OFF) for station in self._stations]
