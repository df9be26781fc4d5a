"""The job of a guide as a pure state machine: the request, the events so far, and the next step.

A job has a run for each prism and one for the check; a run is a session. Its state follows from the request and the
events alone, so a guide that is read from the store continues where it was. Events and their details:

    opened    {session, last}                the run's session is open; the station is not on the prism yet
    planned   {poses: [{joint: number}]}     the poses of the run
    shot      {point, misclosure_mm}         the control point of this step was measured
    aimed     {}                             the station is on the prism: fixes count from now on
    measured  {pose, last}                   the pose is done: label and newest observation of its standstill
    enough    {reason}                       the stop rule found enough poses
    more      {poses: [{joint: number}]}     measure these poses as well
    left      {}                             go on to the control points at the session's end
    closed    {session}                      the session is closed
    skipped   {reason, rest}                 this step, or all remaining poses of the run, are skipped
    failed    {text}                         a shot or a session's start failed; the step stays the same
    stopped   {reason}                       the guide is abandoned
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from daemon.commands import CHECK

Pose = Mapping[str, float]
"""Joint -> value, deg or mm."""

StepKind = Literal["shoot_control_point", "change_prism", "poses", "close"]
State = Literal["to do", "done", "skipped"]


@dataclass(frozen=True)
class Request:
    """The job that was requested of a guide.

    Attributes:
        control_points: control points to shoot at the start and at the end of every session.
        prisms: prisms to measure, in this order.
        poses: maximum number of poses of a prism.
        check_poses: poses of the check, 0 for none.
        target_mm: expected error at which there are enough poses; None if none was given.
        plan: poses with the prisms in view; None if poses are chosen during the guide.
    """

    control_points: tuple[str, ...]
    prisms: tuple[str, ...]
    poses: int
    check_poses: int
    target_mm: float | None = None
    plan: tuple[tuple[Pose, tuple[str, ...]], ...] | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the request as a JSON object for the store."""
        plan = None if self.plan is None else [{"joints": dict(p), "prisms": list(seen)} for p, seen in self.plan]
        return {
            "control_points": list(self.control_points),
            "prisms": list(self.prisms),
            "poses": self.poses,
            "check_poses": self.check_poses,
            "target_mm": self.target_mm,
            "plan": plan,
        }

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> Request:
        """Read a request that `as_dict` made."""
        plan = stored["plan"]
        return cls(
            tuple(stored["control_points"]),
            tuple(stored["prisms"]),
            stored["poses"],
            stored["check_poses"],
            stored["target_mm"],
            None if plan is None else tuple((row["joints"], tuple(row["prisms"])) for row in plan),
        )

    def planned(self, prism: str) -> tuple[Pose, ...] | None:
        """Return the poses of the plan in which a prism is in view; None without a plan."""
        return None if self.plan is None else tuple(pose for pose, seen in self.plan if prism in seen)


@dataclass(frozen=True)
class Step:
    """A step of a run.

    Attributes:
        kind: what is to be done.
        point, phase: the control point, and `start` or `end` of the session; "" for other kinds.
        state: whether the step is done.
        reason: why it was skipped.
    """

    kind: StepKind
    point: str = ""
    phase: str = ""
    state: State = "to do"
    reason: str = ""


@dataclass(frozen=True)
class PlannedPose:
    """A pose of a run.

    Attributes:
        joints: target of every joint; empty if not known yet.
        state, reason: as in `Step`.
    """

    joints: Pose
    state: State = "to do"
    reason: str = ""


@dataclass(frozen=True)
class PrismRun:
    """The part of a job for one prism: one session.

    Attributes:
        prism, kind: prism and kind of the session.
        steps: steps in order.
        most: maximum number of planned poses.
        poses: None until they are chosen.
        session: session ID; "" until the session is open.
        last: number of the newest observation of the last measured standstill, or of the newest before the session.
        label: label of that standstill.
        enough: why there are enough poses; "" while there are not.
        least: poses that must be done before the stop rule applies again.
    """

    prism: str
    kind: str
    steps: tuple[Step, ...]
    most: int
    poses: tuple[PlannedPose, ...] | None = None
    session: str = ""
    last: int = 0
    label: str = ""
    enough: str = ""
    least: int = 0

    @property
    def next_step(self) -> int | None:
        """Index of the step to do; None at the end."""
        return next((i for i, step in enumerate(self.steps) if step.state == "to do"), None)

    @property
    def following(self) -> Step | None:
        """The step after the one to do; None if there is none."""
        number = self.next_step
        return None if number is None or number + 1 >= len(self.steps) else self.steps[number + 1]

    @property
    def next_pose(self) -> int | None:
        """Index of the pose to go to; None if none is left or poses are not chosen yet."""
        return next((i for i, pose in enumerate(self.poses or ()) if pose.state == "to do"), None)

    @property
    def done(self) -> int:
        """Number of poses that are measured."""
        return sum(pose.state == "done" for pose in self.poses or ())

    def upcoming(self, count: int) -> list[Pose]:
        """Return at most `count` of the next poses to measure."""
        return [pose.joints for pose in self.poses or () if pose.state == "to do"][:count]


