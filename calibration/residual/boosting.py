"""Gradient-boosted trees (LightGBM) for the three components of the residual (Zhou et al. 2022, Eqs. 14-17)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.observations import Floats
from calibration.residual.features import Features, is_frame_origin

_ROUNDS = 1000
_PATIENCE = 25
_THREADS = 1  # axes run side by side instead, which does not change a sum
_AXES = "xyz"
_META = "lightgbm.json"


@dataclass(frozen=True)
class Boosting:
    """Three fitted boosters.

    Attributes:
        names: of the features it uses, in order.
        boosters: one each for x, y, z.
    """

    kind: ClassVar[str] = "lightgbm"

    names: tuple[str, ...]
    boosters: tuple[Any, ...]

    def predict(self, features: Features) -> Floats:
        """(n, 3) estimate of the residual in the base frame, mm."""
        table = features.columns(self.names)
        return np.column_stack([b.predict(table, num_threads=_THREADS) for b in self.boosters])

    def fits(self, names: Sequence[str], geometry: int) -> bool:
        """Whether it was trained on just these columns."""
        return self.names == tree_columns(names) and geometry <= len(names)

    def to_files(self) -> dict[str, bytes]:
        """One LightGBM text file an axis and the names of the features."""
        files = {
            f"lightgbm_{axis}.txt": b.model_to_string().encode() for axis, b in zip(_AXES, self.boosters, strict=True)
        }
        return files | {_META: json.dumps({"features": self.names}, indent=1).encode()}

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> Boosting:
        """Inverse of `to_files`. The caller has checked the files' integrity: LightGBM dies of a truncated one."""
        names = tuple(str(name) for name in json.loads(files[_META])["features"])
        lightgbm = import_lightgbm()
        try:
            boosters = tuple(lightgbm.Booster(model_str=files[f"lightgbm_{axis}.txt"].decode()) for axis in _AXES)
        except lightgbm.basic.LightGBMError as error:
            raise ValueError(f"LightGBM refuses its text: {error}") from error
        if any(b.num_feature() != len(names) for b in boosters):
            raise ValueError("the trees have another number of features than the list of names")
        return cls(names, boosters)


def import_lightgbm() -> Any:
    """Import lightgbm when it is needed: it costs a second, and its wheel lacks libgomp.

    Raises:
        CalibrationError: libgomp1 is missing.
    """
    try:
        import lightgbm
    except OSError as error:
        if "libgomp" not in str(error):
            raise
        raise CalibrationError(
            "LightGBM needs the system library libgomp; install it with `apt-get install libgomp1`, "
            "or use --residual none or rbfn"
        ) from error
    return lightgbm


def tree_columns(names: Sequence[str]) -> tuple[str, ...]:
    """The features that trees split on: all but the frames' origins.

    Joints and prism say the same in fewer columns; with the frames growing takes four times as long and held-out
    errors are no smaller.
    """
    return tuple(name for name in names if not is_frame_origin(name))


def fit_boosting(
    features: Features, target_mm: Floats, rounds: Sequence[int], seed: int, executor: Executor
) -> Boosting:
    """Grow the trees.

    Args:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame.
        rounds: number of trees of each axis, as `cross_validate` finds it.
        seed: of rows and columns that a tree sees.
        executor: runs the axes.
    """
    names = tree_columns(features.names)
    table = features.columns(names)
    boosters = executor.map(partial(_grow, table, seed), target_mm.T, rounds)
    return Boosting(names, tuple(boosters))


def cross_validate(
    parts: Sequence[tuple[Features, Features]],
    target_mm: Floats,
    split: NDArray[np.intp],
    seed: int,
    executor: Executor,
) -> tuple[Floats, tuple[int, ...]]:
    """Out-of-fold estimates, and the number of trees where their error is least.

    One number of trees for all folds, found on all held-out rows together, costs the training rows nothing.

    Args:
        parts: fold -> features of its training rows and of its held-out rows.
        target_mm: (n, 3) residuals in the base frame.
        split: (n,) fold that holds each row out.
        seed: of rows and columns that a tree sees.
        executor: runs the axes.

    Returns:
        (n, 3) estimates, mm; number of trees of each axis.
    """
    names = tree_columns(parts[0][0].names)
    tables = [(inside.columns(names), outside.columns(names)) for inside, outside in parts]
    found = list(executor.map(partial(_cross_validate_axis, tables, split, seed), target_mm.T))
    return np.column_stack([estimate for estimate, _ in found]), tuple(rounds for _, rounds in found)


def _grow(table: Floats, seed: int, label: Floats, rounds: int) -> Any:
    lightgbm = import_lightgbm()
    parameters = _parameters(len(table), seed)
    return lightgbm.train(parameters, lightgbm.Dataset(table, label=label), num_boost_round=rounds)


def _cross_validate_axis(
    tables: Sequence[tuple[Floats, Floats]], split: NDArray[np.intp], seed: int, label: Floats
) -> tuple[Floats, int]:
    """Grow the folds side by side until their pooled error has not fallen for a while."""
    lightgbm = import_lightgbm()
    growing = []
    for fold, (inside, outside) in enumerate(tables):
        parameters = _parameters(len(inside), seed)
        train = lightgbm.Dataset(inside, label=label[split != fold], params=parameters)
        booster = lightgbm.Booster(parameters, train)
        booster.add_valid(train.create_valid(outside, label=label[split == fold]), "held out")
        growing.append(booster)
    least, best = np.inf, 1
    for round_ in range(1, _ROUNDS + 1):
        error = 0.0
        for booster, (_, outside) in zip(growing, tables, strict=True):
            booster.update()
            error += len(outside) * booster.eval_valid()[0][2]
        if error < least:
            least, best = error, round_
        elif round_ - best >= _PATIENCE:
            break
    estimate = np.empty(len(label))
    for fold, (booster, (_, outside)) in enumerate(zip(growing, tables, strict=True)):
        estimate[split == fold] = booster.predict(outside, num_iteration=best, num_threads=_THREADS)
    return estimate, best


def _parameters(rows: int, seed: int) -> dict[str, Any]:
    return {
        "objective": "l2",
        "metric": "l2",
        "boost_from_average": False,
        "learning_rate": 0.1,
        "num_leaves": 15,
        "min_data_in_leaf": int(np.clip(rows // 100, 5, 20)),
        "feature_fraction": 0.7,
        "bagging_fraction": 0.8,
        "bagging_freq": 1,
        "lambda_l2": 1.0,
        "seed": seed,
        "deterministic": True,
        "force_row_wise": True,
        "num_threads": _THREADS,
        "verbose": -1,
    }
