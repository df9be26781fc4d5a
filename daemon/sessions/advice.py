"""Advice to the operator at a session's start and end, in sentences."""

from __future__ import annotations

from calibration.rig.description import Rig
from daemon.commands import CHECK
from daemon.sessions.open_session import OpenSession
from daemon.sessions.prism_watch import PrismWatch
from daemon.sessions.station_setups import StationSetups
from daemon.store.queries.sessions import SessionTable

CHECK_POSES = (3, 5)


class SessionAdvice:
    """Advice on the sessions of a rig.

    Args:
        rig: the machine.
        setups: with the control points that are to be shot.
        table: of the sessions.
        prisms: with the stations that may be on another prism.
    """

    def __init__(self, rig: Rig, setups: StationSetups, table: SessionTable, prisms: PrismWatch) -> None:
        self._rig, self._setups, self._table, self._prisms = rig, setups, table, prisms

    def at_start(self, session: OpenSession) -> list[str]:
        """Return advice for a session that begins."""
        points, missing = self._points(session, "start")
        advice = []
        if missing or not points:
            which = f"the control points {', '.join(missing)}" if missing else "a control point"
            advice.append(
                f"shoot {which} before the first pose (`rigcal session shoot NAME`), and again before the end"
            )
        advice += self._doubts(session)
        return [*advice, "stand still at every pose until status counts it; move all joints through their ranges"]

    def at_end(self, session: OpenSession) -> list[str]:
        """Return advice on a session that has ended: what it lacks, and what that means."""
        points, missing = self._points(session, "end")
        advice = []
        if missing or not points:
            which = ", ".join(missing) or "none was shot at all"
            advice.append(f"control points not shot at the session's end: {which}")
        advice += self._doubts(session)
        summary = self._table.summary(session.id)
        if session.kind == CHECK and not CHECK_POSES[0] <= summary["poses"] <= CHECK_POSES[1]:
            advice.append(f"a check wants {CHECK_POSES[0]} to {CHECK_POSES[1]} poses; this one has {summary['poses']}")
        advice += [
            f"the computer's clock was set back by {-step['step_s']:.1f} s during the session or before it: "
            "rows keep the times that it showed, and calibration goes by the monotonic clock"
            for step in summary["clock_steps"]
            if step["step_s"] < 0
        ]
        return advice

    def _points(self, session: OpenSession, phase: str) -> tuple[list[str], list[str]]:
        """Return the control points of a session's set-up, and those that were not shot in a phase of it."""
        points, shot = self._setups.control_point_names(session.setup_id), self._table.points_shot(session.id, phase)
        return points, [name for name in points if name not in shot]

    def _doubts(self, session: OpenSession) -> list[str]:
        """Return a sentence on every joint that has jumped, and on every station that may be on another prism."""
        jumps = [
            f"{joint} jumped during the session, and nothing after that is used: if its encoder was preset, start anew"
            for joint in self._rig.joint_names
            if joint in session.jumped
        ]
        return jumps + [
            f"{suspicion.reason}; its fixes since then do not count: {suspicion.remedy}"
            for suspicion in self._prisms.suspicions(session)
        ]


def after_a_move(session_id: str) -> list[str]:
    """Return advice for a session in which a control point shows that the station moved."""
    return [
        "the station has moved, and nothing measured from now on fits what was measured before: stop the session, "
        "describe where the station stands now with `rigcal setup new`, then start the next session",
        f"session {session_id} is kept and not used; if you know that only the control point was wrong, say so after "
        f"its end with `rigcal session accept {session_id}`",
    ]
