"""Manages the one open guide: handles the operator's commands and reports the state.

`job` defines the job and its next step. The commands here and the guide's thread (`worker`) create its events. The
control socket's threads call the methods named `*_command`; the writer's thread calls `on_records`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from calibration.rig.description import Rig
from daemon.acquisition.joiner import ObservationJoiner
from daemon.commands import HOW_TO_END, REFUSED, CommandError, Handler, mapping_argument, text_argument
from daemon.control.command_table import checked_arguments
from daemon.guide.advisor import HUNG, accuracy_view
from daemon.guide.course import Course
from daemon.guide.job import Job
from daemon.guide.meter_link import Place
from daemon.guide.position import is_there, joints_of
from daemon.guide.request import request_of, whole_argument
from daemon.guide.view import Around, headline, state_of
from daemon.guide.worker import NEEDED_FIXES, Drive, GuideWorker
from daemon.sessions.manager import SessionManager
from daemon.sessions.station_setups import StationSetups
from daemon.store.store import Store
from drivers.clock import Clock
from drivers.readings import Record

MORE_POSES = 5


class GuideManager:
    """Manages the one open guide of a rig.

    Args:
        rig: the machine.
        store: the database.
        sessions: opens and closes sessions, and shoots control points in them.
        setups: the station set-ups.
        joiner: source of joint readings.
        clock: time.
        meter_place: returns the locations of the gain meter's input.
        model: returns the candidate model that awaits a decision, for a finished guide.
        settle_s: how long the boom must stand at a pose.
        has_aim: True if the station is turned without an operator.
        drive: sends the boom to the rows of a pose plan without an operator; None if nothing can.
    """

    def __init__(
        self,
        rig: Rig,
        store: Store,
        sessions: SessionManager,
        setups: StationSetups,
        joiner: ObservationJoiner,
        clock: Clock,
        *,
        meter_place: Callable[[], Place],
        model: Callable[[], Mapping[str, Any]],
        settle_s: float,
        has_aim: bool,
        drive: Drive | None = None,
    ) -> None:
        self._rig, self._sessions, self._setups = rig, sessions, setups
        self._model, self._settle_s, self._has_aim = model, settle_s, has_aim
        self._clock = clock
        self._course = Course(rig, store, sessions, joiner, clock, meter_place)
        self._record = self._course.record
        self._worker = GuideWorker(rig, self._course, sessions, setups, clock, has_aim=has_aim, drive=drive)
        store.unless_damaged(self._course.restore, None)

    def start(self) -> None:
        """Start the guide's thread."""
        self._worker.start()

    def stop(self) -> None:
        """Stop the guide's thread; an open guide is resumed at the next start of the daemon."""
        self._worker.stop()
        self._course.advisor.close()

    def on_records(self, records: Sequence[Record]) -> None:
        """Update the positions of boom and station; does nothing while no guide is open."""
        if self._record.is_open:
            self._course.watch.on_records(records)

    def guarding(self, name: str, handler: Handler) -> Handler:
        """Wrap a command so that it is refused while a guide is open, because the guide runs its own sessions."""

        def guarded(arguments: Mapping[str, Any]) -> Any:
            self._require_none_open(name)  # before taking the turn, which the guide may hold for a whole shot
            with self._sessions.turn:  # opening a guide takes this turn, too
                self._require_none_open(name)
                return handler(arguments)

        return guarded

    def _require_none_open(self, name: str) -> None:
        opened = self._record.opened()
        if opened is not None:
            row, job = opened
            raise CommandError(
                f"{name} is refused: guide {row.id} is open and runs its sessions itself; its next step is: "
                f"{headline(job)} (`rigcal session guide` continues it, `rigcal session guide --stop REASON` abandons "
                "it)",
                REFUSED,
            )

    @property
    def meter_fault(self) -> str | None:
        """Why the open guide gets no answer from its gain meter, a clause; None if it does."""
        return HUNG if self._record.is_open and self._course.advisor.trouble == HUNG else None

    # ---- commands ----------------------------------------------------------------------------------------------------

    def start_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Open a guide."""
        with self._record.turn:
            guide = self._record.opened()
            if guide is not None:
                raise CommandError(
                    f"guide {guide[0].id} is open: {headline(guide[1])}; `rigcal session guide` continues it, and "
                    "`rigcal session guide --stop REASON` abandons it",
                    REFUSED,
                )
            self._require_no_session()  # before taking the turn, which a command may hold for a whole shot
            described = mapping_argument(arguments, "new_setup")
            operator = text_argument(arguments, "operator")
            is_new = "new_setup" in arguments
            if is_new and "setup" in arguments:
                raise CommandError("give a set-up that exists or describe a new one, not both")
            with self._course.at_once():
                self._require_no_session()
                if is_new:
                    described = checked_arguments("setup.new", described)
                    request = request_of(arguments, self._rig, list(mapping_argument(described, "control_points")))
                    setup_id = str(self._setups.new_command(described)["id"])
                else:
                    setup_id = self._setups.usable(arguments.get("setup"))
                    request = request_of(arguments, self._rig, self._setups.control_point_names(setup_id))
                self._record.open(request, setup_id, operator)
            self._worker.wanted = ""
            self._course.begin()
            return self._state()

    def _require_no_session(self) -> None:
        session = self._sessions.open_session()
        if session is not None:
            raise CommandError(f"session {session['id']!r} is open; {HOW_TO_END}", REFUSED)

    def state_command(self, _arguments: Mapping[str, Any]) -> dict[str, Any]:
        """The newest guide, open or not."""
        return self._state()

    def done_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Handle the operator's confirmation that the step is carried out; the result names the step (`confirmed`)."""
        with self._record.turn:
            job, step_id = self._record.needs_step(arguments)
            step, run = job.step, job.run
            assert step is not None
            if self._worker.busy == step_id or not run.session:
                raise CommandError(f"the daemon is carrying out this step: {headline(job)}", REFUSED)
            with self._course.at_once():
                self._record.tapped()
                if step.kind == "change_prism":
                    self._course.aimed()
                elif step.kind == "poses" and job.is_enough:
                    self._course.happen("left", {})
                elif step.kind == "poses" and run.next_pose is not None:
                    self._measured_here()
                elif step.kind != "shoot_control_point":
                    raise CommandError(f"this step ends automatically: {headline(job)}", REFUSED)
            if step.kind == "shoot_control_point":
                self._worker.wanted = step_id  # the guide's thread measures it; the state shows the progress
            return {"confirmed": headline(job), **self._state()}

    def skip_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Skip the step, or all remaining poses of the prism; the reason is stored."""
        reason, rest = _reason(arguments), arguments.get("rest", False)
        if not isinstance(rest, bool):
            raise CommandError(f"rest must be true or false, not {rest!r:.80}")
        self._record.needs_step(arguments)
        self._worker.cancel()
        with self._record.turn:
            job, _ = self._record.needs_step(arguments)
            step = job.step
            assert step is not None
            if step.kind == "close" or (rest and step.kind != "poses"):
                raise CommandError(f"this step cannot be skipped: {headline(job)}", REFUSED)
            if step.kind == "poses" and job.run.poses is None and not rest:
                raise CommandError(
                    f"this step cannot be skipped: {headline(job)}; with `rest`, all poses of the prism are skipped",
                    REFUSED,
                )
            with self._course.at_once():
                self._record.tapped()
                if step.kind == "change_prism" and self._sessions.open_session() is not None:
                    self._sessions.abort_command({})
                self._course.happen("skipped", {"reason": reason, "rest": rest})
            return self._state()

    def more_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Measure more poses of this prism although there are enough."""
        count = whole_argument(arguments, "poses", MORE_POSES, 1, 100)
        with self._record.turn:
            job, _ = self._record.needs_step(arguments)
            step, run = job.step, job.run
            if step is None or step.kind != "poses" or not job.is_enough:
                raise CommandError(f"more poses can be added once there are enough; now: {headline(job)}", REFUSED)
            if self._course.is_choosing:
                raise CommandError("more poses are being chosen already", REFUSED)
            left = len(run.upcoming(count))
            with self._course.at_once():
                self._record.tapped()
                if left >= count:
                    self._course.happen("more", {"poses": []})
            if left < count:
                self._course.choose(count - left, as_more=True)
            return self._state()

    def stop_command(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Abandon the guide; its open session is closed if it has poses, else aborted."""
        reason = _reason(arguments)
        self._record.needs_step({})
        self._worker.cancel()
        with self._record.turn:
            self._record.needs_step({})
            with self._course.at_once():
                self._record.tapped()
                self._course.abandon(reason)
            return self._state()

    def _measured_here(self) -> None:
        """Accept the present standstill for the pose, wherever the boom is."""
        found, boom = self._course.standstill, self._course.watch.boom()
        here = (
            found is not None
            and boom.stands_s is not None
            and is_there(self._rig, boom.values, joints_of(self._rig, found))
        )
        if found is None or not here or found.fixes < NEEDED_FIXES:
            raise CommandError(
                f"{found.fixes if found is not None and here else 0} of {NEEDED_FIXES} fixes count at this standstill; "
                "keep the boom still, with the station on the prism",
                REFUSED,
            )
        self._course.happen("measured", {"pose": found.pose, "last": found.last})

    # ---- state -------------------------------------------------------------------------------------------------------

    def now(self) -> dict[str, Any] | None:
        """Return the open guide with its step, for `status`; None while none is open."""
        if not self._record.is_open:
            return None
        guide = self._state()["guide"]
        return {key: guide[key] for key in ("id", "prisms", "step")}

    def _state(self) -> dict[str, Any]:
        with self._record.turn:
            row, job = self._record.row, self._record.job
            if row is None or job is None:
                return {"guide": None}
            point = self._course.point(job)
            around = Around(
                boom=self._course.watch.boom(),
                standstill=self._course.standstill,
                accuracy=accuracy_view(job, self._course.advisor.accuracy),
                coverage=self._course.advisor.coverage,
                taps=self._record.taps,
                is_busy=self._is_busy(job),
                is_detected=self._has_aim or (bool(point) and self._course.point_mm(point) is not None),
                has_aim=self._has_aim,
                settle_s=self._settle_s,
                needed_fixes=NEEDED_FIXES,
                warnings=self._warnings(job),
                model=self._model() if job.state == "finished" else None,
            )
            return {"guide": state_of(self._rig, row, job, around)}

    def _is_busy(self, job: Job) -> bool:
        if job.state != "open":
            return False
        return job.step_id in (self._worker.busy, self._worker.wanted) or not job.run.session

    def _warnings(self, job: Job) -> list[str]:
        found = [job.trouble] if job.trouble else []
        if job.state == "open":
            suspicions = self._sessions.prism_suspicions()
            found += [f"{s.reason}; {s.remedy}" for s in suspicions]
            found += [] if suspicions else self._unused_fixes(job)
        if self._course.advisor.trouble and job.state == "open":
            found.append(self._course.advisor.trouble)
        return found

    def _unused_fixes(self, job: Job) -> list[str]:
        """Return why fixes since the boom has settled do not count, while a pose is to be measured."""
        step, stands_s = job.step, self._course.watch.boom().stands_s
        if step is None or step.kind != "poses" or job.run.poses is None or job.is_enough:
            return []
        if stands_s is None or stands_s < self._settle_s:
            return []
        settled_s = self._clock.real_seconds(stands_s - self._settle_s)
        reason = self._sessions.not_counting(settled_s)
        if reason is None:
            return []
        # Other reasons concern the joints or the computer, where aiming does not help.
        question = f"; is the station on prism {job.run.prism}?" if "prism" in reason else ""
        return [f"the fixes do not count: {reason}{question}"]


def _reason(arguments: Mapping[str, Any]) -> str:
    reason = text_argument(arguments, "reason").strip()
    if not reason:
        raise CommandError("give a reason: it is stored with what is skipped")
    return reason
