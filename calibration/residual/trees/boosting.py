"""Gradient-boosted trees (LightGBM) for the three components of the residual (Zhou et al. 2022, Eqs. 14-17).

Hyperparameters are tuned by grouped cross-validation within a budget of work. The work is counted, not timed: the same
data and seed give the same trees on a slow machine as on a fast one, and whatever runs them.
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
_THREADS = 1  # folds and axes run side by side instead, which does not change a sum

# A lower learning rate is worth more than anything else here, and takes longer: it gets what comparing leaves over.
_SCREEN_RATE, _LOWEST_RATE, _HIGHEST_RATE = 0.1, 0.05, 0.1
_SCREEN_FOLDS, _SCREEN_SHARE = 2, 0.4  # fewest folds for it; its share of the budget
_TYPICAL_ROUNDS = 600  # of three axes while screening, for a first guess of the work
_STEP = 0.25  # from one look at the held-out rows to the next, in rounds times learning rate
_PATIENCE = 2.5  # without a lower held-out error, in the same
_LONGEST = 100.0  # in the same
# Tried one after the other, each against the best so far.
_ALTERNATIVES: tuple[Mapping[str, Any], ...] = (
    {"leaves": 8},
    {"bins": 63},
    {"column_share": 0.5},
    {"leaves": 31},
)


@dataclass(frozen=True)
class Settings:
    """Settings of the growth of trees.

    Attributes:
        rate: learning rate.
        leaves: of a tree.
        bins: distinct values of a column that splits tell apart.
        column_share: of the columns, drawn at random for each tree.
    """

    rate: float = _SCREEN_RATE
    leaves: int = 15
    bins: int = 255
    column_share: float = 1.0

    def parameters(self, rows: int, seed: int) -> dict[str, Any]:
        """Parameters as LightGBM names them."""
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
        """Seconds that a round on these rows takes on one core of a server, for budgets.

        Splits are searched among the bins of a leaf's columns, into which the rows of the smaller leaves are counted.
        """
        rows, columns = table.shape
        bins = sum(min(float(self.bins), len(np.unique(column)), rows / 3.0) for column in table.T)
        return float(self.column_share * (5e-9 * self.leaves * bins + 1e-9 * rows * columns) + 1e-4)


@dataclass(frozen=True)
class Tuned:
    """Result of cross-validation.

    Attributes:
        names: of the features that the trees see.
        settings: for all axes.
        rounds: number of trees of each axis.
    """

    names: tuple[str, ...]
    settings: Settings
    rounds: tuple[int, ...]


@dataclass(frozen=True)
class Importance:
    """Share of a feature in the gain of all splits, over the three axes."""

    feature: str
    share: float


@dataclass(frozen=True)
class Boosting:
    """Fitted trees of the three axes.

    Attributes:
        names: of the features it uses, in order.
        texts: LightGBM's text of x, y, z.
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
        """(n, 3) estimate of the residual in the base frame, mm; ValueError where a feature is not there."""
        return self._forest.predict(features.table(), column_places(features.names, self.names))

    def fits(self, features: Features) -> bool:
        """True if it was trained on just these columns, with or without the frames' origins."""
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
        """One LightGBM text file an axis and the names of the features."""
        files = {f"lightgbm_{axis}.txt": text for axis, text in zip(_AXES, self.texts, strict=True)}
        return files | {_META: json.dumps({"features": self.names}, indent=1).encode()}

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> Boosting:
        """Inverse of `to_files`; needs no LightGBM. ValueError for a damaged file."""
        names = tuple(str(name) for name in json.loads(files[_META])["features"])
        return cls(names, tuple(files[f"lightgbm_{axis}.txt"] for axis in _AXES))


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
    """Names of the features that trees see unless told otherwise: all but the frames' origins.

    Joints and prism say the same in fewer columns. With the origins growing takes twice as long; held-out errors were
    2 to 3 % larger on measured poses of a UR10 and within 1 % on simulated booms.
    """
    return tuple(name for name in names if not is_frame_origin(name))


