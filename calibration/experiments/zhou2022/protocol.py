"""The whole of section 4: errors before calibration, Table 3, Pareto front of weights, learning curve, trajectory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from calibration.evaluation.evaluation import require_positions
from calibration.experiments.comparison import REFIT_BASE
from calibration.experiments.zhou2022.held_out import (
    DRAWS,
    POINTS,
    LearningPoint,
    Trajectory,
    learning_curve,
    trajectory,
)
from calibration.experiments.zhou2022.held_out import PAPER as PAPER_TRAJECTORY
from calibration.experiments.zhou2022.table3 import PAPER_AFTER, Flags, Identified, Table3
from calibration.experiments.zhou2022.weights import Front
from calibration.identification.refinement import Prior
from calibration.identification.samples import LEAST_STOPS, standing_spread, stops
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Observations
from calibration.pipeline.calibrate import calibrate, identify, require_known_setups
from calibration.published.paper_evolution import PaperSettings
from calibration.rig.description import Rig
from calibration.run_settings import DEFAULT_RUN, Run

# Mean absolute errors in mm that the paper reports for its own machine.
PAPER_BEFORE: Mapping[str, Mapping[str, float]] = {
    "single-joint": {"r": 323.59, "s": 477.53, "b": 895.52, "w": 930.88},
    "multi-joint": {"r": 355.61, "s": 783.17, "b": 1085.32, "w": 1288.92},
}


@dataclass(frozen=True)
class Before:
    """Errors of the nominal model on the training rows of one kind of motion.

    Attributes:
        motion: `single-joint` or `multi-joint`.
        fixes: prism -> number of fixes.
        mean_mm: prism -> mean error.
    """

    motion: str
    fixes: Mapping[str, int]
    mean_mm: Mapping[str, float]


@dataclass(frozen=True)
class Protocol:
    """Results of the protocol, as in section 4 of the paper.

    Attributes:
        rig: name of the rig.
        training, held_out: numbers of rows.
        before: errors of the nominal model on the training rows.
        held_out_before_mm: prism -> mean error of the nominal model on the held-out rows.
        identified: lines of Table 3.
        front: Pareto front of the weights; None if only one prism was measured.
        learning: learning curve, from few poses to all.
        trajectory: errors along the tip's path.
        warnings: warnings about data and fit, and parts that were not possible with the reason.
    """

    rig: str
    training: int
    held_out: int
    before: tuple[Before, ...]
    held_out_before_mm: Mapping[str, float]
    identified: tuple[Identified, ...]
    front: Front | None
    learning: tuple[LearningPoint, ...]
    trajectory: Trajectory
    warnings: tuple[str, ...]

    def as_dict(self) -> dict[str, object]:
        """Return the results as a JSON object, together with the paper's own figures."""
        front = None
        if self.front is not None:
            points = [
                {"weights": dict(p.weight), "rms_mm": dict(p.rms_mm), "dominated": p.dominated}
                for p in self.front.points
            ]
            front = {"chosen_weights": dict(self.front.weight), "points": points}
        return {
            "protocol": "zhou2022",
            "rig": self.rig,
            "n": self.training,
            "n_holdout": self.held_out,
            "before": {b.motion: {"fixes": dict(b.fixes), "mean_mm": dict(b.mean_mm)} for b in self.before},
            "holdout_before_mm": dict(self.held_out_before_mm),
            "identification": [line.as_dict() for line in self.identified],
            "front": front,
            "learning_curve": [point.as_dict() for point in self.learning],
            "trajectory": self.trajectory.as_dict(),
            "paper": {
                "before_mm": {motion: dict(values) for motion, values in PAPER_BEFORE.items()},
                "after_mm": {data: dict(values) for data, values in PAPER_AFTER.items()},
                "trajectory": {name: {"mean_mm": m, "std_mm": s} for name, (m, s) in PAPER_TRAJECTORY.items()},
            },
            "warnings": list(self.warnings),
        }