@dataclass(frozen=True)
class Job:
    """The state of a guide.

    Attributes:
        request: the requested job.
        runs: runs in order.
        state: open, finished or abandoned.
        misclosure_mm: misclosure of the newest shot, if any.
        trouble: why the last attempt at this step failed; "" after the next event.
        ended_because: why the guide was abandoned.
    """

    request: Request
    runs: tuple[PrismRun, ...]
    state: Literal["open", "finished", "abandoned"] = "open"
    misclosure_mm: float | None = None
    trouble: str = ""
    ended_because: str = ""

    @classmethod
    def of(cls, request: Request) -> Job:
        """Return a job with nothing done."""
        wanted = [(prism, "static_poses", request.poses) for prism in request.prisms]
        if request.check_poses:
            wanted.append((request.prisms[-1], CHECK, request.check_poses))
        return cls(request, tuple(_run(number, *one, request) for number, one in enumerate(wanted)))

    @property
    def at(self) -> int:
        """Index of the current run; of the last run if all are over."""
        left = (i for i, run in enumerate(self.runs) if run.next_step is not None)
        return next(left, len(self.runs) - 1)

    @property
    def run(self) -> PrismRun:
        """The current run."""
        return self.runs[self.at]

    @property
    def step(self) -> Step | None:
        """The step to do; None if the job is over."""
        number = self.run.next_step if self.state == "open" else None
        return None if number is None else self.run.steps[number]

    @property
    def step_id(self) -> str:
        """Identifier that differs between all steps and all poses."""
        run = self.run
        if self.state != "open" or run.next_step is None:
            return self.state
        if run.steps[run.next_step].kind != "poses":
            return f"{self.at + 1}.{run.next_step + 1}"
        pose = "enough" if self.is_enough else len(run.poses or ()) if run.next_pose is None else run.next_pose + 1
        return f"{self.at + 1}.{run.next_step + 1}.{pose}"

    @property
    def is_enough(self) -> bool:
        """Return True if no pose is to be measured: the stop rule found enough, or none is left."""
        run = self.run
        return bool(run.enough) or (run.poses is not None and run.next_pose is None)

    @property
    def sessions(self) -> tuple[str, ...]:
        """Sessions of the runs, oldest first."""
        return tuple(run.session for run in self.runs if run.session)

    # ---- events ------------------------------------------------------------------------------------------------------

    def after(self, kind: str, details: Mapping[str, Any]) -> Job:
        """Return the state after an event.

        Raises:
            ValueError: the event cannot happen in this state.
        """
        if self.state != "open":
            raise ValueError(f"{kind}: the guide is {self.state}")
        if kind not in _EVENTS:
            raise ValueError(f"there is no event {kind!r}")
        wanted = _STEP_OF.get(kind)
        if wanted is not None and (self.step is None or self.step.kind != wanted):
            raise ValueError(f"{kind}: the step is {self.step and self.step.kind}, not {wanted}")
        return _EVENTS[kind](replace(self, trouble=""), details)

    def skipped(self, reason: str, *, rest: bool) -> Job:
        """Return the state with this step skipped, or with all remaining poses of the run skipped."""
        run, step = self.run, self.step
        if step is None:
            raise ValueError("there is no step to skip")
        if step.kind == "change_prism":  # without its prism the session has no data
            steps = tuple(replace(s, state="skipped", reason=reason) if s.state == "to do" else s for s in run.steps)
            return self._with(replace(run, steps=steps))
        if step.kind != "poses":
            return self._with(_stepped(run, "skipped", reason))
        if rest or self.is_enough:
            return self._with(_stepped(_rest_skipped(run, reason), "done" if run.done else "skipped", reason))
        return self._with(_posed(run, "skipped", reason))

    def changed(self, **changes: Any) -> Job:
        """Return the state with changed attributes of the current run."""
        return self._with(replace(self.run, **changes))

    def stepped(self) -> Job:
        """Return the state with this step done."""
        return self._with(_stepped(self.run, "done"))

    def _with(self, run: PrismRun) -> Job:
        """Return the job with its current run replaced; the job is finished if no step is left."""
        at = self.at
        runs = (*self.runs[:at], run, *self.runs[at + 1 :])
        is_over = all(r.next_step is None for r in runs)
        return replace(self, runs=runs, state="finished" if is_over else "open")


