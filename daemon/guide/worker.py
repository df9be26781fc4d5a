"""The guide's thread: checks the progress ten times per second and carries out the steps that need no operator.

It opens and closes sessions, shoots control points in them, and sends a simulated boom to the poses.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from calibration.rig.description import Rig
from daemon.commands import CHECK, CommandError, acting_for
from daemon.guide.course import Course
from daemon.guide.job import Job
from daemon.guide.position import is_there, joints_of
from daemon.guide.record import GuideStep
from daemon.guide.request import misfit
from daemon.host.worker_thread import WorkerThread
from daemon.sessions.manager import SessionManager
from daemon.sessions.station_setups import CONTROL_POINT_RADIUS_MM, StationSetups
from drivers.clock import NS_PER_S, Clock

log = logging.getLogger(__name__)

TICK_S = 0.1
NEEDED_FIXES = 5  # at a pose
_CANCEL_S = 5.0
_STANDS_S = 20.0  # for which a simulated boom stands at each pose
_SENT_AGAIN_S = 120.0
_MOVED = "the station has moved, its control points no longer fit: the next guide needs a new set-up"

Drive = Callable[[Sequence[Mapping[str, Any]]], int]
"""Sends the boom to the rows of a pose plan; returns the number of remaining stops."""


class GuideWorker(WorkerThread):
    """Advances the open guide.

    Args:
        rig: the machine.
        course: course of the guide.
        sessions: opens and closes sessions, and shoots control points in them.
        setups: shows whether the station has moved.
        clock: time.
        has_aim: True if the station is turned without an operator.
        drive: sends the boom to poses without an operator; None if nothing can.

    Attributes:
        wanted: step whose button was pressed and that is pending; "" for none.
        busy: step that is being carried out; "" for none.
    """

    def __init__(
        self,
        rig: Rig,
        course: Course,
        sessions: SessionManager,
        setups: StationSetups,
        clock: Clock,
        *,
        has_aim: bool,
        drive: Drive | None,
    ) -> None:
        super().__init__("guide", _CANCEL_S)
        self.wanted = self.busy = ""
        self._rig, self._course, self._sessions, self._setups, self._clock = rig, course, sessions, setups, clock
        self._has_aim, self._drive = has_aim, drive
        self._driven = ("", 0)  # step whose pose the boom was sent to, and when
        self._cancelled = threading.Event()

    def stop(self) -> None:
        """Cancel a shot that is in progress, and end the thread."""
        self._stopping.set()
        self._cancelled.set()
        super().stop()

    def cancel(self) -> None:
        """Cancel a shot that is in progress."""
        if not self.busy:
            return
        self._cancelled.set()
        deadline = time.monotonic() + _CANCEL_S
        while self.busy and time.monotonic() < deadline:
            time.sleep(TICK_S / 2)
        self._cancelled.clear()

    def _run(self) -> None:
        told = ""
        while not self._stopping.wait(TICK_S):
            try:
                if self._course.record.is_open and not self._course.is_waiting:
                    self._look()
                told = ""
            except Exception as error:
                self._course.wait()
                if str(error) != told:
                    log.exception("error in the guide; it continues")
                told = str(error)

    def _look(self) -> None:
        course = self._course
        with course.record.turn:
            job, at = course.record.job, course.record.step
            if job is None or job.step is None or at is None:
                return
            if not course.advisor.is_alive:
                course.start_advisor()
            run, step, step_id = job.run, job.step, job.step_id
            if unfit := misfit(job, self._rig):
                course.abandon(unfit)
                return
            if run.session and run.poses is None:
                course.choose(run.most)
            is_at_point = not self._has_aim and course.watch.is_at(course.point_mm(course.point(job)))
        if not run.session:
            self._try(self._open_session, at)
        elif step.kind == "close":
            self._try(partial(self._close_session, at), at)
        elif step.kind == "shoot_control_point":
            if self._has_aim or is_at_point or self.wanted == step_id:
                self._try(partial(self._shoot, step.point, at), at, step_id)
        elif step.kind == "change_prism":
            if self._has_aim:
                course.aimed(only_at=at)
        elif job.is_enough and (self._has_aim or is_at_point or run.kind == CHECK):
            course.happen("left", {}, only_at=at)
        elif not job.is_enough:
            self._send_boom(job)
            self._look_at_pose(job, at)

    def _is_over(self, at: GuideStep) -> bool:
        """Return True if work for a step is cancelled, or the guide is no longer at that step."""
        return self._cancelled.is_set() or self._course.record.step != at

    def _send_boom(self, job: Job) -> None:
        """Send a boom without an operator to the next pose; send it again if the pose was not measured."""
        run, number, now_ns = job.run, job.run.next_pose, self._clock.now().monotonic_ns
        step_id, sent_ns = self._driven
        if self._drive is None or number is None or run.poses is None:
            return
        if step_id == job.step_id and now_ns - sent_ns < _SENT_AGAIN_S * NS_PER_S:
            return
        self._driven = job.step_id, now_ns
        joints = run.poses[number].joints
        self._drive([{"dwell_s": _STANDS_S} | {joint.column: joints[joint.name] for joint in self._rig.joints}])

    def _look_at_pose(self, job: Job, at: GuideStep) -> None:
        """Check whether the pose is reached and measured."""
        run, number = job.run, job.run.next_pose
        found = self._course.record.table.standstill(run.session, run.last)
        found = None if found is None or found.pose == run.label else found
        with self._course.record.turn:
            if self._course.record.step != at:
                return
            self._course.standstill = found
        if number is None or run.poses is None or found is None or found.fixes < NEEDED_FIXES:
            return
        if is_there(self._rig, joints_of(self._rig, found), run.poses[number].joints):
            self._course.happen("measured", {"pose": found.pose, "last": found.last}, only_at=at)

    def _try(self, work: Callable[[], None], at: GuideStep, step_id: str = "") -> None:
        """Do a step's work, which may fail until an operator helps; retry it after a pause, or a shot on request."""
        self.busy = step_id or "session"
        try:
            work()
        except CommandError as error:
            if not self._is_over(at):
                job = self._course.record.job
                if job is not None and job.trouble != str(error):  # each retry may fail with the same message
                    self._course.happen("failed", {"text": str(error)}, only_at=at)
                self._course.wait()
        finally:
            if self.wanted == step_id:  # not a button that was pressed at a later step
                self.wanted = ""
            self.busy = ""

    def _open_session(self) -> None:
        with self._course.record.turn:
            guide = self._course.record.opened()
            if guide is None:
                return
            row, job = guide
            if self._setups.has_moved(row.setup_id):  # no session is possible at this set-up any more
                self._course.abandon(_MOVED)
                return
        last, opened = self._course.record.table.newest_observation(), self._sessions.open_session()
        wanted = {"prism": job.run.prism, "kind": job.run.kind, "setup": row.setup_id, "note": f"guide {row.id}"}
        if opened is None or any(opened[key] != value for key, value in wanted.items()):
            if opened is not None and opened["note"] == wanted["note"]:  # the guide's own, for a prism skipped since
                self._abort(opened["id"])
            with acting_for(row.caller):
                opened = self._sessions.start_command(wanted | {"operator": row.operator}, is_aimed=False)
        # Otherwise the session was opened just before the daemon ended.
        with self._course.at_once():
            guide, now = self._course.record.opened(), self._sessions.open_session()
            is_wanted = guide is not None and (guide[0].id, guide[1].at, guide[1].run.session) == (row.id, job.at, "")
            if not is_wanted:  # the guide was abandoned, or its prism skipped, in the meantime
                self._abort(opened["id"])
            elif now is not None and now["id"] == opened["id"]:
                self._course.happen("opened", {"session": opened["id"], "last": last})

    def _abort(self, session: str) -> None:
        with self._sessions.turn:
            opened = self._sessions.open_session()
            if opened is not None and opened["id"] == session:
                self._sessions.abort_command({})

    def _close_session(self, at: GuideStep) -> None:
        with self._course.at_once():
            job = self._course.record.job
            if job is None or self._course.record.step != at:
                return
            opened = self._sessions.open_session()
            if opened is not None and opened["id"] == job.run.session:
                self._sessions.stop_command({})
            self._course.happen("closed", {"session": job.run.session})

    def _shoot(self, point: str, at: GuideStep) -> None:
        with acting_for(None, partial(self._is_over, at)):
            shot = self._sessions.shoot_command({"point": point}, most_off_mm=CONTROL_POINT_RADIUS_MM)
        with self._course.record.turn:
            guide = self._course.record.opened()
            self._course.happen("shot", {"point": point, "misclosure_mm": shot["misclosure_mm"]}, only_at=at)
            if shot["moved"] and shot["phase"] == "start" and guide is not None and guide[0].id == at[0]:
                self._course.abandon(_MOVED)  # no measurement from here on would be usable
