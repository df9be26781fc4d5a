"""Calibration sessions: what the operator says, joined with what the instruments give.

All state lives in the store; this module holds only what an open session needs between two fixes. `on_records` runs in
the writer thread; methods named `*_command` are called by the control socket's threads.
"""

from __future__ import annotations

import hashlib
import itertools
import logging
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from calibration.rig import Rig
from daemon.arguments import identifier, text_argument
from daemon.caller import caller_columns
from daemon.config import SessionsSection
from daemon.control import FAILED, CommandError
from daemon.joiner import JoinedFix, ObservationJoiner
from daemon.open_session import OpenSession, Shot, within
from daemon.scheduler import CHECK, SESSION_KINDS
from daemon.setups import AXES, Place, SetupBook
from daemon.store.store import Store
from drivers.clock import Clock
from drivers.readings import DeviceEvent, EventKind, Fix, Record, Status
from drivers.station import position_mm

log = logging.getLogger(__name__)

STANDING_KINDS = ("static_poses", CHECK)
CHECK_POSES = (3, 5)
CONTROL_POINT_RADIUS_MM = 300.0  # a fix this close to a control point is of the control point, not of the boom
SHOT_SPREAD_MM = 20.0  # fixes of one shot that lie further apart are not of one standing target


class SessionKeeper:
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
    """

    def __init__(
        self,
        rig: Rig,
        rig_text: str,
        store: Store,
        setups: SetupBook,
        joiner: ObservationJoiner,
        settings: SessionsSection,
        clock: Clock,
        *,
        run_id: int,
        aim: Callable[[str], None] | None = None,
    ) -> None:
        self._rig, self._rig_text = rig, rig_text
        self._store, self._joiner, self._settings, self._clock = store, joiner, settings, clock
        self._setups, self._run_id = setups, run_id
        self._aim = aim
        self._commands = threading.Lock()
        self._shot: Shot | None = None
        self._ended: OpenSession | None = None  # the last one: fixes measured in it may still wait for their joints
        self._open = self._reopen()

    # ---- the writer thread -------------------------------------------------------------------------------------------

    def on_records(self, records: Sequence[Record]) -> None:
        """Take records that are stored now: complete a shot, or store observations of the open session."""
        for record in records:
            if isinstance(record, Fix):
                self._feed_shot(record)
            elif isinstance(record, DeviceEvent) and record.kind is EventKind.PRESET_JUMP:
                for session in (self._ended, self._open):
                    if session is not None and session.lasted(record.stamp):
                        session.jumped.setdefault(record.device, record.stamp)
        for joined in self._joiner.feed(records):
            self._observe(joined)

    def _feed_shot(self, fix: Fix) -> None:
        shot = self._shot
        place_mm = position_mm(fix)
        if shot is None or shot.done.done() or place_mm is None or fix.status is not Status.OK:
            return
        if not within(fix.stamp, shot.aimed, None):
            return
        if shot.places_mm and math.dist(place_mm, shot.places_mm[0]) > SHOT_SPREAD_MM:
            shot.fixes.clear()  # the station was still turning to it
            shot.places_mm.clear()
        shot.fixes.append(fix)
        shot.places_mm.append(place_mm)
        if len(shot.fixes) == shot.wanted:
            shot.done.set_result(None)

    def _observe(self, joined: JoinedFix) -> None:
        session = next((s for s in (self._ended, self._open) if s is not None and s.has(joined.stamp)), None)
        place_mm = position_mm(joined.fix)
        if session is None or place_mm is None:
            return
        standing = joined.standstill is not None
        self._store.insert(
            "observations",
            {
                "session_id": session.id,
                "fix_id": self._store.fix_id(joined.fix),
                "setup_id": session.setup_id,
                "prism": session.prism,
                "pose": f"{self._run_id}.{joined.standstill}" if standing else None,
                **self._store.instant(joined.stamp),
                **dict(zip(AXES, place_mm, strict=True)),
                "dwell_s": joined.dwell_s,
                "moving": not standing,
                "values_json": joined.values,
                "excluded": self._exclusion(session, joined, place_mm),
            },
        )

    def _exclusion(self, session: OpenSession, joined: JoinedFix, place_mm: Place) -> str | None:
        if joined.refused:
            return joined.refused
        for joint in self._rig.joint_names:
            if joint in session.jumped and within(joined.stamp, session.jumped[joint], None):
                return f"{joint} jumped: its readings from then on do not fit those before"
        if any(math.dist(place_mm, p) < CONTROL_POINT_RADIUS_MM for p in session.control_points):
            return "a control point, not the prism"
        if session.kind in STANDING_KINDS and joined.standstill is None:
            return "moving"
        return None

    # ---- sessions ----------------------------------------------------------------------------------------------------

    def start_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Open a session: from now on good fixes become its observations."""
        with self._commands:
            if self._open is not None:
                raise CommandError(f"session {self._open.id!r} is open; stop or abort it first")
            prism, kind = str(arguments.get("prism", "")), str(arguments.get("kind", "static_poses"))
            if prism not in self._rig.prism_names:
                raise CommandError(
                    f"rig {self._rig.name!r} has no prism {prism!r:.80}; it has {', '.join(self._rig.prism_names)}"
                )
            if kind not in SESSION_KINDS:
                raise CommandError(f"there is no kind {kind!r:.80}; kinds: {', '.join(SESSION_KINDS)}")
            setup_id = self._setups.usable(arguments.get("setup"))
            taken = {row["id"] for row in self._store.rows("SELECT id FROM calibration_sessions")}
            free = next(name for n in itertools.count(len(taken) + 1) if (name := f"s{n:03d}-{prism}") not in taken)
            session_id = identifier(arguments, "id", "a session's id", default=free)
            if session_id in taken:
                raise CommandError(f"session {session_id!r} exists already; choose another --id")
            if self._aim is not None:
                self._aim(prism)
            now = self._clock.now()
            row = {
                "id": session_id,
                "rig": self._rig.name,
                "rig_sha256": hashlib.sha256(self._rig_text.encode()).hexdigest(),
                "rig_text": self._rig_text,
                "setup_id": setup_id,
                "prism": prism,
                "operator": text_argument(arguments, "operator"),
                **caller_columns(),
                "kind": kind,
                "state": "open",
                "note": text_argument(arguments, "note"),
                **self._store.instant(now, "started_"),
            }
            self._store.insert("calibration_sessions", row)
            points = self._setups.control_points(setup_id)
            self._open = OpenSession(session_id, setup_id, prism, kind, now, control_points=points)
            return {"id": session_id, "setup": setup_id, "prism": prism, "kind": kind, "advice": self._advice("start")}

    def stop_command(self, _arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Close the open session; its jobs follow by themselves."""
        with self._commands:
            session = self._needs_open()
            advice = self._advice("end")
            self._close("closed")
            return self._summary(session.id) | {"advice": advice}

    def abort_command(self, _arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Close the open session as unusable: kept, never calibrated with."""
        with self._commands:
            session = self._needs_open()
            self._close("aborted")
            return self._summary(session.id)

    def shoot_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Measure a control point: the mean of the next good fixes. The first shot of a point defines its place."""
        with self._commands:
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
                self._await(shot)
            finally:
                self._shot = None
                if self._aim is not None:
                    self._aim(session.prism)
                shot.until = self._clock.now()
            phase = self._phase(session, name)
            result = self._setups.store_shot(session.setup_id, session.id, name, phase, shot.fixes, shot.places_mm)
            session.control_points = self._setups.control_points(session.setup_id)
            return result

    def list_command(self, _arguments: Mapping[str, Any]) -> list[dict[str, Any]]:
        """All sessions with what they hold, oldest first."""
        ids = self._store.rows("SELECT id FROM calibration_sessions ORDER BY rowid")
        return [self._summary(row["id"]) for row in ids]

    def show_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """One session: what it holds, what was excluded and why, how its set-up kept its place, and its jobs."""
        session_id = str(arguments.get("id", ""))
        if not self._store.rows("SELECT id FROM calibration_sessions WHERE id = ?", (session_id,)):
            raise CommandError(f"there is no session {session_id!r:.80}; `rigcal session list` shows them")
        jobs = self._store.rows(
            "SELECT id, kind, state, progress, message, error FROM jobs WHERE session_id = ? ORDER BY id", (session_id,)
        )
        return self._summary(session_id) | {"jobs": jobs}

    def open_session(self) -> dict[str, Any] | None:
        """What `status` shows of the open session."""
        session = self._open
        return None if session is None else self._summary(session.id)

    # ---- parts -------------------------------------------------------------------------------------------------------

    def _await(self, shot: Shot) -> None:
        """Wait until the shot is complete; the time-out runs on the clock of the rig."""
        arrived = threading.Event()
        shot.done.add_done_callback(lambda _: arrived.set())
        if not self._clock.wait(arrived, self._settings.shot_timeout_s):
            raise CommandError(
                f"{len(shot.fixes)} of {shot.wanted} good fixes within {self._settings.shot_timeout_s:g} s; is the "
                "station aimed at the control point, and locked? `rigcal status` shows",
                FAILED,
            )

    def _phase(self, session: OpenSession, point: str) -> str:
        """`end` for a point that was shot before the observations so far, else `start`."""
        between = self._store.rows(
            "SELECT 1 FROM observations AS o JOIN control_shots AS c ON c.session_id = o.session_id AND c.name = ? "
            "WHERE o.session_id = ? AND o.excluded IS NULL "
            "AND (o.boot_id, o.monotonic_ns) > (c.boot_id, c.monotonic_ns) LIMIT 1",
            (point, session.id),
        )
        return "end" if between else "start"

    def _advice(self, phase: str) -> list[str]:
        """What the operator should still do, in sentences."""
        session = self._needs_open()
        points = self._store.rows("SELECT name FROM control_points WHERE setup_id = ?", (session.setup_id,))
        shot = {
            row["name"]
            for row in self._store.rows(
                "SELECT name FROM control_shots WHERE session_id = ? AND phase = ?", (session.id, phase)
            )
        }
        advice = []
        missing = [p["name"] for p in points if p["name"] not in shot]
        if missing or not points:
            names = ", ".join(missing) if missing else "at least one"
            advice.append(f"control points not shot at the session's {phase}: {names} (`rigcal session shoot NAME`)")
        advice += [
            f"{joint} jumped during the session, and nothing after that is used: if its encoder was preset, start anew"
            for joint in self._rig.joint_names
            if joint in session.jumped
        ]
        if phase == "start":
            advice.append("stand still at every pose until status counts it; move all joints through their ranges")
        elif session.kind == CHECK:
            poses = self._summary(session.id)["poses"]
            if not CHECK_POSES[0] <= poses <= CHECK_POSES[1]:
                advice.append(f"a check wants {CHECK_POSES[0]} to {CHECK_POSES[1]} poses; this one has {poses}")
        return advice

    def _earlier_jumps(self, session_id: str) -> list[str]:
        """Devices whose encoders an earlier run of the daemon has seen jump in a session."""
        rows = self._store.rows(
            "SELECT DISTINCT e.device FROM device_events AS e JOIN calibration_sessions AS s ON s.id = ? "
            "WHERE e.kind = 'preset_jump' "
            "AND (e.boot_id, e.monotonic_ns) >= (s.started_boot_id, s.started_monotonic_ns)",
            (session_id,),
        )
        return [row["device"] for row in rows]

    def _summary(self, session_id: str) -> dict[str, Any]:
        row = self._store.rows(
            "SELECT id, rig, setup_id AS setup, prism, operator, caller_user AS user, kind, state, note, "
            "started_utc_ns, ended_utc_ns FROM calibration_sessions WHERE id = ?",
            (session_id,),
        )[0]
        counts = self._store.rows(
            "SELECT count(*) FILTER (WHERE excluded IS NULL) AS observations, "
            "count(DISTINCT pose) FILTER (WHERE excluded IS NULL) AS poses FROM observations WHERE session_id = ?",
            (session_id,),
        )[0]
        excluded = self._store.rows(
            "SELECT excluded AS reason, count(*) AS n FROM observations WHERE session_id = ? AND excluded IS NOT NULL "
            "GROUP BY excluded ORDER BY n DESC",
            (session_id,),
        )
        shots = self._store.rows(
            "SELECT name AS point, phase, misclosure_mm FROM control_shots WHERE session_id = ? ORDER BY id",
            (session_id,),
        )
        moved = self._store.rows("SELECT state FROM station_setups WHERE id = ?", (row["setup"],))[0]["state"]
        return {
            **row,
            **counts,
            "excluded": {e["reason"]: e["n"] for e in excluded},
            "control_shots": shots,
            "setup_moved": moved == "moved",
        }

    def _close(self, state: str) -> None:
        session = self._needs_open()
        session.until = self._clock.now()
        self._ended, self._open = session, None
        ended = self._store.instant(session.until, "ended_")
        self._store.update("calibration_sessions", {"id": session.id}, {"state": state, **ended})

    def _needs_open(self) -> OpenSession:
        if self._open is None:
            raise CommandError("no session is open; start one with `rigcal session start`")
        return self._open

    def _reopen(self) -> OpenSession | None:
        """The session that was open when an earlier run ended goes on."""
        rows = self._store.rows(
            "SELECT id, setup_id, prism, kind FROM calibration_sessions WHERE state = 'open' AND rig = ?",
            (self._rig.name,),
        )
        if not rows:
            return None
        session = OpenSession(rows[0]["id"], rows[0]["setup_id"], rows[0]["prism"], rows[0]["kind"], since=None)
        log.warning("session %s (prism %s) was open when rigcal last ended; it goes on", session.id, session.prism)
        if self._aim is not None:
            self._aim(session.prism)  # what aims may have forgotten; an operator's station has kept its lock
        session.control_points = self._setups.control_points(session.setup_id)
        session.jumped = dict.fromkeys(self._earlier_jumps(session.id))
        return session
