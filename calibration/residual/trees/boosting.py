"""Gradient-boosted trees (LightGBM) for the three components of the residual (Zhou et al. 2022, Eqs. 14-17).

Hyperparameters are tuned by grouped cross-validation within a budget of work. The work is counted, not timed, so that
the same data and seed give the same trees on slow and fast machines and with any executor.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.observations import Floats
from calibration.residual.features import Features, column_places, is_frame_origin
from calibration.residual.trees.forest import Forest
from calibration.residual.trees.tree_text import Tree, read_trees

_AXES = "xyz"
_META = "lightgbm.json"
_THREADS = 1  # folds and axes run in parallel instead, which does not change the order of summation

# A lower learning rate helps most but takes longer, so it gets the budget that remains after comparing other settings.
_SCREEN_RATE, _LOWEST_RATE, _HIGHEST_RATE = 0.1, 0.05, 0.1
_SCREEN_FOLDS, _SCREEN_SHARE = 2, 0.4  # fewest folds for screening; its share of the budget
_TYPICAL_ROUNDS = 600  # of three axes while screening, for a first estimate of the work
# In rounds times learning rate:
_STEP = 0.25  # between two evaluations of the held-out rows
_PATIENCE = 2.5  # without a lower held-out error before growing stops
_LONGEST = 100.0  # at most
# Tried one after the other, each compared with the best so far.
_ALTERNATIVES: tuple[Mapping[str, Any], ...] = (
    {"leaves": 8},
    {"bins": 63},
    {"column_share": 0.5},
    {"leaves": 31},
)


@dataclass(frozen=True)
class BoostingSettings:
    """Hyperparameters of the trees.

    Attributes:
        rate: learning rate.
        leaves: number of leaves of a tree.
        bins: number of bins of a column between which splits are made.
        column_share: share of the columns, drawn at random for each tree.
    """

    rate: float = _SCREEN_RATE
    leaves: int = 15
    bins: int = 255
    column_share: float = 1.0

    def parameters(self, rows: int, seed: int) -> dict[str, Any]:
        """Return the parameters under LightGBM's names."""
        return {
            "objective": "l2",
            "metric": "None",
            "boost_from_average": False,
            "learning_rate": self.rate,
            "num_leaves": self.leaves,
            "max_bin": self.bins,
            "min_data_in_leaf": int(np.clip(rows // 100, 5, 20)),
            "feature_fraction": self.column_share,
            "bagging_fraction": 0.8,
            "bagging_freq": 1,
            "lambda_l2": 0.1,  # added to the number of rows in a leaf when its value is computed
            "seed": seed,
            "deterministic": True,
            "force_row_wise": True,
            "num_threads": _THREADS,
            "verbose": -1,
        }

    def work(self, table: Floats) -> float:
        """Return the seconds that a round on these rows takes on one core of a server, for budgets.

        LightGBM builds histograms of the rows in the smaller leaves, and searches for splits among their bins.
        """
        rows, columns = table.shape
        bins = sum(min(float(self.bins), len(np.unique(column)), rows / 3.0) for column in table.T)
        return float(self.column_share * (5e-9 * self.leaves * bins + 1e-9 * rows * columns) + 1e-4)


@dataclass(frozen=True)
class Tuned:
    """Result of cross-validation.

    Attributes:
        names: names of the features that the trees use.
        settings: settings for all axes.
        rounds: number of trees of each axis.
    """

    names: tuple[str, ...]
    settings: BoostingSettings
    rounds: tuple[int, ...]


@dataclass(frozen=True)
class Importance:
    """Share of a feature in the total gain of all splits of the three axes."""

    feature: str
    share: float


@dataclass(frozen=True)
class Boosting:
    """Fitted trees of the three axes.

    Attributes:
        names: names of the features, in the order of the columns.
        texts: LightGBM's model texts for x, y, z.
    """

    kind: ClassVar[str] = "lightgbm"

    names: tuple[str, ...]
    texts: tuple[bytes, ...]
    _trees: tuple[tuple[Tree, ...], ...] = field(init=False, repr=False, compare=False)
    _forest: Forest = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        trees = tuple(read_trees(text, len(self.names)) for text in self.texts)
        object.__setattr__(self, "_trees", trees)
        object.__setattr__(self, "_forest", Forest.build(trees))

    def predict(self, features: Features) -> Floats:
        """Return the (n, 3) estimate of the residual in the base frame, mm; ValueError if a feature is missing."""
        return self._forest.predict(features.table(), column_places(features.names, self.names))

    def fits(self, features: Features) -> bool:
        """Return True if it was trained on exactly these columns, with or without the frames' origins."""
        return self.names in (features.names, tree_columns(features.names))

    @property
    def importance(self) -> tuple[Importance, ...]:
        """Features by the gain of their splits, the most important first (Zhou et al. 2022, Fig. 10)."""
        gain = np.zeros(len(self.names))
        for tree in (tree for trees in self._trees for tree in trees):
            np.add.at(gain, tree.feature, tree.gain)
        total = float(gain.sum()) or 1.0
        order = np.argsort(-gain, kind="stable")
        return tuple(Importance(self.names[i], float(gain[i]) / total) for i in order.tolist())

    def to_files(self) -> dict[str, bytes]:
        """Return one LightGBM text file per axis and a file with the names of the features."""
        files = {f"lightgbm_{axis}.txt": text for axis, text in zip(_AXES, self.texts, strict=True)}
        return files | {_META: json.dumps({"features": self.names}, indent=1).encode()}

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> Boosting:
        """Restore from `to_files` without LightGBM; raise ValueError for a damaged file."""
        names = tuple(str(name) for name in json.loads(files[_META])["features"])
        return cls(names, tuple(files[f"lightgbm_{axis}.txt"] for axis in _AXES))


def import_lightgbm() -> Any:
    """Import lightgbm only when needed, because importing takes a second and its wheel lacks libgomp.

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
    """Return the names of the features that trees use by default: all but the frames' origins.

    Joints and prism contain the same information in fewer columns. With the origins, growing takes twice as long, and
    held-out errors were 2 to 3 % larger on measured poses of a UR10 and within 1 % on simulated booms.
    """
    return tuple(name for name in names if not is_frame_origin(name))


def fit_boosting(features: Features, target_mm: Floats, tuned: Tuned, seed: int, executor: Executor) -> Boosting:
    """Grow the trees.

    Args:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame.
        tuned: result of `cross_validate`.
        seed: seed of the rows and columns that are drawn for a tree.
        executor: runs the axes.
    """
    grow = partial(_grow, features.columns(tuned.names), tuned.settings, seed)
    return Boosting(tuned.names, tuple(executor.map(grow, target_mm.T, tuned.rounds)))


def cross_validate(
    parts: Sequence[tuple[Features, Features]],
    target_mm: Floats,
    split: NDArray[np.intp],
    seed: int,
    executor: Executor,
    *,
    settings: BoostingSettings | None = None,
    names: Sequence[str] | None = None,
) -> tuple[Floats, Tuned]:
    """Compute out-of-fold estimates, with the settings and number of trees that have the least error.

    The number of trees is chosen on all held-out rows together, so no training rows are lost for that. The estimate of
    a fold uses the number that is best for the other folds, so that its rows do not choose what they are to judge.
    (They do end its growing, but long after its best.) For the choice of settings see `_tune`.

    Args:
        parts: features of the training rows and of the held-out rows, by fold.
        target_mm: (n, 3) residuals in the base frame.
        split: (n,) fold that holds each row out.
        seed: seed of the rows and columns that are drawn for a tree.
        executor: runs folds and axes.
        settings: settings to use; tuned if left out.
        names: names of the features that trees may use; `tree_columns` if left out.

    Returns:
        (n, 3) estimates, mm; and the names, settings and numbers of trees.
    """
    seen = tree_columns(parts[0][0].names) if names is None else tuple(names)
    folds = [
        _Fold(inside.columns(seen), target_mm[split != fold], outside.columns(seen), target_mm[split == fold])
        for fold, (inside, outside) in enumerate(parts)
    ]
    if settings is None:
        settings = _tune(folds, seed, executor)
    found, rounds = _grow_folds(folds, settings, seed, executor)
    estimate = np.empty_like(target_mm)
    for fold, estimate_of_fold in enumerate(found):
        estimate[split == fold] = estimate_of_fold
    return estimate, Tuned(seen, settings, rounds)


@dataclass(frozen=True)
class _Fold:
    """Table and (., 3) targets of a fold's training rows and of its held-out rows."""

    inside: Floats
    inside_mm: Floats
    outside: Floats
    outside_mm: Floats


@dataclass(frozen=True)
class _Curve:
    """History of a fold's estimate of one axis: estimates (looks, rows) and their summed squared errors (looks,)."""

    looks: Floats
    squares: Floats

    def look(self, number: int) -> Floats:
        """Return the estimates at a look; after its end a fold keeps its last ones."""
        estimate: Floats = self.looks[min(number, len(self.looks) - 1)]
        return estimate


def _best_look(curves: Sequence[_Curve]) -> int:
    """Return the number of the look at which the total error of all folds is least."""
    longest = max(len(curve.squares) for curve in curves)
    total = sum(np.pad(curve.squares, (0, longest - len(curve.squares)), mode="edge") for curve in curves)
    return int(np.argmin(total))


def _tune(folds: Sequence[_Fold], seed: int, executor: Executor) -> BoostingSettings:
    """Compare settings with a part of the budget; the rest of it determines the learning rate.

    Settings are compared on the rows that later judge the learner. This choice among a few makes the learner look
    slightly better than it is, but nested folds would multiply the work.

    A setting replaces the best so far if it gains more than a standard error (Breiman et al. 1984, section 3.4.3).
    """
    table = folds[0].inside
    budget = _budget(table.size)
    best, left = BoostingSettings(), _SCREEN_SHARE * budget
    for_each = left / (1 + len(_ALTERNATIVES)) / (_TYPICAL_ROUNDS * best.work(table))
    screen = folds[: max(_SCREEN_FOLDS, int(for_each))]
    squares, rounds = _screen(screen, best, seed, executor)
    left -= rounds * best.work(table) * len(screen)
    for alternative in _ALTERNATIVES:
        other = replace(best, **alternative)
        if rounds * other.work(table) * len(screen) > left:
            continue
        others, needed = _screen(screen, other, seed, executor)
        left -= needed * other.work(table) * len(screen)
        gain = squares - others
        if gain.mean() > gain.std() / np.sqrt(len(gain)):
            best, squares, rounds = other, others, needed
    work = rounds * best.work(table) * (len(folds) + 1)
    rate = _SCREEN_RATE * work / ((1.0 - _SCREEN_SHARE) * budget)
    return replace(best, rate=float(np.clip(rate, _LOWEST_RATE, _HIGHEST_RATE)))


def _budget(values: int) -> float:
    """Return the budget in seconds of one core, as counted by `BoostingSettings.work`, for `values` table values."""
    return 6.0 + 2.3e-5 * values


def _screen(folds: Sequence[_Fold], settings: BoostingSettings, seed: int, executor: Executor) -> tuple[Floats, int]:
    """Return the squared error of each held-out row and the total rounds of the three axes, from `_grow_folds`."""
    estimates, rounds = _grow_folds(folds, settings, seed, executor)
    squares = [((fold.outside_mm - found) ** 2).sum(axis=1) for fold, found in zip(folds, estimates, strict=True)]
    return np.concatenate(squares), sum(rounds)


def _grow_folds(
    folds: Sequence[_Fold], settings: BoostingSettings, seed: int, executor: Executor
) -> tuple[list[Floats], tuple[int, ...]]:
    """Return estimates (rows, 3) of held-out rows at the other folds' best round, and the best round of each axis."""
    tasks = [(fold, axis) for axis in range(3) for fold in folds]
    grown = list(executor.map(partial(_grow_fold, settings, seed), *zip(*tasks, strict=True)))
    of_axis = [grown[axis * len(folds) : (axis + 1) * len(folds)] for axis in range(3)]
    estimates = [
        np.column_stack([curves[own].look(_best_look(curves[:own] + curves[own + 1 :])) for curves in of_axis])
        for own in range(len(folds))
    ]
    return estimates, tuple((_best_look(curves) + 1) * _step(settings.rate) for curves in of_axis)


def _step(rate: float) -> int:
    return max(1, round(_STEP / rate))


def _grow_fold(settings: BoostingSettings, seed: int, fold: _Fold, axis: int) -> _Curve:
    """Grow trees on a fold's training rows until its held-out error no longer decreases."""
    lightgbm = import_lightgbm()
    parameters = settings.parameters(len(fold.inside), seed)
    train = lightgbm.Dataset(fold.inside, label=fold.inside_mm[:, axis], params=parameters)
    booster = lightgbm.Booster(parameters, train)
    booster.add_valid(train.create_valid(fold.outside, label=fold.outside_mm[:, axis], params=parameters), "held out")
    looks: list[Floats] = []
    squares: list[float] = []

    def look(estimate: Floats, _: object) -> tuple[str, float, bool]:
        looks.append(estimate.copy())
        squares.append(float(((estimate - fold.outside_mm[:, axis]) ** 2).sum()))
        return "squares", squares[-1], False

    step = _step(settings.rate)
    for _ in range(round(_LONGEST / settings.rate / step)):
        for _ in range(step):
            booster.update()
        booster.eval_valid(look)
        since = len(squares) - 1 - int(np.argmin(squares))
        if since * step * settings.rate >= _PATIENCE:
            break
    return _Curve(np.array(looks), np.array(squares))


def _grow(table: Floats, settings: BoostingSettings, seed: int, label: Floats, rounds: int) -> bytes:
    lightgbm = import_lightgbm()
    parameters = settings.parameters(len(table), seed)
    booster = lightgbm.train(parameters, lightgbm.Dataset(table, label=label), num_boost_round=rounds)
    return str(booster.model_to_string()).encode()