def fit_boosting(features: Features, target_mm: Floats, tuned: Tuned, seed: int, executor: Executor) -> Boosting:
    """Grow the trees.

    Args:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame.
        tuned: as `cross_validate` finds it.
        seed: of rows and columns that a tree sees.
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
    settings: Settings | None = None,
    names: Sequence[str] | None = None,
) -> tuple[Floats, Tuned]:
    """Find out-of-fold estimates, and the settings and number of trees where their error is least.

    The number of trees is found on all held-out rows together, which costs the training rows nothing. A fold's own
    estimate has the number that is best for the other folds: its rows do not choose what they judge. (They end its
    growing, long after its best.) Settings are chosen on the rows that judge them: see `_tune`.

    Args:
        parts: fold -> features of its training rows and of its held-out rows.
        target_mm: (n, 3) residuals in the base frame.
        split: (n,) fold that holds each row out.
        seed: of rows and columns that a tree sees.
        executor: runs folds and axes.
        settings: to be used; tuned if left out.
        names: of the features that trees may see; `tree_columns` if left out.

    Returns:
        (n, 3) estimates, mm; what was found.
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
    """Course of a fold's estimate of one axis: estimates (looks, rows) and their summed squared errors (looks,)."""

    looks: Floats
    squares: Floats

    def look(self, number: int) -> Floats:
        """Estimates at a look; a fold that has ended stays as it was."""
        estimate: Floats = self.looks[min(number, len(self.looks) - 1)]
        return estimate


def _best_look(curves: Sequence[_Curve]) -> int:
    """Number of the look at which the error of all folds together is least."""
    longest = max(len(curve.squares) for curve in curves)
    total = sum(np.pad(curve.squares, (0, longest - len(curve.squares)), mode="edge") for curve in curves)
    return int(np.argmin(total))


def _tune(folds: Sequence[_Fold], seed: int, executor: Executor) -> Settings:
    """Compare settings with a part of the budget; the learning rate is what the rest pays for.

    They are compared on the rows that judge the learner later, a choice among a few which flatters it a little; folds
    within folds would multiply the work.

    Others are taken where they gain more than a standard error (the rule of Breiman et al. 1984, section 3.4.3).
    """
    table = folds[0].inside
    budget = _budget(table.size)
    best, left = Settings(), _SCREEN_SHARE * budget
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
    """Seconds of one core, as `Settings.work` counts them, for a table of so many values."""
    return 6.0 + 2.3e-5 * values


def _screen(folds: Sequence[_Fold], settings: Settings, seed: int, executor: Executor) -> tuple[Floats, int]:
    """Squared error of each held-out row, and the rounds of the three axes together, as `_grow_folds` has them."""
    estimates, rounds = _grow_folds(folds, settings, seed, executor)
    squares = [((fold.outside_mm - found) ** 2).sum(axis=1) for fold, found in zip(folds, estimates, strict=True)]
    return np.concatenate(squares), sum(rounds)


def _grow_folds(
    folds: Sequence[_Fold], settings: Settings, seed: int, executor: Executor
) -> tuple[list[Floats], tuple[int, ...]]:
    """Estimates (rows, 3) of each fold's held-out rows at the other folds' best round; the best of all, by axis."""
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


def _grow_fold(settings: Settings, seed: int, fold: _Fold, axis: int) -> _Curve:
    """Grow trees on a fold's training rows until its held-out error has not fallen for a while."""
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


def _grow(table: Floats, settings: Settings, seed: int, label: Floats, rounds: int) -> bytes:
    lightgbm = import_lightgbm()
    parameters = settings.parameters(len(table), seed)
    booster = lightgbm.train(parameters, lightgbm.Dataset(table, label=label), num_boost_round=rounds)
    return str(booster.model_to_string()).encode()
