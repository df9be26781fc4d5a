"""Held-out errors as a function of the number of training poses, and along a path of the tip (the paper's Fig. 12)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.identification.refinement import Prior
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Floats, Observations
from calibration.pipeline.calibrate import calibrate, train_residual
from calibration.residual.selection import Kind
from calibration.rig.description import Rig
from calibration.run_settings import Run

Integers = NDArray[np.intp]

_LEAST_POSES = 20
_HALVINGS = 4
DRAWS = 4

POINTS = 200
PAPER = {"rbfn": (41.5, 33.5), "lightgbm": (41.0, 28.5), "chain": (30.5, 17.4)}  # mean and std over 200 points, mm
LEARNERS: tuple[Kind, ...] = tuple(kind for kind in get_args(Kind) if kind in PAPER)


@dataclass(frozen=True)
class LearningPoint:
    """Held-out error after training on a number of poses.

    Attributes:
        poses: number of poses, drawn at random.
        geometric_mm, hybrid_mm: RMS error of each draw on the held-out rows.
        refused: number of draws for which the calibration failed with an error.
    """

    poses: int
    geometric_mm: tuple[float, ...]
    hybrid_mm: tuple[float, ...]
    refused: int

    def as_dict(self) -> dict[str, object]:
        """Return a JSON object of the attributes; errors are None if every draw was refused."""

        def summary(values: Sequence[float]) -> dict[str, float | None]:
            if not values:
                return dict.fromkeys(("median", "low", "high"))
            return {"median": float(np.median(values)), "low": min(values), "high": max(values)}

        return {
            "poses": self.poses,
            "draws": len(self.hybrid_mm),
            "refused": self.refused,
            "geometric_rms_mm": summary(self.geometric_mm),
            "hybrid_rms_mm": summary(self.hybrid_mm),
        }


def learning_curve(
    rig: Rig,
    rig_text: str,
    training: Observations,
    held_out: Observations,
    whole: CalibratedModel,
    *,
    prior: Prior,
    run: Run,
    draws: int = DRAWS,
) -> tuple[LearningPoint, ...]:
    """Calibrate on halves, quarters, ... of the training poses, drawn at random; fixes of a pose stay together.

    Args:
        rig: the rig description.
        rig_text: the TOML that it was read from.
        training: rows to draw from.
        held_out: rows to evaluate on, the same for all draws.
        whole: the model of all training rows.
        prior: as for `calibrate`.
        run: seed of the draws and the calibrations, workers and progress.
        draws: number of draws of each size.
    """
    _, pose = np.unique(standstills(training), return_inverse=True)
    poses = int(pose.max()) + 1
    sizes = [size for size in (poses >> k for k in range(_HALVINGS, 0, -1)) if size >= _LEAST_POSES]
    generator = np.random.default_rng([run.seed, 19])
    points = []
    for number, size in enumerate(sizes):
        found: list[tuple[float, float]] = []
        for draw in range(draws):
            rows = np.isin(pose, generator.permutation(poses)[:size])
            try:
                own = run.quiet(run.seed + draw)
                model, _ = calibrate(rig, rig_text, training.select(rows), prior=prior, run=own)
                found.append(_held_out(model, held_out))
            except CalibrationError:
                pass
            run.progress((number * draws + draw + 1) / (len(sizes) * draws), "learning curve")
        points.append(_point(size, found, draws - len(found)))
    return (*points, _point(poses, [_held_out(whole, held_out)], 0))


def _held_out(model: CalibratedModel, held_out: Observations) -> tuple[float, float]:
    """Return the RMS errors of the stages geometric and hybrid, mm."""

    def rms(position_mm: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
        return math.sqrt(float(((held_out.position_mm - position_mm) ** 2).sum(axis=1).mean()))

    return rms(Predictor.of(model).geometric_mm(held_out)), rms(Predictor.of(model).predict(held_out).position_mm)


def _point(poses: int, found: Sequence[tuple[float, float]], refused: int) -> LearningPoint:
    return LearningPoint(poses, tuple(g for g, _ in found), tuple(h for _, h in found), refused)


@dataclass(frozen=True)
class Trajectory:
    """Errors along the first held-out fixes of one prism, in the order of time.

    Attributes:
        prism: the prism whose path it is.
        rows: (m,) indices of rows of the held-out data.
        in_time: False if the data have no times; the rows then keep their own order.
        error_mm: stage or learner -> (m,) size of the error.
        left_out: learner -> the reason why it was left out; its errors are then those of the kinematics.
    """

    prism: str
    rows: Integers
    in_time: bool
    error_mm: Mapping[str, Floats]
    left_out: Mapping[str, str]

    def as_dict(self) -> dict[str, object]:
        """Return a JSON object of the trajectory's errors."""
        return {
            "prism": self.prism,
            "points": len(self.rows),
            "in_order_of_time": self.in_time,
            "errors": {
                name: {"mean_mm": float(error.mean()), "std_mm": float(error.std()), "error_mm": error.tolist()}
                for name, error in self.error_mm.items()
            },
            "left_out": dict(self.left_out),
        }


