"""Validation of an operator's request for a guide, the arguments of `guide.start`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from calibration.rig.description import Rig
from daemon.commands import CommandError, identifier, number_argument
from daemon.guide.job import Job, Pose, Request

MOST_POSES = 1000
DEFAULT_POSES = 20
CHECK_POSES = (3, 5)
DEFAULT_CHECK_POSES = 4
_MOST_POINTS = 20
_SMALLEST_TARGET_MM = 1e-3


def request_of(arguments: Mapping[str, Any], rig: Rig, known_points: Sequence[str]) -> Request:
    """Return the requested job.

    Args:
        arguments: arguments of `guide.start`.
        rig: the machine.
        known_points: control points of the set-up.

    Raises:
        CommandError: an argument is invalid.
    """
    plan = _plan(arguments.get("plan"), rig)
    if plan is not None and arguments.get("poses") is not None:
        raise CommandError("a plan has its own number of poses; give --plan or --poses, not both")
    points = _names(arguments, "control_points") or list(known_points) or ["cp1"]
    for point in points:
        identifier({"name": point}, "name", "a control point's name")
        if point in rig.prism_names:
            raise CommandError(f"{point!r} is a prism of the rig; a control point stands still, away from the rig")
    if len(points) > _MOST_POINTS:
        raise CommandError(f"a set-up has at most {_MOST_POINTS} control points, not {len(points)}")
    prisms = _names(arguments, "prisms") or list(rig.prism_names)
    unknown = [prism for prism in prisms if prism not in rig.prism_names]
    if unknown:
        raise CommandError(f"rig {rig.name!r} has no prism {unknown[0]!r:.80}; it has {', '.join(rig.prism_names)}")
    out_of_view = [prism for prism in prisms if plan is not None and not any(prism in seen for _, seen in plan)]
    if out_of_view:
        raise CommandError(f"no pose of the plan has prism {out_of_view[0]} in view")
    target_mm = number_argument(arguments, "target_mm")
    if target_mm is not None and target_mm < _SMALLEST_TARGET_MM:
        raise CommandError(f"target_mm is {_SMALLEST_TARGET_MM:g} mm or more, not {target_mm:g}")
    check = whole_argument(arguments, "check_poses", DEFAULT_CHECK_POSES, 0, CHECK_POSES[1])
    if 0 < check < CHECK_POSES[0]:
        raise CommandError(f"a check has {CHECK_POSES[0]} to {CHECK_POSES[1]} poses, or 0 for no check, not {check}")
    poses = whole_argument(arguments, "poses", DEFAULT_POSES, 1, MOST_POSES)
    return Request(tuple(points), tuple(prisms), poses, check, target_mm, plan)


def misfit(job: Job, rig: Rig) -> str:
    """Return why a job cannot continue with the present rig file, a clause; "" if it can."""
    prisms = sorted({run.prism for run in job.runs} - set(rig.prism_names))
    if prisms:
        return f"the rig file has changed: it has no prism {prisms[0]} any more"
    poses = [pose.joints for run in job.runs for pose in run.poses or ()]
    if any(set(pose) != set(rig.joint_names) for pose in poses):
        return "the rig file has changed: the poses of this guide have different joints"
    return ""


def whole_argument(arguments: Mapping[str, Any], key: str, default: int, least: int, most: int) -> int:
    """Return the whole number under `key`; CommandError unless it is one from `least` to `most`."""
    value = arguments.get(key)
    if value is None:
        return default
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise CommandError(f"{key} must be a whole number from {least} to {most}, not {value!r:.80}")
    return value


def _names(arguments: Mapping[str, Any], key: str) -> list[str]:
    """Return a list of distinct names, empty by default."""
    value = arguments.get(key) or []
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise CommandError(f"{key} must be a list of names, not {value!r:.80}")
    if len(set(value)) < len(value):
        raise CommandError(f"{key} contains the same name twice")
    return value


def _plan(rows: object, rig: Rig) -> tuple[tuple[Pose, tuple[str, ...]], ...] | None:
    """Return poses with the prisms in view; None if no plan is given."""
    if rows is None:
        return None
    if not isinstance(rows, list) or not 1 <= len(rows) <= MOST_POSES:
        raise CommandError(f"plan must be a list of 1 to {MOST_POSES} poses, as `rigcal plan --json` prints them")
    return tuple(_planned(number, row, rig) for number, row in enumerate(rows, start=1))


def _planned(number: int, row: object, rig: Rig) -> tuple[Pose, tuple[str, ...]]:
    if not isinstance(row, dict):
        raise CommandError(f"pose {number} of the plan must be an object, not {row!r:.80}")
    pose: dict[str, float] = {}
    for joint in rig.joints:
        value = number_argument(row, joint.column)
        if value is None:
            raise CommandError(f"pose {number} of the plan has no {joint.column}")
        low, high = joint.limits
        if not low <= value <= high:
            raise CommandError(
                f"pose {number} of the plan: {joint.name} = {value:g} {joint.unit} is beyond its limits, {low:g} to "
                f"{high:g}"
            )
        pose[joint.name] = float(value)
    seen = row.get("prisms", list(rig.prism_names))
    if not isinstance(seen, list) or any(prism not in rig.prism_names for prism in seen):
        raise CommandError(f"pose {number} of the plan: prisms must be a list of {', '.join(rig.prism_names)}")
    return pose, tuple(seen)
