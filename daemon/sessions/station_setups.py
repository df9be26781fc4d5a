"""Station set-ups: where the total station stands, and the control points that show whether it has moved."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from functools import partial
from statistics import fmean
from typing import Any

from calibration.rig.description import Rig
from daemon.commands import (
    HOW_TO_END,
    REFUSED,
    CommandError,
    identifier,
    mapping_argument,
    number_argument,
    text_argument,
)
from daemon.store.queries.sessions import SessionTable
from daemon.store.queries.setups import SetupTable, control_points
from daemon.store.store import Store
from drivers.clock import Clock
from drivers.readings import Fix

log = logging.getLogger(__name__)

Place = tuple[float, float, float]
MOST_CONSTANT_MM = 500.0
CONTROL_POINT_RADIUS_MM = 300.0  # a target this close to a control point is that point, not the boom or another point
AXES = ("x_mm", "y_mm", "z_mm")


class StationSetups:
    """The set-ups of a store.

    Args:
        rig: the machine, whose prisms have constants.
        store: store of the set-ups.
        clock: clock for the instants of set-ups.
        tolerance_mm: a control point that is off by more than this shows that the set-up has moved.
    """

    def __init__(self, rig: Rig, store: Store, clock: Clock, tolerance_mm: float) -> None:
        self._rig, self._store, self._clock, self._tolerance_mm = rig, store, clock, tolerance_mm
        self._table, self._sessions = SetupTable(store, rig.name), SessionTable(store, rig.name)

    def new_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Store a new station set-up: instrument, tilt, ppm. It replaces no other, because each session names its own.

        Raises:
            CommandError: an argument is wrong, the name exists already, or a session is open, which keeps its set-up.
        """
        setup_id = identifier(arguments, "id", "a set-up's id")
        if setup_id in self._table.states():
            raise CommandError(
                f"set-up {setup_id!r} exists already: use `--setup {setup_id}` if the station has not moved since; if "
                "it has, describe a new set-up with a different name"
            )
        constants = mapping_argument(arguments, "prism_constants_mm")
        for prism in constants:
            number_argument(constants, prism, limit=MOST_CONSTANT_MM)
        unknown = sorted(set(constants) - set(self._rig.prism_names))
        if unknown:
            raise CommandError(
                f"rig {self._rig.name!r} has no prism {unknown[0]!r:.80}; it has {', '.join(self._rig.prism_names)}"
            )
        given = mapping_argument(arguments, "control_points")
        if named := next((name for name in given if name in self._rig.prism_names), None):
            raise CommandError(f"{named!r} is a prism of the rig; name a control point, which does not move with it")
        points = {str(n): _place(n, place) for n, place in given.items()}
        row: dict[str, object] = {
            "instrument": text_argument(arguments, "instrument"),
            "serial": text_argument(arguments, "serial"),
            "tilt_arcsec": number_argument(arguments, "tilt_arcsec"),
            "ppm": number_argument(arguments, "ppm"),
            "prism_constants_json": constants,
            "note": text_argument(arguments, "note"),
        }
        with self._store.transaction():
            if (opened := self._sessions.open_session()) is not None:
                raise CommandError(
                    f"session {opened.id!r} is open in the present set-up; {HOW_TO_END}, then describe the new set-up",
                    REFUSED,
                )
            self._table.add(self._clock.now(), id=setup_id, **row)
            for name, place in points.items():
                self._table.put_control_point(setup_id, name, place)
        return {"id": setup_id}

    def list_command(self, _arguments: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Return all set-ups with their control points, oldest first, and mark the current one."""
        current = self._table.current()
        name = None if current is None else current.id
        return [setup | {"is_current": setup["id"] == name} for setup in self._table.all()]

    def usable(self, wanted: object) -> str:
        """Return the requested set-up, or the current one if none is requested.

        Args:
            wanted: name of the set-up; None for the current one.

        Raises:
            CommandError: there is no such set-up, or it has moved.
        """
        if wanted is None:
            current = self._table.current()
            if current is None:
                raise CommandError("there is no station set-up; describe one with `rigcal setup new`")
            if current.state != "ok":
                raise CommandError(
                    f"the current set-up {current.id!r} has {current.state}; describe a new one with "
                    "`rigcal setup new`, or name another one with --setup if the station stands there again",
                    REFUSED,
                )
            return current.id
        states = self._table.states()
        if not isinstance(wanted, str) or wanted not in states:
            raise CommandError(f"there is no set-up {wanted!r:.80}; known: {', '.join(states) or 'none'}")
        if states[wanted] != "ok":
            raise CommandError(
                f"set-up {wanted!r} has {states[wanted]}: its control points no longer fit; describe the station's "
                "new set-up with `rigcal setup new`",
                REFUSED,
            )
        return wanted

    def has_moved(self, setup_id: str) -> bool:
        """Return True if a control point has shown that the set-up has moved."""
        return self._table.states()[setup_id] != "ok"

    def current(self) -> str | None:
        """Return the set-up that the station stands in; None if there is none, or if it has moved."""
        current = self._table.current()
        return current.id if current is not None and current.state == "ok" else None

    def store_shot(
        self,
        setup_id: str,
        session_id: str,
        name: str,
        phase: str,
        fixes: Sequence[Fix],
        places_mm: Sequence[Place],
        *,
        most_off_mm: float = math.inf,
    ) -> dict[str, Any]:
        """Store a shot of a control point, and mark the set-up as moved if the point is not where it was.

        Args:
            setup_id: set-up of the station.
            session_id: session in which the point was shot.
            name: name of the point; its first shot defines its place.
            phase: `start` or `end` of the session.
            fixes: fixes that are averaged.
            places_mm: their places in the station's frame.
            most_off_mm: a target further from the point's known place is not the point.

        Returns:
            point, phase, x_mm, y_mm, z_mm, misclosure_mm (None if this shot defined the point), moved.

        Raises:
            CommandError: the station is not on the point; nothing is stored.
        """
        known = self._known_place(setup_id, session_id, name, phase)
        place = {axis: fmean(p[i] for p in places_mm) for i, axis in enumerate(AXES)}
        reference = known or place
        distance_mm = _distance_mm(place, reference)
        if known is None or distance_mm >= CONTROL_POINT_RADIUS_MM:
            for other in control_points(self._store, setup_id, session_id):
                if other["name"] != name and _distance_mm(place, other) < CONTROL_POINT_RADIUS_MM:
                    raise CommandError(
                        f"the station is on control point {other['name']}, not on {name}, and nothing was stored: aim "
                        f"at {name} and measure again",
                        REFUSED,
                    )
        if distance_mm > most_off_mm:
            raise CommandError(
                f"the station's target is {distance_mm / 1e3:.1f} m from control point {name}, and nothing was stored: "
                f"aim at {name} and measure again; if the station itself was moved, stop the guide and start a new one "
                "with a new set-up",
                REFUSED,
            )
        misclosure_mm = distance_mm if known else None
        moved = distance_mm > self._tolerance_mm
        with self._store.transaction():
            if known is None:
                self._table.put_control_point(setup_id, name, place)
            self._table.add_shot(
                setup_id,
                name,
                fixes[0].stamp,
                session_id=session_id,
                phase=phase,
                **place,
                fix_ids_json=[self._store.fix_id(fix) for fix in fixes],
                misclosure_mm=misclosure_mm,
            )
            if moved:
                self._table.mark_moved(setup_id)
                told = "set-up %s moved: control point %s is %.1f mm off", setup_id, name, distance_mm
                self._store.once_committed(partial(log.warning, *told))
        return {
            "point": name,
            "phase": phase,
            **place,
            "misclosure_mm": misclosure_mm,
            "moved": moved,
        }

    def _known_place(self, setup_id: str, session_id: str, name: str, phase: str) -> dict[str, float] | None:
        """Return the known place of a control point; None if this shot defines it.

        A point that was shot only at this session's start, and whose place was not given with the set-up, is defined
        again: the operator repeats the shot because the previous one was bad.
        """
        known = next((p for p in control_points(self._store, setup_id) if p["name"] == name), None)
        shots = self._table.point_shots(setup_id, name)
        own = all(s["session_id"] == session_id and s["phase"] == "start" for s in shots)
        if known and phase == "start" and own and any(s["misclosure_mm"] is None for s in shots):
            return None
        return None if known is None else {axis: known[axis] for axis in AXES}

    def control_point_names(self, setup_id: str) -> list[str]:
        """Return the names of a set-up's control points."""
        return [point["name"] for point in control_points(self._store, setup_id)]

    def control_points(self, setup_id: str, session_id: str) -> list[Place]:
        """Return the places of the control points that a session in a set-up knows, mm in the station's frame."""
        return [(p["x_mm"], p["y_mm"], p["z_mm"]) for p in control_points(self._store, setup_id, session_id)]


def _distance_mm(one: Mapping[str, Any], other: Mapping[str, Any]) -> float:
    return math.dist([one[axis] for axis in AXES], [other[axis] for axis in AXES])


def _place(name: object, place: object) -> dict[str, float]:
    identifier({"name": name}, "name", "a control point's name")
    if isinstance(place, list | tuple) and len(place) == len(AXES):
        axes = {axis: number_argument({axis: value}, axis, limit=1e7) for axis, value in zip(AXES, place, strict=True)}
        given = {axis: value for axis, value in axes.items() if value is not None}
        if len(given) == len(AXES):
            return given
    raise CommandError(f"control point {name!r}: give three coordinates in mm, not {place!r:.80}")
