"""A guide as clients see it: the JSON of `guide.state` (docs/reference/guide-socket.md), with words for steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from calibration.rig.description import Rig
from daemon.commands import CHECK
from daemon.guide.job import Job, PlannedPose, PrismRun, Step, pose_reasons
from daemon.guide.position import BoomPosition, is_there, joint_rows, joints_of
from daemon.store.queries.guides import GuideRow, Standstill

_MORE = {"button": "Measure 5 more poses", "command": "guide.more", "arguments": {"poses": 5}}


@dataclass(frozen=True)
class Around:
    """State of a guide apart from its job.

    Attributes:
        boom: present joint readings.
        standstill: newest standstill of this pose whose observations count.
        accuracy, coverage: newest answer of the gain meter.
        taps: number of commands given to the guide.
        is_busy: True while the daemon is carrying out the step.
        is_detected: True if the step ends automatically once it is done.
        has_aim: True if the station is turned without an operator.
        settle_s, needed_fixes: how long to stand at a pose, and how many fixes must count there.
        warnings: sentences.
        model: candidate model that awaits a decision; None before the guide is finished.
    """

    boom: BoomPosition
    standstill: Standstill | None
    accuracy: Mapping[str, Any] | None
    coverage: Mapping[str, Any] | None
    taps: int
    is_busy: bool
    is_detected: bool
    has_aim: bool
    settle_s: float
    needed_fixes: int
    warnings: list[str]
    model: Mapping[str, Any] | None


def state_of(rig: Rig, row: GuideRow, job: Job, around: Around) -> dict[str, Any]:
    """Return the object under the key `guide` of the state.

    Args:
        rig: the machine.
        row: stored row of the guide.
        job: job of the guide.
        around: state of the guide apart from its job.
    """
    run = job.run if job.state == "open" else None
    pose = _target(job)
    return {
        "id": row.id,
        "state": job.state,
        "setup": row.setup_id,
        "operator": row.operator,
        "prisms": list(job.request.prisms),
        "prism": run and run.prism,
        "session": (run and run.session) or None,
        "session_kind": run and run.kind,
        "started_utc_ns": row.started.utc_ns,
        "taps": around.taps,
        "step": _step(rig, job, around),
        "joints": joint_rows(rig, around.boom, None if pose is None else pose.joints),
        "hold": None if pose is None else _hold(rig, pose, around),
        "poses": None if run is None else _counts(run),
        "accuracy": around.accuracy,
        "coverage": around.coverage,
        "misclosure_mm": job.misclosure_mm,
        "steps": _steps(job),
        "messages": _messages(job, around),
        "model": around.model,
    }


def headline(job: Job) -> str:
    """Return the step in a few words."""
    if job.state != "open":
        return f"the guide is {job.state}"
    return _title(job)


def _target(job: Job) -> PlannedPose | None:
    """Return the pose to go to; None at other steps."""
    run = job.run
    if job.step is None or job.step.kind != "poses" or job.is_enough or run.next_pose is None or run.poses is None:
        return None
    return run.poses[run.next_pose]


# ---- the step --------------------------------------------------------------------------------------------------------


def _kind(rig: Rig, job: Job, around: Around) -> str:
    step = job.step
    if step is None or step.kind != "poses":
        return job.state if step is None else step.kind
    if job.run.poses is None:
        return "planning"
    target = _target(job)
    if target is None:
        return "enough"
    boom = around.boom
    return "hold" if boom.is_fresh and is_there(rig, boom.values, target.joints) else "go_to_pose"


def _step(rig: Rig, job: Job, around: Around) -> dict[str, Any]:
    step, run, kind = job.step, job.run, _kind(rig, job, around)
    instruction, why = _words(job, kind, around)
    is_busy = around.is_busy or kind in ("planning", "close")
    buttons = {
        "shoot_control_point": f"Station is on {step.point if step else ''}: measure it",
        "change_prism": f"Station is on prism {run.prism}",
        "go_to_pose": "Measure here",
        "hold": "Measure here",
        "enough": "Enough: go on",
    }
    is_pose = kind in ("go_to_pose", "hold")
    others: list[dict[str, Any]] = [dict(_MORE)] if kind == "enough" and run.kind != CHECK else []
    if is_pose and run.done:
        skip = {"reason": "the operator has enough", "rest": True}
        others.append({"button": "Enough of this prism", "command": "guide.skip", "arguments": skip})
    return {
        "id": job.step_id,
        "kind": kind,
        "number": _number(job),
        "of": sum(len(r.steps) for r in job.runs),
        "title": _title(job),
        "instruction": instruction,
        "why": why,
        "point": (step.point if step else "") or None,
        "phase": (step.phase if step else "") or None,
        "pose": run.next_pose + 1 if is_pose and run.next_pose is not None else None,
        "is_busy": is_busy and job.state == "open",
        "can_skip": job.state == "open" and kind not in ("close", "planning"),
        "is_detected": is_pose or (around.is_detected and kind in ("shoot_control_point", "enough")) or around.has_aim,
        "button": None if is_busy else buttons.get(kind),
        "others": others,
    }


def _number(job: Job) -> int:
    before = sum(len(run.steps) for run in job.runs[: job.at])
    return before + (len(job.run.steps) if job.run.next_step is None else job.run.next_step + 1)


def _title(job: Job) -> str:
    step, run = job.step, job.run
    is_check = run.kind == CHECK
    if step is None:
        return "Everything is measured" if job.state == "finished" else "The guide was abandoned"
    if step.kind != "poses":
        return {
            "shoot_control_point": f"Shoot control point {step.point}",
            "change_prism": f"Aim at prism {run.prism}{' for the check' if is_check else ''}",
            "close": "Closing the session",
        }[step.kind]
    if run.poses is None:
        return "Choosing the poses"
    if job.is_enough or run.next_pose is None:
        return f"Enough poses of {'the check' if is_check else f'prism {run.prism}'}"
    return f"Go to {'check ' if is_check else ''}pose {run.next_pose + 1} of {len(run.poses)}"


def _words(job: Job, kind: str, around: Around) -> tuple[str, str]:
    """Return instruction and reason of a step."""
    step, run = job.step, job.run
    point = step.point if step else ""
    if kind == "shoot_control_point" and step is not None:
        by_itself = "; it is measured automatically" if around.is_detected else ", then confirm"
        when = "start" if step.phase == "start" else "end"
        why = f"Shots at the start and at the end of the session show that the station stood still ({when})."
        if around.is_busy:
            return f"Keep the station on control point {point}.", why
        return f"Aim the station at control point {point}{by_itself}.", why
    words = {
        "change_prism": (
            f"Aim the station at prism {run.prism}, let it lock, then confirm.",
            "From then on, fixes count as fixes of this prism."
            + (" They are held out to judge the model." if run.kind == CHECK else ""),
        ),
        "planning": (
            "Wait; this takes a few seconds, the first time up to half a minute.",
            "The poses are chosen from the measurements so far.",
        ),
        "go_to_pose": (
            "Move every joint to its target; the pose is measured automatically once the boom stands.",
            "The check shows the error of the model at poses it has never seen."
            if run.kind == CHECK
            else "Of all poses in view, this one adds most information.",
        ),
        "hold": ("Keep the boom still.", f"The pose is done after {around.needed_fixes} fixes at this standstill."),
        "enough": (
            _after_enough(job, around),
            (run.enough[:1].upper() + run.enough[1:] if run.enough else "All planned poses are done") + ".",
        ),
        "close": ("Wait; the session is being closed.", "Its jobs then start automatically."),
        "finished": (_after_all(around.model), "Accept the model only if it is better on the check."),
        "abandoned": (f"The guide was abandoned: {job.ended_because}.", "Start a new guide when you are ready."),
    }
    return words[kind]


def _after_enough(job: Job, around: Around) -> str:
    step = job.run.following
    if step is None or step.kind != "shoot_control_point":
        return "Go on."
    if around.is_detected:
        return (
            f"Aim the station at control point {step.point}, which is measured automatically. "
            "Or measure five more poses."
        )
    return f"Go on to control point {step.point}, or measure five more poses."


def _after_all(model: Mapping[str, Any] | None) -> str:
    if model is None or (model["id"] is None and not model["jobs"]):
        return "No model awaits a decision; `rigcal jobs list` shows the results of the jobs."
    if model["jobs"]:
        jobs = "1 job is" if model["jobs"] == 1 else f"{model['jobs']} jobs are"
        return f"You may leave now: {jobs} still working on the model; `rigcal jobs list` shows them."
    if model["is_acceptable"]:
        return f"Model {model['id']} awaits a decision: `rigcal model accept {model['id']}` makes it live."
    return f"Model {model['id']} awaits a decision, but would be refused: {model['refused_because']}"


# ---- parts -----------------------------------------------------------------------------------------------------------


def _hold(rig: Rig, pose: PlannedPose, around: Around) -> dict[str, Any]:
    """Return the progress at a pose; fixes of a standstill elsewhere do not count."""
    found = around.standstill
    fixes = found.fixes if found is not None and is_there(rig, joints_of(rig, found), pose.joints) else 0
    return {
        "is_known": around.boom.is_fresh,
        "since_s": around.boom.stands_s,
        "needed_s": around.settle_s,
        "fixes": fixes,
        "needed_fixes": around.needed_fixes,
    }


def _counts(run: PrismRun) -> dict[str, int]:
    poses = run.poses
    return {
        "done": run.done,
        "skipped": sum(pose.state == "skipped" for pose in poses or ()),
        "planned": run.most if poses is None else len(poses),
    }


def _steps(job: Job) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for number, run in enumerate(job.runs):
        for index, step in enumerate(run.steps):
            is_now = job.state == "open" and number == job.at and index == run.next_step
            poses = None
            if step.kind == "poses":
                counts = _counts(run)
                poses = {"done": counts["done"], "planned": counts["planned"], "skipped": [*pose_reasons(run)]}
            rows.append(
                {
                    "number": len(rows) + 1,
                    "kind": step.kind,
                    "title": _row_title(run, step),
                    "prism": run.prism,
                    "state": "now" if is_now else step.state,
                    "reason": step.reason,
                    "poses": poses,
                }
            )
    return rows


def _row_title(run: PrismRun, step: Step) -> str:
    what = "the check" if run.kind == CHECK else f"prism {run.prism}"
    match step.kind:
        case "shoot_control_point":
            return f"Control point {step.point}, {step.phase} of {what}"
        case "change_prism":
            return f"Aim at prism {run.prism}"
        case "poses":
            return f"Poses of {what}"
    return f"Close the session of {what}"


def _messages(job: Job, around: Around) -> list[dict[str, str]]:
    found = [{"severity": "warning", "text": text} for text in around.warnings]
    if job.state == "open" and around.boom.missing:
        found.append({"severity": "warning", "text": around.boom.missing})
    run = job.run
    skipped = [s for s in run.steps if s.kind == "shoot_control_point" and s.state == "skipped"]
    if job.state == "open" and skipped:
        text = (
            f"control point {skipped[0].point} was skipped ({skipped[0].reason}): unless a different one is shot at "
            "both ends, the session is not used until an operator accepts it"
        )
        found.append({"severity": "note", "text": text})
    return found
