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
from daemon.guide.request import misfit
from daemon.host.worker_thread import WorkerThread
from daemon.sessions.manager import SessionManager
from daemon.sessions.open_session import CONTROL_POINT_RADIUS_MM
from daemon.sessions.station_setups import StationSetups
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
            job = course.record.job
            if job is None or job.step is None:
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
        with acting_for(None, self._cancelled.is_set):
            if not run.session:
                self._try(self._open_session)
            elif step.kind == "close":
                self._try(self._close_session)
            elif step.kind == "shoot_control_point":
                if self._has_aim or is_at_point or self.wanted == step_id:
                    self._try(partial(self._shoot, step.point, step_id), step_id)
            elif step.kind == "change_prism":
                if self._has_aim:
                    course.aimed()
            elif job.is_enough and (self._has_aim or is_at_point or run.kind == CHECK):
                course.happen("left", {}, only_at=step_id)
            elif not job.is_enough:
                self._send_boom(job)
                self._look_at_pose(job)

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

    def _look_at_pose(self, job: Job) -> None:
        """Check whether the pose is reached and measured."""
        run, number = job.run, job.run.next_pose
        found = self._course.record.table.standstill(run.session, run.last)
        self._course.standstill = found = None if found is None or found.pose == run.label else found
        if number is None or run.poses is None or found is None or found.fixes < NEEDED_FIXES:
            return
        if is_there(self._rig, joints_of(self._rig, found), run.poses[number].joints):
            self._course.happen("measured", {"pose": found.pose, "last": found.last}, only_at=job.step_id)

    def _try(self, work: Callable[[], None], step_id: str = "") -> None:
        """Do work that may fail until an operator helps; retry it after a pause, or a manual shot on request."""
        self.busy = step_id or "session"
        try:
            work()
        except CommandError as error:
            if not self._cancelled.is_set():
                job = self._course.record.job
                if job is not None and job.trouble != str(error):  # each retry may fail with the same message
                    self._course.happen("failed", {"text": str(error)})
                self._course.wait()
        finally:
            if step_id:
                self.wanted = ""
            self.busy = ""

    def _open_session(self) -> None:
        job, row = self._course.record.job, self._course.record.row
        if job is None or row is None:
            return
        if self._setups.has_moved(row.setup_id):  # no session is possible at this set-up any more
            self._course.abandon(_MOVED)
            return
        last, opened = self._course.record.table.newest_observation(), self._sessions.open_session()
        wanted = {"prism": job.run.prism, "kind": job.run.kind, "setup": row.setup_id, "note": f"guide {row.id}"}
        if opened is None or any(opened[key] != value for key, value in wanted.items()):
            opened = self._sessions.start_command(wanted | {"operator": row.operator}, is_aimed=False)
        # Otherwise the session was opened just before the daemon ended.
        with self._course.at_once():
            guide, now = self._course.record.opened(), self._sessions.open_session()
            if guide is not None and guide[0].id == row.id:
                self._course.happen("opened", {"session": opened["id"], "last": last})
            elif now is not None and now["id"] == opened["id"]:  # the guide was abandoned in the meantime
                self._sessions.abort_command({})

    def _close_session(self) -> None:
        job = self._course.record.job
        if job is None:
            return
        opened = self._sessions.open_session()
        if opened is not None and opened["id"] == job.run.session:
            self._sessions.stop_command({})
        self._course.happen("closed", {"session": job.run.session})

    def _shoot(self, point: str, step_id: str) -> None:
        shot = self._sessions.shoot_command({"point": point}, most_off_mm=CONTROL_POINT_RADIUS_MM)
        self._course.happen("shot", {"point": point, "misclosure_mm": shot["misclosure_mm"]}, only_at=step_id)
        if shot["moved"] and shot["phase"] == "start":  # no measurement from here on would be usable
            self._course.abandon(_MOVED)
