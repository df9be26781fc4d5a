"""Observations of calibration sessions: joined fixes, judged whether calibration may use them, and stored.

A fix of the open session is kept whatever is wrong with it; why calibration must not use it stands beside it, and may
change as more fixes come.
"""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Callable, Sequence
from functools import partial

from calibration.rig.description import Rig
from daemon.acquisition.joiner import JoinedFix
from daemon.commands import CHECK
from daemon.sessions.open_session import CONSTANT_TOLERANCE_MM, OpenSession
from daemon.sessions.prism_watch import PrismWatch
from daemon.sessions.prisms.standstill_places import Exclusions, StandstillPlaces
from daemon.sessions.station_setups import AXES, Place
from daemon.store.errors import is_unwritable
from daemon.store.queries.observations import OF_CONTROL_POINT, ObservationTable
from daemon.store.store import Store
from drivers.clock import Stamp, lies_within
from drivers.readings import DeviceEvent, Fix

log = logging.getLogger(__name__)

STANDING_KINDS = ("static_poses", CHECK)
_LEFT_OUT = "what a session observed cannot be stored, and is left out"


class PendingWrites:
    """Changes that the store has yet to take, in their order; they wait while it refuses them for now.

    Args:
        store: the database.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._writes: list[Callable[[], object]] = []
        self._is_waiting = False

    def add(self, write: Callable[[], object]) -> None:
        """Add a change, made within the transaction of all that wait."""
        self._writes.append(write)

    def add_event(self, event: DeviceEvent) -> None:
        """Add an event of a device."""
        self.add(lambda: self._store.insert_records([event]))

    def store(self) -> None:
        """Make all changes, or none while the store can take none; one that can never be made is told and left out.

        Raises:
            sqlite3.DatabaseError: the store is damaged and can commit none; they are given up.
        """
        if not self._writes:
            return
        try:
            with self._store.transaction():
                self._make(self._writes)
        except sqlite3.DatabaseError as error:
            if not is_unwritable(error):
                self._writes.clear()  # what can never be stored must not keep out all that follows
                raise
            if not self._is_waiting:
                log.error("observations cannot be stored (%s); they wait and are tried again", error)
            self._is_waiting = True
            return
        self._writes.clear()
        self._is_waiting = False

    def _make(self, writes: Sequence[Callable[[], object]]) -> None:
        """Make changes; one that can never be made must not keep out the others."""
        try:
            with self._store.transaction():
                for write in writes:
                    write()
        except Exception as error:
            if is_unwritable(error):
                raise
            if len(writes) == 1:
                # Once it is: where the disk then refuses the others, this one is tried again with them.
                self._store.once_committed(partial(log.error, _LEFT_OUT, exc_info=error))
                return
        else:
            return
        for write in writes:
            self._make([write])


class ObservationMaker:
    """Makes observations of joined fixes; for the writer's thread.

    Args:
        rig: whose joints they hold.
        store: where they go.
        pending: takes them, until the store does.
        prisms: tell which fixes are of another prism.
        run_id: of this run of the daemon; poses are numbered within it.

    Attributes:
        newest: session and instant of the newest observation, and why it does not count; None before the first.
    """

    def __init__(self, rig: Rig, store: Store, pending: PendingWrites, prisms: PrismWatch, run_id: int) -> None:
        self._rig, self._store, self._pending, self._prisms, self._run_id = rig, store, pending, prisms, run_id
        self._table = ObservationTable(store)
        self._places = StandstillPlaces(rig)
        self.newest: tuple[str, Stamp, str | None] | None = None

    def observe(self, session: OpenSession, joined: JoinedFix, place_mm: Place) -> None:
        """Make an observation of the session in which a fix was measured.

        Args:
            session: it was open then.
            joined: the fix with its joints.
            place_mm: where the fix lies.
        """
        excluded = (
            self._why_not_a_pose(session, joined, place_mm)
            or self._why_another_prism(session, joined, place_mm)
            or _why_another_constant(session, joined.fix)
        )
        self.newest = session.id, joined.stamp, excluded
        self._pending.add(lambda: self._add(session, joined, place_mm, excluded))

    def _why_not_a_pose(self, session: OpenSession, joined: JoinedFix, place_mm: Place) -> str | None:
        """Why a fix is no pose of the machine, whichever prism it is of; fixes that may be are followed."""
        if joined.refused:
            return joined.refused
        for joint in self._rig.joint_names:
            if joint in session.jumped and lies_within(session.order, joined.stamp, session.jumped[joint], None):
                return f"{joint} jumped: its readings from then on do not fit those before"
        if session.is_control_point(place_mm):
            return OF_CONTROL_POINT
        self._prisms.follow(session, joined, place_mm)
        return "moving" if session.kind in STANDING_KINDS and joined.standstill is None else None

    def _why_another_prism(self, session: OpenSession, joined: JoinedFix, place_mm: Place) -> str | None:
        """Why a fix must not be used since it may be of another prism; earlier ones are judged again."""
        changed = self._prisms.ask_joints(session, joined, place_mm)
        if changed:
            changed |= self._places.withdraw([at_ns for at_ns, why in changed.items() if why is not None])
        excluded = self._prisms.doubt(session, joined.fix)
        if excluded is None and joined.standstill is not None:
            standstill, confirmed = (session.id, joined.standstill), session.confirmations_by(joined.fix.stamp)
            at_ns = joined.stamp.monotonic_ns
            here = self._places.add(standstill, at_ns, place_mm, joined.values, confirmed)
            excluded = here.pop(at_ns)
            changed |= here
        self._exclude(session, changed, joined.stamp)
        return excluded

    def _exclude(self, session: OpenSession, changed: Exclusions, stamp: Stamp) -> None:
        if changed:
            self._pending.add(lambda: self._table.exclude(session.id, changed, stamp))

    def _add(self, session: OpenSession, joined: JoinedFix, place_mm: Place, excluded: str | None) -> None:
        """Store an observation; since it was judged, a shot may have told that a control point is there."""
        if excluded is None and session.is_control_point(place_mm):
            excluded = OF_CONTROL_POINT
        standing = joined.standstill is not None
        self._table.add(
            self._store.fix_id(joined.fix),
            joined.stamp,
            session_id=session.id,
            setup_id=session.setup_id,
            prism=session.prism,
            pose=f"{self._run_id}.{joined.standstill}" if standing else None,
            **dict(zip(AXES, place_mm, strict=True)),
            dwell_s=joined.dwell_s,
            moving=not standing,
            values_json=joined.values,
            excluded=excluded,
        )


def _why_another_constant(session: OpenSession, fix: Fix) -> str | None:
    """Why a fix that might be used must not be: its station applies another prism constant than to the first one."""
    if fix.prism_constant_mm is None:
        return None
    first_mm = session.constants_mm.setdefault(fix.station, fix.prism_constant_mm)
    if abs(fix.prism_constant_mm - first_mm) <= CONSTANT_TOLERANCE_MM:
        return None
    return f"the station applies a prism constant of {fix.prism_constant_mm:g} mm, and {first_mm:g} mm at first"
