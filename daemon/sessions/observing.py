"""Observations of calibration sessions: joined fixes, stored with the decision whether calibration may use them.

Every fix of the open session is kept. The reason why calibration must not use it, if any, is stored with it, and may
change as more fixes arrive.
"""

from __future__ import annotations

import json
import logging
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from calibration.rig.description import Rig
from daemon.acquisition.joiner import JoinedFix, joint_inputs
from daemon.commands import CHECK
from daemon.sessions.open_session import CONSTANT_TOLERANCE_MM, OTHER_CONSTANT, OpenSession
from daemon.sessions.prism_watch import PrismWatch
from daemon.sessions.prisms.standstill_places import (
    ELSEWHERE,
    SETTLED_FIXES,
    Exclusions,
    Standstill,
    StandstillPlaces,
    change_size,
)
from daemon.sessions.station_setups import AXES, Place
from daemon.store.errors import is_damage, is_unwritable
from daemon.store.queries.observations import OF_CONTROL_POINT, ObservationTable, last_standstills, newest_observation
from daemon.store.store import Store
from drivers.clock import Stamp, lies_within
from drivers.readings import DeviceEvent, Fix

log = logging.getLogger(__name__)

STANDING_KINDS = ("static_poses", CHECK)
MOVING = "moving"
_LEFT_OUT = "an observation of a session can never be stored, and was discarded"


