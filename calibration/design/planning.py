"""Pose plan of the command line: the most informative poses, and the accuracy expected from them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from calibration.design.accuracy import VOLUME_POSES, ExpectedAccuracy, accuracy_of_model, predicted_accuracy
from calibration.design.candidates import CANDIDATES, Candidates, draw, near, work_volume
from calibration.design.conditions import instructions
from calibration.design.knowledge import Knowledge, setup_of
from calibration.design.poses import Plan, plan, volume_root
from calibration.design.visibility import Site, placement, site
from calibration.errors import UnsafeError
from calibration.kinematics.chain import Chain, Placement
from calibration.model.model import CalibratedModel
from calibration.observations import Floats
from calibration.rig.description import Rig
from calibration.run_settings import DEFAULT_RUN, Run

_COVERED = 0.8  # share of a joint's range below which its coverage is reported
_SHARE = 0.03  # share of the expected variance from which on a parameter is reported
_NAMED = 3
_CERTAIN_SIGMA = 5.0
_DIGITS = 2


@dataclass(frozen=True)
class PoseRow:
    """One pose of a plan.

    Attributes:
        pose: number of the pose, from 1.
        joints: column of each joint -> value, deg or mm.
        conditions: column of each condition that matters -> value: -1 or 1 for a direction of approach; for `fixes` the
            number of fixes of each prism.
        prisms: prisms in view.
    """

    pose: int
    joints: Mapping[str, float]
    conditions: Mapping[str, float]
    prisms: tuple[str, ...]

    def as_dict(self) -> dict[str, object]:
        """Return a JSON object: `pose`, each joint and each condition (`<joint>_dir` ...) by column, `prisms`."""
        return {"pose": self.pose, **self.joints, **self.conditions, "prisms": list(self.prisms)}


@dataclass(frozen=True)
class PosePlan:
    """Poses to measure and the expected accuracy.

    Attributes:
        rig: the rig description.
        plan: the poses.
        at: station and floor.
        station: a sentence with the station's place and its origin.
        before: expected accuracy of the present model; None without a model.
        after: expected accuracy of the model once the poses are measured.
        advice: sentences with instructions for the conditions, poorly known parameters and the expected improvement.
        warnings: sentences.
    """

    rig: Rig
    plan: Plan
    at: Site
    station: str
    before: ExpectedAccuracy | None
    after: ExpectedAccuracy
    advice: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def assumptions(self) -> tuple[str, ...]:
        """Assumptions of the plan, in sentences."""
        if self.before is not None:
            return (self.station, *self.at.rules)
        lacks = "expected error: for a model that lacks no effects, with the noise that the rig file gives"
        return (self.station, *self.at.rules, lacks)

    @cached_property
    def rows(self) -> tuple[PoseRow, ...]:
        """The poses in the order of the motion."""
        return pose_rows(self.rig, self.plan.poses)

    def as_dict(self) -> dict[str, object]:
        """Return the JSON object of `rigcal plan`."""
        return {
            "rig": self.rig.name,
            "poses": [row.as_dict() for row in self.rows],
            "fixes": self.plan.poses.fixes_in_all,
            "seconds_of_motion": round(self.plan.seconds_of_motion, 1),
            "parameters": self.plan.parameters,
            "determined": self.plan.determined,
            "observability": self.plan.observability,
            "predicted_accuracy_mm": self.after.as_dict(),
            "present_accuracy_mm": self.before.as_dict() if self.before else None,
            "stands_out_sigma": self.plan.stands_out,
            "station_mm": [round(float(c), 1) + 0.0 for c in self.at.station_mm],
            "assumptions": list(self.assumptions),
            "advice": list(self.advice),
            "warnings": list(self.warnings),
        }


def pose_rows(rig: Rig, poses: Candidates) -> tuple[PoseRow, ...]:
    """Return the rows of a pose table, rounded for printing."""
    conditions = {name: values.round(_DIGITS).tolist() for name, values in poses.conditions.items()}
    return tuple(
        PoseRow(
            number + 1,
            {j.column: round(float(poses.readings[number, i]), _DIGITS) for i, j in enumerate(rig.joints)},
            {
                name: int(values[number]) if name.endswith(("_dir", "fixes")) else values[number] + 0.0
                for name, values in conditions.items()
            },
            tuple(name for name, seen in zip(rig.prism_names, poses.seen[number], strict=True) if seen),
        )
        for number in range(len(poses))
    )


def plan_poses(
    rig: Rig,
    poses: int,
    *,
    model: CalibratedModel | None = None,
    station_mm: Floats | None = None,
    setup: str | None = None,
    floor_mm: float | None = None,
    separate: Sequence[str] = (),
    run: Run = DEFAULT_RUN,
) -> PosePlan:
    """Plan the poses of a first session, or of a session after a calibration.

    Without a model, the poses determine the parameters best. With a model, they minimise its expected error over the
    work volume. With `separate`, they distinguish effects.

    Args:
        rig: the rig description.
        poses: number of poses.
        model: a calibrated model. The poses will be measured at one of its set-ups, unless `station_mm` is given.
        station_mm: (3,) place of a new station set-up in the base frame.
        setup: the model's set-up to measure at; by default the one whose base is known best.
        floor_mm: height of the floor above the base's origin.
        separate: two or more effects of the library, each as `family@where`.
        run: random seed of candidates and work volume, and the progress callback.

    Returns:
        The poses in the order of measurement, with the expected accuracy before and after.

    Raises:
        DataError: fewer reachable poses than requested; an effect that is not visible in any pose.
        UnsafeError: the model is of a different rig, or lacks that set-up; no reachable pose is in view.
    """
    rng, report = np.random.default_rng(run.seed), run.progress
    if model is not None:
        _require_same(rig, model.rig)
    report(0.0, "placing the station")
    present = None if model is None else Knowledge.of_model(model, setup_of(model, setup))
    knowledge, at, station = _surroundings(rig, present, station_mm, floor_mm)
    report(0.1, "drawing poses")
    candidates = draw(knowledge, at, rng, max(CANDIDATES, poses))
    volume = work_volume(knowledge, at, rng, VOLUME_POSES)
    report(0.4, "choosing poses")
    nearby = partial(near, knowledge, at, rng) if separate else None
    by_volume = None if model is None else volume
    chosen = plan(knowledge, candidates, poses, volume=by_volume, separate=separate, nearby=nearby)
    report(0.9, "predicting the accuracy")
    before: ExpectedAccuracy | None = None
    advice = instructions(rig, chosen.poses.conditions)
    if model is None or present is None:
        after = predicted_accuracy(knowledge, chosen.root, volume)
    else:
        before = accuracy_of_model(model, present, present.root, volume)
        after = accuracy_of_model(model, knowledge, chosen.root, volume)
        advice += tuple(_advice(model, present, chosen, before, after, moved=station_mm is not None))
    return PosePlan(rig, chosen, at, station, before, after, advice, tuple(_warnings(rig, chosen, model)))


def _require_same(rig: Rig, of_model: Rig) -> None:
    """Raise UnsafeError unless the rigs are equal, apart from their channels and the decoding of bus messages."""
    if of_model.name != rig.name:
        raise UnsafeError(f"the model is of rig {of_model.name!r}, not of {rig.name!r}; name its own rig")
    differ = [key for key in rig.differences(of_model) if key not in ("channels", "decoding")]
    if differ:
        raise UnsafeError(
            f"rig {rig.name!r} differs from the rig that the model was calibrated with, in {', '.join(differ)}; "
            f"plan with that rig file, or calibrate again with this one"
        )


def _surroundings(
    rig: Rig, present: Knowledge | None, station_mm: Floats | None, floor_mm: float | None
) -> tuple[Knowledge, Site, str]:
    """Return the knowledge and site for the poses to be measured, and a sentence about the station's place."""
    if present is not None and station_mm is None:
        at = site(present.chain, present.x, setup=present.setup, floor_mm=floor_mm)
        label = f"set-up {name!r}" if (name := present.chain.setups[present.setup]) else "the set-up"
        others = "; choose another with --setup NAME" if len(present.chain.setups) > 1 else ""
        return present, at, f"station: as in {label} of the model, {_place(at)}{others}"
    blank = Chain(rig, {"": Placement.identity()})
    x = np.zeros(len(blank))
    if present is not None:
        x[: blank.base_start] = present.x[: blank.base_start]
    at = site(blank, x, station_mm=station_mm, floor_mm=floor_mm)
    chain = Chain(rig, {"": placement(at)})
    known = present.at_new_setup(chain) if present is not None else Knowledge.of_rig(chain)
    if station_mm is not None:
        return known, at, f"station: a new set-up, {_place(at)}"
    return known, at, f"station: assumed where it sees most, {_place(at)}; give its place with --station X,Y,Z"


