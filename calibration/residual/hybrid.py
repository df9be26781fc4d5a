"""Which residual learner, if any: candidates compared on held-out groups, kept only beyond chance."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, Protocol

import numpy as np
from scipy import stats

from calibration.observations import Floats
from calibration.residual.boosting import Boosting, fit_boosting
from calibration.residual.crossval import (
    NETWORK_SIGNALS,
    CrossValidation,
    Data,
    Labels,
    OutOfFold,
    best_shape,
    with_network,
)
from calibration.residual.features import Features
from calibration.residual.rbfn import Rbfn, fit_shape
from calibration.residual.torque_network import TorqueNetwork, fit_torque_network

Kind = Literal["default", "none", "rbfn", "lightgbm", "chain"]

_FOLDS = 5
_LEAST_ROWS = 50
_LEAST_UNITS = 10
_CHANCE = 0.01
_WORTHWHILE = 0.01  # relative; a smaller gain is not worth a model's complexity
_ALL_ROWS = (0.5, 1.0)  # limits of what rows that the folds leave out may be hoped to gain
_MOST_PROGRESS = 0.95


class Residual(Protocol):
    """A fitted learner of the residual."""

    @property
    def kind(self) -> str:
        """`rbfn`, `lightgbm`, `chain` or `rbf-tcm`."""

    def predict(self, features: Features) -> Floats:
        """(n, 3) estimate of the residual in the base frame, mm."""

    def fits(self, names: Sequence[str], geometry: int) -> bool:
        """Whether it was trained on columns of these names, the first `geometry` of them geometry."""

    def to_files(self) -> dict[str, bytes]:
        """Everything that is needed to predict again."""


@dataclass(frozen=True)
class Chained:
    """Network, then trees that see its estimate."""

    kind: ClassVar[str] = "chain"

    rbfn: Rbfn
    boosting: Boosting

    def predict(self, features: Features) -> Floats:
        """(n, 3) estimate of the residual in the base frame, mm."""
        return self.boosting.predict(features.with_signals(NETWORK_SIGNALS, self.rbfn.predict(features)))

    def fits(self, names: Sequence[str], geometry: int) -> bool:
        """Whether both parts fit."""
        return self.rbfn.fits(names, geometry) and self.boosting.fits((*names, *NETWORK_SIGNALS), geometry)

    def to_files(self) -> dict[str, bytes]:
        """The files of both."""
        return self.rbfn.to_files() | self.boosting.to_files()

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> Chained:
        """Inverse of `to_files`."""
        return cls(Rbfn.from_files(files), Boosting.from_files(files))


LOADERS: Mapping[str, Callable[[Mapping[str, bytes]], Residual]] = {
    "rbfn": Rbfn.from_files,
    "lightgbm": Boosting.from_files,
    "chain": Chained.from_files,
    TorqueNetwork.kind: TorqueNetwork.from_files,
}


@dataclass(frozen=True)
class Trial:
    """How one learner did on held-out groups.

    Attributes:
        kind: which learner.
        before_mm, after_mm: RMS of the 3-D error without and with it.
        p: probability of such a gain by chance (paired one-sided t-test over groups).
        kept: it passed.
    """

    kind: str
    before_mm: float
    after_mm: float
    p: float
    kept: bool


@dataclass(frozen=True)
class Decision:
    """Result of `decide`.

    Attributes:
        residual: the learner, fitted to all rows; None where none helps.
        trials: what was compared.
        reason: one sentence.
        variance_mm2: (3,) expected squared error of the learner on rows it never saw, along the axes of the base
            frame; zeros without a learner.
    """

    residual: Residual | None
    trials: tuple[Trial, ...]
    reason: str
    variance_mm2: Floats = field(default_factory=lambda: np.zeros(3))


def decide(
    features: Features,
    target_mm: Floats,
    groups: Labels,
    cells: Labels,
    *,
    kind: Kind,
    seed: int,
    executor: Executor,
    progress: Callable[[float], None],
) -> Decision:
    """Compare the candidates and fit the best one that helps.

    Args:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame.
        groups: (n,) labels that no fold separates.
        cells: (n,) finer labels, the units of the test where the groups are too few for one.
        kind: one learner, or `default` for whichever is best.
        seed: of folds and learners.
        executor: runs what is independent; the decision does not depend on it.
        progress: told the share that is done.
    """
    if kind == "none":
        return Decision(None, (), "switched off")
    distinct = len(np.unique(groups))
    units = _units(groups, cells)
    if len(features) < _LEAST_ROWS or distinct < 2 or len(np.unique(units)) < _LEAST_UNITS:
        return Decision(None, (), _too_few(len(features), groups))
    data = Data(features, target_mm, groups, units)
    steps = itertools.count(1)
    validation = CrossValidation(
        data, _FOLDS, seed, executor, lambda: progress(_MOST_PROGRESS * (1.0 - 0.9 ** next(steps)))
    )
    estimates: dict[str, OutOfFold] = {}
    trials: dict[str, Trial] = {}
    for name in ("rbfn", "lightgbm", "chain") if kind == "default" else (kind,):
        if name == "chain" and "rbfn" in trials and not trials["rbfn"].kept:
            continue  # the estimate of a network that does not help is noise to the trees
        estimates[name] = validation.estimate(name)
        trials[name] = _trial(name, target_mm, estimates[name].estimate_mm, units)
    passed = [t for t in trials.values() if t.kept]
    if not passed:
        return Decision(
            None,
            tuple(trials.values()),
            "in cross-validation of the training data no learner lowers the error beyond chance",
        )
    best = min(passed, key=lambda t: t.after_mm)
    halves = CrossValidation(data, 2, seed, executor).estimate(best.kind)
    residual = _fit(best.kind, data, estimates[best.kind].rounds, seed, executor)
    progress(1.0)
    left = ((target_mm - estimates[best.kind].estimate_mm) ** 2).mean(axis=0)
    with_half = ((target_mm - halves.estimate_mm) ** 2).mean(axis=0)
    return Decision(
        residual,
        tuple(trials.values()),
        f"in cross-validation of the training data {best.kind} lowers the error from {best.before_mm:.3g} to "
        f"{best.after_mm:.3g} mm RMS",
        left * _gain_of_all_rows(float(left.sum()), float(with_half.sum())),
    )


def torque_compensation(
    features: Features, target_mm: Floats, groups: Labels, cells: Labels, names: Sequence[str], *, seed: int
) -> Decision:
    """The second paper's network on the joint torques: fitted as the paper has it, and kept whether it helps or not.

    Args:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame.
        groups, cells: as for `decide`.
        names: columns of the torques among the features.
        seed: of the folds.
    """
    units = _units(groups, cells)
    if len(np.unique(units)) < _LEAST_UNITS:
        return Decision(None, (), _too_few(len(features), groups))
    trained = fit_torque_network(features, target_mm, units, names, seed=seed)
    trial = replace(_trial(TorqueNetwork.kind, target_mm, trained.left_out_mm, units), kept=True)
    return Decision(
        trained.network,
        (trial,),
        f"a part of the method: {len(trained.network.units)} units on the joint torques bring the error of rows left "
        f"out from {trial.before_mm:.3g} to {trial.after_mm:.3g} mm RMS",
        ((target_mm - trained.left_out_mm) ** 2).mean(axis=0),
    )


def _units(groups: Labels, cells: Labels) -> Labels:
    """(n,) labels to test by: groups, or the cells in them where the groups are too few for a test."""
    return groups if len(np.unique(groups)) >= _LEAST_UNITS else np.char.add(np.char.add(groups, "|"), cells)


def _too_few(rows: int, groups: Labels) -> str:
    return f"{rows} fixes in {len(np.unique(groups))} groups are too few to learn a residual from"


def _gain_of_all_rows(most: float, half: float) -> float:
    """Held-out squared error of a learner trained on all rows over that of the folds', trained on some.

    Error against one over the number of rows is taken for a straight line through those with half the rows and with
    all but a fold's.
    """
    used = 1.0 - 1.0 / _FOLDS
    gain = (half / most - 1.0) * (1.0 / used - 1.0) / (2.0 - 1.0 / used)
    return float(np.clip(1.0 - gain, *_ALL_ROWS))


def _fit(kind: str, data: Data, rounds: tuple[int, ...], seed: int, executor: Executor) -> Residual:
    if kind == "lightgbm":
        return fit_boosting(data.features, data.target_mm, rounds, seed, executor)
    shape = best_shape(data, seed)
    network = fit_shape(data.features, data.target_mm, shape, seed)
    if kind == "rbfn":
        return network
    return Chained(network, fit_boosting(with_network(data, shape, seed), data.target_mm, rounds, seed, executor))


def _trial(kind: str, target_mm: Floats, estimate: Floats, units: Labels) -> Trial:
    before = (target_mm**2).sum(axis=1)
    after = ((target_mm - estimate) ** 2).sum(axis=1)
    _, index, size = np.unique(units, return_inverse=True, return_counts=True)
    gain = np.bincount(index, before - after) / size
    spread = float(gain.std(ddof=1))
    p = float(stats.t.sf(gain.mean() / (spread / np.sqrt(len(gain))), len(gain) - 1)) if spread > 0.0 else 1.0
    before_mm, after_mm = float(np.sqrt(before.mean())), float(np.sqrt(after.mean()))
    kept = p < _CHANCE and after_mm < (1.0 - _WORTHWHILE) * before_mm
    return Trial(kind, before_mm, after_mm, p, kept)