def tip_path(rig: Rig, held_out: Observations, distance_mm: Floats) -> tuple[str, Integers, bool]:
    """Return the tip's prism, the indices of its first 200 rows, and whether they are ordered by time.

    The tip is, of the prisms at the last measured frame, the one farthest from the base on average.

    Args:
        rig: the rig description.
        held_out: n rows.
        distance_mm: (n,) distance of each row from the base.
    """
    measured = np.unique(held_out.prism).tolist()
    last = max(rig.prism(name).frame for name in measured)
    tips = [name for name in measured if rig.prism(name).frame == last]
    tip = max(tips, key=lambda name: float(distance_mm[held_out.prism == name].mean()))
    rows = np.flatnonzero(held_out.prism == tip)
    time_s = held_out.extra.get("time_s", np.full(len(held_out), np.nan))[rows]
    in_time = bool(np.isfinite(time_s).all())
    if in_time:
        rows = rows[np.argsort(time_s, kind="stable")]
    return tip, rows[:POINTS], in_time


def trajectory(
    model: CalibratedModel,
    bare: CalibratedModel,
    training: Observations,
    held_out: Observations,
    run: Run,
) -> Trajectory:
    """Compute the errors along the tip's path.

    Args:
        model: model with effects and residual, as `calibrate` returns it.
        bare: the same kinematics without effects or residual; each of the paper's learners is trained on it.
        training: rows that both models were fitted to.
        held_out: rows of the same set-ups.
        run: seed of the learners, workers and progress.
    """
    from_base = [model.chain.base(model.values, setup).translation_mm for setup in range(len(model.chain.setups))]
    origin = np.array(from_base)[model.chain.bind(held_out).setup]
    distance_mm = np.linalg.norm(held_out.position_mm - origin, axis=1)
    tip, rows, in_time = tip_path(model.rig, held_out, np.asarray(distance_mm))
    path = held_out.select(rows)

    def size(position_mm: Floats) -> Floats:
        return np.asarray(np.linalg.norm(path.position_mm - position_mm, axis=1))

    errors = {
        "before": size(Predictor.of(model).nominal_mm(path)),
        "geometric": size(Predictor.of(bare).geometric_mm(path)),
    }
    left_out: dict[str, str] = {}
    for number, kind in enumerate(LEARNERS):
        learned = train_residual(bare, training, kind=kind, run=run.quiet())
        if learned.residual is None:
            left_out[kind] = learned.residual_reason
        errors[kind] = size(Predictor.of(learned).predict(path).position_mm)
        run.progress((number + 1) / len(LEARNERS), "trajectory")
    errors["hybrid"] = size(Predictor.of(model).predict(path).position_mm)
    return Trajectory(tip, rows, in_time, errors, left_out)


def standstills(observations: Observations) -> Integers:
    """Return (n,) the standstill number of every row: equal for rows of one session, set-up and pose.

    A row without a pose is a standstill of its own.
    """
    seen: dict[tuple[str, str, str], int] = {}
    numbers = np.empty(len(observations), dtype=np.intp)
    labels = zip(observations.session.tolist(), observations.setup.tolist(), observations.pose.tolist(), strict=True)
    for row, label in enumerate(labels):
        numbers[row] = seen.setdefault(label, row) if label[2] else row
    return numbers