def _place(at: Site) -> str:
    return f"at {', '.join(f'{round(float(c))}' for c in at.station_mm)} mm in the base frame"


def _advice(
    model: CalibratedModel,
    present: Knowledge,
    chosen: Plan,
    before: ExpectedAccuracy,
    after: ExpectedAccuracy,
    *,
    moved: bool,
) -> Iterator[str]:
    poses = chosen.poses
    if moved:
        yield (
            f"these {len(poses)} poses would leave an expected error of {after.rms_mm:.3g} mm RMS over the work volume "
            f"at the new set-up; at the model's own set-up it is {before.rms_mm:.3g} mm"
        )
    else:
        yield (
            f"these {len(poses)} poses would lower the expected error over the work volume from {before.rms_mm:.3g} to "
            f"{after.rms_mm:.3g} mm RMS"
        )
    yield f"the present model's expected error is {before.where}"
    if after.lacking_mm > 0.5 * after.rms_mm:
        yield (
            f"{after.lacking_mm:.3g} mm of it is due to effects that the model lacks, which more poses do not lower; "
            f"look for an effect or train a residual"
        )
    yield from _poorly_known(present, before.readings)
    rig = model.rig
    for index, joint in enumerate(rig.joints):
        low, high = model.coverage.ranges[joint.name]
        if high - low < _COVERED * (joint.limits[1] - joint.limits[0]):
            beyond = int(((poses.readings[:, index] < low) | (poses.readings[:, index] > high)).sum())
            yield (
                f"{joint.name} was measured only at {low:.0f} .. {high:.0f} of its {joint.limits[0]:g} .. "
                f"{joint.limits[1]:g} {joint.unit}; {beyond} of these poses go beyond this range"
            )
    for prism, name in enumerate(rig.prism_names):
        if not model.coverage.fixes.get(name):
            yield f"prism {name} has no fixes yet; it is in view in {int(poses.seen[:, prism].sum())} of these poses"


