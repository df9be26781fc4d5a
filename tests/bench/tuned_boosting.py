"""LightGBM alone, tuned by a random search: the single learner that a hybrid has to beat.

Written on LightGBM itself, apart from the residual's own trees, so that their settings do not decide how good the
other side may be.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import lightgbm
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Strings = NDArray[np.str_]

_FOLDS = 5
_ROUNDS = 1000
_PATIENCE = 30


@dataclass(frozen=True)
class TunedBoosting:
    """Trees for x, y and z with the settings that were best on held-out groups."""

    boosters: tuple[Any, ...]

    def predict(self, table: Floats) -> Floats:
        """(n, 3) estimates, mm, of rows of features."""
        return np.column_stack([b.predict(table, num_threads=1) for b in self.boosters])


def tune_boosting(table: Floats, target_mm: Floats, groups: Strings, *, seed: int, trials: int) -> TunedBoosting:
    """Search settings by cross-validation over groups, early stopping included, and fit the best to all rows.

    Args:
        table: (n, features).
        target_mm: (n, 3).
        groups: (n,) labels that no fold separates.
        seed: of settings and folds.
        trials: how many settings.
    """
    rng = np.random.default_rng([seed, 40])
    labels, group = np.unique(groups, return_inverse=True)
    fold = rng.permutation(np.arange(len(labels)) % _FOLDS)[group]
    best: tuple[float, dict[str, Any], list[int]] = (np.inf, {}, [])
    for _ in range(trials):
        settings = _draw(rng, seed)
        found = [_held_out(table, column, fold, settings) for column in target_mm.T]
        error = sum(squared for squared, _ in found)
        if error < best[0]:
            best = (error, settings, [rounds for _, rounds in found])
    _, settings, rounds = best
    columns = zip(target_mm.T, rounds, strict=True)
    return TunedBoosting(
        tuple(lightgbm.train(settings, lightgbm.Dataset(table, label=c), num_boost_round=r) for c, r in columns)
    )


def _draw(rng: np.random.Generator, seed: int) -> dict[str, Any]:
    def scale(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    return {
        "objective": "l2",
        "metric": "l2",
        "learning_rate": scale(0.04, 0.2),
        "num_leaves": int(scale(3, 64)),
        "min_data_in_leaf": int(scale(3, 60)),
        "feature_fraction": float(rng.uniform(0.2, 1.0)),
        "bagging_fraction": float(rng.uniform(0.5, 1.0)),
        "bagging_freq": 1,
        "lambda_l2": scale(0.01, 100.0),
        "extra_trees": bool(rng.random() < 0.3),
        "seed": seed,
        "deterministic": True,
        "force_row_wise": True,
        "num_threads": 1,
        "verbose": -1,
    }


def _held_out(table: Floats, label: Floats, fold: NDArray[np.intp], settings: dict[str, Any]) -> tuple[float, int]:
    """Sum of squared errors on held-out folds, and the number of trees where it is least."""
    data = lightgbm.Dataset(table, label=label, params={"verbose": -1}, free_raw_data=False)
    splits = [(np.flatnonzero(fold != k), np.flatnonzero(fold == k)) for k in range(_FOLDS)]
    curve = np.asarray(
        lightgbm.cv(
            settings,
            data,
            num_boost_round=_ROUNDS,
            folds=splits,
            callbacks=[lightgbm.early_stopping(_PATIENCE, verbose=False)],
        )["valid l2-mean"]
    )
    return float(curve.min()) * len(label), int(curve.argmin()) + 1