class PendingWrites:
    """Pending changes of the store, in order, for the transaction that stores the records to which they are due.

    Args:
        store: the database.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._writes: list[Callable[[], object]] = []

    def add(self, write: Callable[[], object]) -> None:
        """Add a change; all pending changes are made in one transaction."""
        self._writes.append(write)

    def add_event(self, event: DeviceEvent) -> None:
        """Add an event of a device."""
        self.add(lambda: self._store.insert_records([event]))

    def once_stored(self, work: Callable[[], object]) -> None:
        """Call `work`, which must be quick, once the changes that are pending now are committed."""
        self.add(partial(self._store.once_committed, work))

    def store(self) -> None:
        """Make all changes, which are pending until they are committed; log and discard one that can never be made.

        Raises:
            sqlite3.DatabaseError: the store cannot be written at present, or is damaged where changes are to be made,
                which are discarded; the transaction must be repeated without them.
        """
        if writes := [*self._writes]:
            with self._store.transaction():
                self._store.once_committed(partial(self._drop, len(writes)))
                self._make(writes)

    def _drop(self, made: int) -> None:
        del self._writes[:made]  # others may have been added meanwhile

    def _make(self, writes: Sequence[Callable[[], object]]) -> None:
        """Make changes; a change that can never be made does not block the others."""
        try:
            with self._store.transaction():
                for write in writes:
                    write()
        except Exception as error:
            if is_unwritable(error):
                raise
            if len(writes) > 1:
                self._make_singly(writes)
            elif is_damage(error):  # nothing of this transaction can be committed
                self._writes.remove(writes[0])
                log.error(_LEFT_OUT, exc_info=error)
                raise
            else:
                # Log only once committed: if the disk then refuses the others, this change is retried with them.
                self._store.once_committed(partial(log.error, _LEFT_OUT, exc_info=error))

    def _make_singly(self, writes: Sequence[Callable[[], object]]) -> None:
        damage: sqlite3.DatabaseError | None = None
        for write in writes:
            try:
                self._make([write])
            except sqlite3.DatabaseError as error:
                if not is_damage(error):
                    raise
                damage = error
        if damage is not None:
            raise damage


class ObservationMaker:
    """Makes observations of joined fixes; for the writer thread.

    Args:
        rig: the machine.
        store: the database.
        table: its observations.
        pending: queue of changes to the store.
        prisms: decides which fixes are of another prism.
        run_id: number of this run of the daemon; poses are numbered within a run, but the first one goes on with the
            last one of the run before if no joint has moved.

    Attributes:
        newest: session and instant of the newest observation, and why it is not used; None before the first.
    """

    def __init__(
        self, rig: Rig, store: Store, table: ObservationTable, pending: PendingWrites, prisms: PrismWatch, run_id: int
    ) -> None:
        self._rig, self._store, self._pending, self._prisms, self._run_id = rig, store, pending, prisms, run_id
        self._table = table
        self._places = StandstillPlaces(rig)
        self._motion_thresholds = {f"{joint.name}_{joint.unit}": joint.motion_threshold for joint in joint_inputs(rig)}
        self._restored: tuple[Standstill, Mapping[str, float]] | None = None  # newest standstill, and its joints
        self._has_stood = False  # in this run
        self._resumed: dict[Standstill, Standstill] = {}  # the first standstill of this run -> the one that goes on
        self.newest: tuple[str, Stamp, str | None] | None = None

    def restore(self, session: OpenSession) -> None:
        """Restore the newest observation, and decide again on the places of the newest standstill, from the store."""
        with self._store.reader() as reader:
            newest = newest_observation(reader, session.id)
            if newest is None:
                return
            self.newest = session.id, reader.stamp(newest), newest["excluded"]
            rows = [(row, reader.stamp(row)) for row in last_standstills(reader, session.id, ELSEWHERE, SETTLED_FIXES)]
        self._places, decided = StandstillPlaces(self._rig), Exclusions()
        for row, stamp in rows:
            standstill, confirmed = Standstill.of_pose(session.id, row["pose"]), session.confirmations_by(stamp)
            place_mm, values = (row["x_mm"], row["y_mm"], row["z_mm"]), json.loads(row["values_json"])
            decided |= self._places.add(standstill, stamp.monotonic_ns, place_mm, values, confirmed)
            self._restored = standstill, values
        if rows:
            last, newest_at = rows[-1]
            stored = {at.monotonic_ns: row["excluded"] for row, at in rows if row["pose"] == last["pose"]}
            changed = {at_ns: decided[at_ns] for at_ns, excluded in stored.items() if decided[at_ns] != excluded}
            self._exclude(session, changed, newest_at)

    def observe(self, session: OpenSession, joined: JoinedFix, place_mm: Place) -> None:
        """Make an observation of the session in which a fix was measured.

        Args:
            session: the session.
            joined: the fix with its joints.
            place_mm: place of the fix in the station's frame.
        """
        constants_mm = session.constants_mm  # before the control points are asked for: both are renewed together
        standstill = self._standstill(session, joined)
        excluded = (
            self._why_not_a_pose(session, joined, place_mm)
            or _why_another_constant(constants_mm, joined.fix)
            or self._why_another_prism(session, joined, place_mm, standstill)
        )
        if excluded is None and joined.fix.prism_constant_mm is not None:
            constants_mm.setdefault(joined.fix.station, joined.fix.prism_constant_mm)
        self.newest = session.id, joined.stamp, excluded
        self._pending.add(lambda: self._add(session, joined, place_mm, standstill, excluded))

    def _why_not_a_pose(self, session: OpenSession, joined: JoinedFix, place_mm: Place) -> str | None:
        """Return why a fix cannot be used as a pose, whatever its prism; None if it can. Usable fixes are followed."""
        if joined.refused:
            return joined.refused
        for joint in self._rig.joint_names:
            if joint in session.jumped and lies_within(session.order, joined.stamp, session.jumped[joint], None):
                return f"{joint} jumped: its readings after the jump do not fit those before"
        if session.is_control_point(place_mm):
            return OF_CONTROL_POINT
        self._prisms.follow(session, joined, place_mm)
        if session.kind in STANDING_KINDS and joined.standstill is None:
            self._prisms.note_moving(session, joined)
            # A suspicion is stored: a restart before the boom stands must not end it, and it is no fix of the prism
            return self._prisms.doubt(session, joined) or MOVING
        return None

    def _why_another_prism(
        self, session: OpenSession, joined: JoinedFix, place_mm: Place, standstill: Standstill | None
    ) -> str | None:
        """Return why a fix may be of another prism, and judge earlier fixes again; None if it is not suspected."""
        changed = self._prisms.ask_joints(session, joined, place_mm)
        if changed:
            changed |= self._places.withdraw([at_ns for at_ns, why in changed.items() if why is not None])
        excluded = self._prisms.doubt(session, joined)
        if excluded is None and standstill is not None:
            at_ns, confirmed = joined.stamp.monotonic_ns, session.confirmations_by(joined.stamp)
            here = self._places.add(standstill, at_ns, place_mm, joined.values, confirmed)
            excluded = here.pop(at_ns)
            changed |= here
        self._exclude(session, changed, joined.stamp)
        return excluded

    def _standstill(self, session: OpenSession, joined: JoinedFix) -> Standstill | None:
        """Return the standstill of a fix; None while the boom moves."""
        if joined.standstill is None:
            return None
        own = Standstill(session.id, self._run_id, joined.standstill)
        if not self._has_stood and not joined.refused:
            self._has_stood = True
            if self._restored is not None:
                before, values = self._restored
                if before.session == own.session and not self._has_moved(values, joined.values):
                    self._resumed[own] = before
        return self._resumed.get(own, own)

    def _has_moved(self, before: Mapping[str, float], now: Mapping[str, float]) -> bool:
        """Return True if a joint is elsewhere than before, as for motion between samples."""
        return any(
            change_size(column, now[column] - before[column]) >= threshold
            for column, threshold in self._motion_thresholds.items()
            if column in before
        )

    def _exclude(self, session: OpenSession, changed: Exclusions, stamp: Stamp) -> None:
        if changed:
            if_moving = MOVING if session.kind in STANDING_KINDS else None
            self._pending.add(lambda: self._table.exclude(session.id, changed, stamp, if_moving=if_moving))

    def _add(
        self,
        session: OpenSession,
        joined: JoinedFix,
        place_mm: Place,
        standstill: Standstill | None,
        excluded: str | None,
    ) -> None:
        """Store an observation; a shot may have located a control point at its place since it was judged."""
        if excluded is None and session.is_control_point(place_mm):
            excluded = OF_CONTROL_POINT
        self._table.add(
            self._store.fix_id(joined.fix),
            joined.stamp,
            session_id=session.id,
            setup_id=session.setup_id,
            prism=session.prism,
            pose=standstill and standstill.pose,
            **dict(zip(AXES, place_mm, strict=True)),
            dwell_s=joined.dwell_s,
            moving=standstill is None,
            values_json=joined.values,
            excluded=excluded,
        )


def _why_another_constant(constants_mm: Mapping[str, float], fix: Fix) -> str | None:
    """Return a clause if a fix's prism constant differs from that of its station's first usable fix, otherwise None.

    It is asked for before the prism: findings about the prism replace earlier verdicts, but not this one.
    """
    if fix.prism_constant_mm is None:
        return None
    first_mm = constants_mm.get(fix.station, fix.prism_constant_mm)
    if abs(fix.prism_constant_mm - first_mm) <= CONSTANT_TOLERANCE_MM:
        return None
    return f"{OTHER_CONSTANT} {fix.prism_constant_mm:g} mm, but applied {first_mm:g} mm at first"