def _run(number: int, prism: str, kind: str, most: int, request: Request) -> PrismRun:
    # The order alternates: a session begins with the control point that the previous session ended with.
    points = request.control_points[:: -1 if number % 2 else 1]
    planned = request.planned(prism) if kind != CHECK else None
    return PrismRun(
        prism,
        kind,
        (
            *(Step("shoot_control_point", point, "start") for point in points),
            Step("change_prism"),
            Step("poses"),
            *(Step("shoot_control_point", point, "end") for point in points),
            Step("close"),
        ),
        most if planned is None else len(planned),
        None if planned is None else tuple(PlannedPose(pose) for pose in planned),
    )


def _stepped(run: PrismRun, state: State, reason: str = "") -> PrismRun:
    number = run.next_step
    assert number is not None
    step = replace(run.steps[number], state=state, reason=reason)
    return replace(run, steps=(*run.steps[:number], step, *run.steps[number + 1 :]))


def _posed(run: PrismRun, state: State, reason: str = "") -> PrismRun:
    number = run.next_pose
    if number is None or run.poses is None:
        raise ValueError("no pose is left")
    pose = replace(run.poses[number], state=state, reason=reason)
    return replace(run, poses=(*run.poses[:number], pose, *run.poses[number + 1 :]))


def _rest_skipped(run: PrismRun, reason: str) -> PrismRun:
    poses = tuple(
        replace(pose, state="skipped", reason=reason) if pose.state == "to do" else pose for pose in run.poses or ()
    )
    return replace(run, poses=poses)


def _measured(job: Job, details: Mapping[str, Any]) -> Job:
    posed = _posed(job.run, "done")
    return job.changed(poses=posed.poses, last=int(details["last"]), label=str(details["pose"]))


def _more(job: Job, details: Mapping[str, Any]) -> Job:
    """Add new poses to the remaining ones; the stop rule does not apply until all are done."""
    poses = (*(job.run.poses or ()), *(PlannedPose(pose) for pose in details["poses"]))
    least = sum(pose.state != "skipped" for pose in poses)
    return job.changed(poses=poses, enough="", least=least)


def _left(job: Job) -> Job:
    rest = _rest_skipped(job.run, job.run.enough or "enough")
    return job.changed(poses=rest.poses).stepped()


_STEP_OF: Mapping[str, StepKind] = {
    "shot": "shoot_control_point",
    "aimed": "change_prism",
    "measured": "poses",
    "more": "poses",
    "left": "poses",
    "closed": "close",
}
_EVENTS: Mapping[str, Callable[[Job, Mapping[str, Any]], Job]] = {
    "opened": lambda job, d: job.changed(session=str(d["session"]), last=int(d["last"])),
    "planned": lambda job, d: job.changed(poses=tuple(PlannedPose(pose) for pose in d["poses"])),
    "shot": lambda job, d: replace(job, misclosure_mm=d["misclosure_mm"]).stepped(),
    "aimed": lambda job, _: job.stepped(),
    "measured": _measured,
    "enough": lambda job, d: job.changed(enough=str(d["reason"])),
    "more": _more,
    "left": lambda job, _: _left(job),
    "closed": lambda job, _: job.stepped(),
    "skipped": lambda job, d: job.skipped(str(d["reason"]), rest=bool(d.get("rest"))),
    "failed": lambda job, d: replace(job, trouble=str(d["text"])),
    "stopped": lambda job, d: replace(job, state="abandoned", ended_because=str(d["reason"])),
}


def pose_reasons(run: PrismRun) -> Iterator[dict[str, Any]]:
    """Yield number and reason of each skipped pose."""
    for number, pose in enumerate(run.poses or (), start=1):
        if pose.state == "skipped":
            yield {"pose": number, "reason": pose.reason}
