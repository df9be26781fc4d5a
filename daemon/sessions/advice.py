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
        setups: set-ups with their control points.
        table: the sessions.
        prisms: checks that stations are on the session's prism.
    """

    def __init__(self, rig: Rig, setups: StationSetups, table: SessionTable, prisms: PrismWatch) -> None:
        self._rig, self._setups, self._table, self._prisms = rig, setups, table, prisms

    def at_start(self, session: OpenSession) -> list[str]:
        """Return advice for a session that has just started."""
        points, missing = self._points(session, "start")
        advice = [f"from now on, fixes count as prism {session.prism}: aim the station at it, or at a control point"]
        if missing or not points:
            which = f"the control points {', '.join(missing)}" if missing else "a control point"
            advice.append(
                f"shoot {which} before the first pose (`rigcal session shoot NAME`), and again before the end"
            )
        advice += self._doubts(session, is_open=True)
        return [
            *advice,
            "stand still at every pose until `rigcal status` counts it; move all joints through their ranges",
        ]

    def at_end(self, session: OpenSession) -> list[str]:
        """Return advice on a session that has ended: what is missing, and its consequences."""
        points, missing = self._points(session, "end")
        advice = []
        if missing or not points:
            which = ", ".join(missing) or "none was shot in this session"
            advice.append(f"control points not shot at the session's end: {which}")
        advice += self._doubts(session, is_open=False)
        summary = self._table.summary(session.id)
        if session.kind == CHECK and not CHECK_POSES[0] <= summary["poses"] <= CHECK_POSES[1]:
            least, most = CHECK_POSES
            advice.append(f"a check session should have {least} to {most} poses; this one has {summary['poses']}")
        advice += [
            f"the computer's clock was set back by {-step['step_s']:.1f} s during the session or before it: "
            "rows keep the times that the clock showed, and calibration uses the monotonic clock"
            for step in summary["clock_steps"]
            if step["step_s"] < 0
        ]
        return advice

    def _points(self, session: OpenSession, phase: str) -> tuple[list[str], list[str]]:
        """Return the control points of a session's set-up, and those not shot in the given phase of the session."""
        points, shot = self._setups.control_point_names(session.setup_id), self._table.points_shot(session.id, phase)
        return points, [name for name in points if name not in shot]

    def _doubts(self, session: OpenSession, *, is_open: bool) -> list[str]:
        """Return a sentence for each joint that has jumped, and for each station that may be on another prism.

        Args:
            session: the session.
            is_open: whether the operator can still confirm that the station is on the prism.
        """
        jumps = [
            f"{joint} jumped during the session, and no fix after the jump is used: if its encoder was preset, start a "
            "new session"
            for joint in self._rig.joint_names
            if joint in session.jumped
        ]
        before = (
            "fixes before that stay in use; if the station was on another prism then as well, reject the session with "
            f"`rigcal session reject {session.id}`"
        )
        return jumps + [
            f"{suspicion.reason}; fixes since then are not used{f': {suspicion.remedy}' if is_open else f', {before}'}"
            for suspicion in self._prisms.suspicions(session)
        ]


def after_a_move(session_id: str) -> list[str]:
    """Return advice for a session in which a control point shows that the station has moved."""
    return [
        "the station has moved, so fixes measured from now on do not fit the earlier ones: stop the session, describe "
        "the station's new set-up with `rigcal setup new`, then start the next session",
        f"session {session_id} is kept but not used; if you are sure that only the control point was wrong, accept the "
        f"session after its end with `rigcal session accept {session_id}`",
    ]