def run_protocol(
    rig: Rig,
    rig_text: str,
    training: Observations,
    held_out: Observations,
    *,
    clock: Callable[[], float],
    prior: Prior = "recalibration",
    time_limit_s: float | None = None,
    settings: PaperSettings | None = None,
    draws: int = DRAWS,
    run: Run = DEFAULT_RUN,
) -> Protocol:
    """Repeat all experiments of section 4 with the given data.

    Args:
        rig: the rig description.
        rig_text: the TOML that it was read from.
        training: rows to fit, of single-joint and of multi-joint motion.
        held_out: rows of the same set-ups that are not used in any fit; the first 200 of the tip are the trajectory.
        clock: function that returns monotonic seconds.
        prior: trust the build tolerances, or estimate their scale; also determines the width of the bounds of Table 3.
        time_limit_s: time limit of each of the paper's searches.
        settings: settings of the paper's search; the paper's own by default.
        draws: number of random draws for each size of the learning curve.
        run: seed, workers and progress.

    Raises:
        DataError: rows without positions, prisms that the rig lacks.
        UnsafeError: as for the training rows in `pipeline.calibrate`, or the training rows lack a held-out set-up.
    """
    # BLAS threads within the threads of the search would wait for each other.
    with threadpool_limits(1, user_api="blas"):
        alone = run.quiet()
        for observations in (training, held_out):
            require_positions(observations)
        require_known_setups(training, held_out, REFIT_BASE)
        run.progress(0.0, "calibrating")
        model, _ = calibrate(rig, rig_text, training, prior=prior, run=alone)
        bare = identify(rig, rig_text, training, prior=prior, effects="none", run=alone)
        single = single_joint_rows(rig, training)
        warnings = [*model.warnings, *_missing_motion(single)]

        table = Table3.prepare(rig, training, held_out, single, prior)
        front = table.front(run.part(0.1, 0.2))
        if front is None:
            warnings.append("only one prism was measured: there are no objectives to weight")
        identified: list[Identified] = []
        lines = table.data_sets(front)
        for number, (data, rows, weight) in enumerate(lines):
            if not table.enough(rows):
                warnings.append(f"Table 3 has no line of {data} data: {int(rows.sum())} different fixes are too few")
                continue
            begin, end = (0.2 + 0.4 * done / len(lines) for done in (number, number + 1))
            identified += table.identify(
                data,
                rows,
                weight,
                run=run.part(begin, end, f"the paper's search on {data} data"),
                clock=clock,
                settings=settings,
                time_limit_s=time_limit_s,
            )
        if not all(line.complete for line in identified):
            warnings.append("the paper's search stopped at the time limit; its lines are the best found until then")

        learning = learning_curve(
            rig,
            rig_text,
            training,
            held_out,
            model,
            prior=prior,
            run=run.part(0.6, 0.9),
            draws=draws,
        )
        path = trajectory(model, bare, training, held_out, run.part(0.9, 1.0))
        warnings += _path_warnings(path)
        return Protocol(
            rig.name,
            len(training),
            len(held_out),
            _before(model, training, single),
            table.held_out_mean_mm(),
            tuple(identified),
            front,
            learning,
            path,
            tuple(warnings),
        )


def _before(model: CalibratedModel, training: Observations, single: Flags) -> tuple[Before, ...]:
    error_mm = np.linalg.norm(training.position_mm - Predictor.of(model).nominal_mm(training), axis=1)
    found = []
    for motion, rows in (("single-joint", single), ("multi-joint", ~single)):
        prisms = np.unique(training.prism[rows]).tolist()
        own = {name: rows & (training.prism == name) for name in model.rig.prism_names if name in prisms}
        if own:
            fixes = {name: int(mask.sum()) for name, mask in own.items()}
            found.append(Before(motion, fixes, {name: float(error_mm[mask].mean()) for name, mask in own.items()}))
    return tuple(found)


def _missing_motion(single: Flags) -> list[str]:
    if not single.any():
        return ["the training rows contain no single-joint sweep: its columns and lines are left out"]
    if single.all():
        return [
            "all training rows belong to single-joint sweeps: the columns and lines of multi-joint data are left out"
        ]
    return []


def _path_warnings(path: Trajectory) -> list[str]:
    found = []
    if len(path.rows) < POINTS:
        found.append(f"the trajectory has {len(path.rows)} points, not {POINTS}: prism {path.prism!r} has no more")
    if not path.in_time:
        found.append("the held-out rows have no time_s: the trajectory is in the order of the rows")
    return found


def single_joint_rows(rig: Rig, observations: Observations) -> Flags:
    """Return an (n,) mask of rows measured while only one joint was moved from stop to stop.

    A row counts if there is a joint with at least five different readings, including that of the row, at its set-up
    while all other joints stood still. Unlike the sweeps of `find_axes`, which compare only the joints that move the
    prism and share no rows, this test compares all joints, and each row with its own neighbours.

    Args:
        rig: the rig description.
        observations: n rows.
    """
    found = np.zeros(len(observations), dtype=bool)
    scaled = np.column_stack([observations.joints[name] for name in rig.joint_names]) / standing_spread(rig)
    for setup in np.unique(observations.setup):
        rows = np.flatnonzero(observations.setup == setup)
        poses, of_row = np.unique(scaled[rows], axis=0, return_inverse=True)
        swept = np.zeros(len(poses), dtype=bool)
        for joint in range(len(rig.joints)):
            others = np.delete(poses, joint, axis=1)
            if others.shape[1] == 0:
                others = np.zeros((len(poses), 1))
            near = cKDTree(others).query_ball_point(others, 1.0, p=np.inf)
            swept |= np.array([stops(np.sort(poses[group, joint]), 1.0)[-1] + 1 >= LEAST_STOPS for group in near])
        found[rows] = swept[of_row]
    return found