def _poorly_known(knowledge: Knowledge, volume: Floats) -> Iterator[str]:
    """Yield a sentence with the parameters whose exact knowledge would lower the expected variance tr(B C) most.

    Knowing parameter i exactly lowers it by (C B C)_ii / C_ii, including the effect through correlated parameters.
    """
    root, by_volume = knowledge.root, volume_root(knowledge, volume)
    variance = (root**2).sum(axis=1)
    taken = ((root @ by_volume) ** 2).sum(axis=1) / np.where(variance > 0.0, variance, 1.0)
    share = taken / float((by_volume**2).sum())
    sizes = []
    for i in np.argsort(-share[: len(knowledge.chain)])[:_NAMED]:
        if share[i] >= _SHARE:
            parameter, sigma = knowledge.chain.parameters[i], math.sqrt(float(variance[i]))
            size = f"{math.degrees(sigma):.2g} deg" if parameter.unit == "rad" else f"{sigma:.2g} mm"
            sizes.append(f"{parameter.name} (+-{size}, {share[i]:.0%})")
    if sizes:
        yield f"poorly known parameters, with their share of the expected variance: {', '.join(sizes)}"


def _warnings(rig: Rig, chosen: Plan, model: CalibratedModel | None) -> Iterator[str]:
    fixes, needed = chosen.poses.fixes_in_all, math.ceil(chosen.parameters / 3)
    if model is None and fixes < needed:
        yield f"{fixes} fixes are too few: calibrating {chosen.parameters} parameters needs at least {needed}"
    for prism, name in enumerate(rig.prism_names):
        if not chosen.poses.seen[:, prism].any():
            yield f"prism {name} is in view in none of the poses"
    for effect, sigma in chosen.stands_out.items():
        if sigma < _CERTAIN_SIGMA:
            yield (
                f"{effect} of plausible size would stand out from the others by {sigma:.1f} sigma only: plan more "
                f"poses, or choose a different experiment"
            )
