"""The whole of section 4: errors before, Table 3, the front of the weights, the learning curve, the trajectory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from calibration.comparison import require_known_setups
from calibration.evaluation import require_positions
from calibration.identification.refinement import Prior
from calibration.model import CalibratedModel
from calibration.observations import Observations
from calibration.pipeline import calibrate, identify
from calibration.published.paper_evolution import PaperSettings
from calibration.published.zhou2022.front import Front
from calibration.published.zhou2022.learning import DRAWS, LearningPoint, learning_curve
from calibration.published.zhou2022.motion import Flags, single_joint_rows
from calibration.published.zhou2022.table3 import PAPER_AFTER, Experiment, Identified
from calibration.published.zhou2022.trajectory import PAPER as PAPER_TRAJECTORY
from calibration.published.zhou2022.trajectory import POINTS, Trajectory, trajectory
from calibration.rig import Rig

Progress = Callable[[float, str], None]

# Mean absolute errors in mm that the paper reports of its own machine.
PAPER_BEFORE: Mapping[str, Mapping[str, float]] = {
    "single-joint": {"r": 323.59, "s": 477.53, "b": 895.52, "w": 930.88},
    "multi-joint": {"r": 355.61, "s": 783.17, "b": 1085.32, "w": 1288.92},
}


@dataclass(frozen=True)
class Before:
    """The nominal model on the training rows of one kind of motion.

    Attributes:
        motion: `single-joint` or `multi-joint`.
        fixes: prism -> how many.
        mean_mm: prism -> mean error.
    """

    motion: str
    fixes: Mapping[str, int]
    mean_mm: Mapping[str, float]


@dataclass(frozen=True)
class Protocol:
    """Everything that section 4 shows.

    Attributes:
        rig: name.
        training, held_out: how many rows.
        before: of the training rows.
        held_out_before_mm: prism -> mean error of the nominal model on the held-out rows.
        identified: Table 3.
        front: of the weights; None where one prism alone was measured.
        learning: from few poses to all.
        trajectory: along the tip's path.
        warnings: about data and fit, and what could not be done and why.
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
        """For JSON; the paper's own figures are beside them."""
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
    executor: Executor,
    seed: int = 0,
    prior: Prior = "recalibration",
    time_limit_s: float | None = None,
    settings: PaperSettings | None = None,
    draws: int = DRAWS,
    progress: Progress | None = None,
) -> Protocol:
    """Do everything of section 4 with these data.

    Args:
        rig, rig_text: the rig description and the TOML it was read from.
        training: rows to fit, of single-joint and of multi-joint motion.
        held_out: rows of the same set-ups that nothing is fitted to; the first 200 of the tip are the trajectory.
        clock: monotonic seconds.
        executor: runs the searches; results do not depend on it.
        seed: of everything random.
        prior: trust the build tolerances, or estimate their scale; also how wide the bounds of Table 3 are.
        time_limit_s: ends each of the paper's searches.
        settings: of the paper's search; the paper's by default.
        draws: of each size in the learning curve.
        progress: told (share done, what is going on).

    Raises:
        DataError: rows without positions, prisms that the rig lacks.
        UnsafeError: as `pipeline.calibrate` refuses the training rows, or a set-up that they lack.
    """
    # BLAS threads under the search's own would wait for each other.
    with threadpool_limits(1, user_api="blas"):
        report = progress or _silent
        for observations in (training, held_out):
            require_positions(observations)
        require_known_setups(training, held_out, refit_base=False)
        report(0.0, "calibrating")
        model, _ = calibrate(rig, rig_text, training, seed=seed, prior=prior, executor=executor)
        bare = identify(rig, rig_text, training, seed=seed, prior=prior, effects="none", executor=executor)
        single = single_joint_rows(rig, training)
        warnings = [*model.warnings, *_missing_motion(single)]

        experiment = Experiment.prepare(rig, training, held_out, single, prior)
        front = experiment.front(seed, lambda share: report(0.1 + 0.1 * share, "Pareto front of the weights"))
        if front is None:
            warnings.append("one prism alone was measured: there are no goals to weigh against each other")
        identified: list[Identified] = []
        lines = experiment.data_sets(front)
        for number, (data, rows, weight) in enumerate(lines):
            if not experiment.enough(rows):
                warnings.append(f"Table 3 without {data} data: {int(rows.sum())} different fixes are too few")
                continue

            def searching(share: float, number: int = number, data: str = data) -> None:
                report(0.2 + 0.4 * (number + share) / len(lines), f"the paper's search on {data} data")

            identified += experiment.identify(
                data,
                rows,
                weight,
                seed=seed,
                executor=executor,
                clock=clock,
                settings=settings,
                time_limit_s=time_limit_s,
                progress=searching,
            )
        if not all(line.complete for line in identified):
            warnings.append("the paper's search was stopped at the time limit; its lines are the best until then")

        learning = learning_curve(
            rig,
            rig_text,
            training,
            held_out,
            model,
            seed=seed,
            prior=prior,
            executor=executor,
            draws=draws,
            progress=lambda share: report(0.6 + 0.3 * share, "learning curve"),
        )
        path = trajectory(
            model,
            bare,
            training,
            held_out,
            seed=seed,
            executor=executor,
            progress=lambda share: report(0.9 + 0.1 * share, "trajectory"),
        )
        warnings += _doubts_of_path(path)
        return Protocol(
            rig.name,
            len(training),
            len(held_out),
            _before(model, training, single),
            experiment.held_out_mean_mm(),
            tuple(identified),
            front,
            learning,
            path,
            tuple(warnings),
        )


def _before(model: CalibratedModel, training: Observations, single: Flags) -> tuple[Before, ...]:
    error_mm = np.linalg.norm(training.position_mm - model.nominal_mm(training), axis=1)
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
        return ["the training rows hold no single-joint sweep: its columns and lines are left out"]
    if single.all():
        return [
            "the training rows are all of single-joint sweeps: the columns and lines of multi-joint data are left out"
        ]
    return []


def _doubts_of_path(path: Trajectory) -> list[str]:
    found = []
    if len(path.rows) < POINTS:
        found.append(f"the trajectory has {len(path.rows)} points and not {POINTS}: prism {path.prism!r} has no more")
    if not path.in_time:
        found.append("the held-out rows have no time_s: the trajectory is in the order of its rows")
    return found


def _silent(share: float, what: str) -> None:
    """Progress that nobody watches."""
