"""How much data is enough: held-out error against the number of training poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from calibration.errors import CalibrationError
from calibration.identification.refinement import Prior
from calibration.model import CalibratedModel
from calibration.observations import Observations
from calibration.pipeline import calibrate
from calibration.published.zhou2022.motion import standstills
from calibration.rig import Rig

_LEAST_POSES = 20
_HALVINGS = 4
DRAWS = 4


@dataclass(frozen=True)
class LearningPoint:
    """Held-out error after training on so many poses.

    Attributes:
        poses: how many, drawn at random.
        geometric_mm, hybrid_mm: RMS error of each draw on the held-out rows.
        refused: draws from which the calibration refused to make a model.
    """

    poses: int
    geometric_mm: tuple[float, ...]
    hybrid_mm: tuple[float, ...]
    refused: int

    def as_dict(self) -> dict[str, object]:
        """For JSON; None where every draw was refused."""

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
    seed: int,
    prior: Prior,
    executor: Executor,
    progress: Callable[[float], None],
    draws: int = DRAWS,
) -> tuple[LearningPoint, ...]:
    """Calibrate on halves, quarters, ... of the training poses, drawn at random; fixes of a pose stay together.

    Args:
        rig, rig_text: the rig description and its text.
        training: rows to draw from.
        held_out: rows to judge by, always the same.
        whole: the model of all training rows.
        seed: of the draws and the calibrations.
        prior: as `pipeline.calibrate`.
        executor: runs the searches.
        progress: told the share that is done.
        draws: how many of each size.
    """
    _, pose = np.unique(standstills(training), return_inverse=True)
    poses = int(pose.max()) + 1
    sizes = [size for size in (poses >> k for k in range(_HALVINGS, 0, -1)) if size >= _LEAST_POSES]
    generator = np.random.default_rng([seed, 19])
    points = []
    for number, size in enumerate(sizes):
        found: list[tuple[float, float]] = []
        for draw in range(draws):
            rows = np.isin(pose, generator.permutation(poses)[:size])
            try:
                model, _ = calibrate(
                    rig, rig_text, training.select(rows), seed=seed + draw, prior=prior, executor=executor
                )
                found.append(_held_out(model, held_out))
            except CalibrationError:
                pass
            progress((number * draws + draw + 1) / (len(sizes) * draws))
        points.append(_point(size, found, draws - len(found)))
    return (*points, _point(poses, [_held_out(whole, held_out)], 0))


def _held_out(model: CalibratedModel, held_out: Observations) -> tuple[float, float]:
    """RMS error of stages geometric and hybrid, mm."""

    def rms(position_mm: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
        return math.sqrt(float(((held_out.position_mm - position_mm) ** 2).sum(axis=1).mean()))

    return rms(model.geometric_mm(held_out)), rms(model.predict(held_out).position_mm)


def _point(poses: int, found: Sequence[tuple[float, float]], refused: int) -> LearningPoint:
    return LearningPoint(poses, tuple(g for g, _ in found), tuple(h for _, h in found), refused)
