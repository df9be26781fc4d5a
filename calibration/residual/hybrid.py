"""Which residual learner, if any: candidates compared on held-out groups, kept only beyond chance."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats
from calibration.paired_test import paired_test
from calibration.residual.boosting import Boosting, Importance, Tuned, fit_boosting
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
from calibration.residual.folds import folds
from calibration.residual.gaussian_process import GaussianProcess, fit_gaussian_process
from calibration.residual.rbfn import Rbfn, fit_shape
from calibration.residual.torque_network import TorqueNetwork, fit_torque_network

Kind = Literal["default", "none", "rbfn", "lightgbm", "chain", "gp"]

_FOLDS = 5
_LEAST_ROWS = 50
_LEAST_UNITS = 10
_ALL_ROWS = (0.5, 1.0)  # limits of what rows that the folds leave out may be hoped to gain
_REACH = 1.5  # in error; the chain of Zhou et al. 2022 gains a quarter on the better of its parts
_MOST_PROGRESS = 0.95


class Residual(Protocol):
    """A fitted learner of the residual."""

    @property
    def kind(self) -> str:
        """`rbfn`, `lightgbm`, `chain`, `gp` or `rbf-tcm`."""

    def predict(self, features: Features) -> Floats:
        """(n, 3) estimate of the residual in the base frame, mm."""

    def fits(self, features: Features) -> bool:
        """Whether it was trained on the columns that these features have."""

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

    def fits(self, features: Features) -> bool:
        """Whether both parts fit."""
        estimates = np.empty((len(features), len(NETWORK_SIGNALS)))
        return self.rbfn.fits(features) and self.boosting.fits(features.with_signals(NETWORK_SIGNALS, estimates))

    def to_files(self) -> dict[str, bytes]:
        """The files of both."""
        return self.rbfn.to_files() | self.boosting.to_files()

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> Chained:
        """Inverse of `to_files`."""
        return cls(Rbfn.from_files(files), Boosting.from_files(files))


def tree_importance(residual: Residual | None) -> tuple[Importance, ...] | None:
    """Features of the learner's trees, the most important first; None without trees."""
    if isinstance(residual, Chained):
        return residual.boosting.importance
    return residual.importance if isinstance(residual, Boosting) else None


LOADERS: Mapping[str, Callable[[Mapping[str, bytes]], Residual]] = {
    "rbfn": Rbfn.from_files,
    "lightgbm": Boosting.from_files,
    "chain": Chained.from_files,
    "gp": GaussianProcess.from_files,
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
        left_mm: (n, 3) errors of rows that the learner was trained without; the targets themselves without a learner.
        split: (n,) fold that held each row out; all zero without a learner.
    """

    residual: Residual | None
    trials: tuple[Trial, ...]
    reason: str
    left_mm: Floats
    split: NDArray[np.intp]
    variance_mm2: Floats = field(default_factory=lambda: np.zeros(3))


def decide(
    features: Features,
    target_mm: Floats,
    groups: Labels,
    standstills: Labels,
    *,
    kind: Kind,
    seed: int,
    executor: Executor,
    progress: Callable[[float], None],
) -> Decision:
    """Compare the candidates and fit the best one that helps.

    The expected error is the winner's own out-of-fold error, the least of up to four on the same rows: a little less
    than new rows will show, most so where the learners are about as good as each other.

    Args:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame.
        groups: (n,) labels that no fold separates.
        standstills: (n,) finer labels (`standstill_labels`), the units of the test where the groups are too few for
            one.
        kind: one learner, or `default` for whichever is best.
        seed: of folds and learners.
        executor: runs what is independent; the decision does not depend on it.
        progress: told the share that is done.
    """
    if kind == "none":
        return _nothing(target_mm, (), "switched off")
    distinct = len(np.unique(groups))
    units = _units(groups, standstills)
    if len(features) < _LEAST_ROWS or distinct < 2 or len(np.unique(units)) < _LEAST_UNITS:
        return _nothing(target_mm, (), _too_few(len(features), groups))
    data = Data(features, target_mm, groups, units)
    steps = itertools.count(1)
    validation = CrossValidation(
        data, _FOLDS, seed, executor, lambda: progress(_MOST_PROGRESS * (1.0 - 0.9 ** next(steps)))
    )
    estimates: dict[str, OutOfFold] = {}
    trials: dict[str, Trial] = {}
    settings = None
    for name in ("gp", "rbfn", "lightgbm", "chain") if kind == "default" else (kind,):
        if kind == "default" and name == "chain" and not _may_win(trials):
            continue
        estimates[name] = found = validation.estimate(name, settings)
        trials[name] = _trial(name, target_mm, found.estimate_mm, units)
        settings = found.tuned.settings if found.tuned else None
    passed = [t for t in trials.values() if t.kept]
    if not passed:
        return _nothing(
            target_mm,
            tuple(trials.values()),
            "in cross-validation of the training data no learner lowers the error beyond chance",
        )
    best = min(passed, key=lambda t: t.after_mm)
    found = estimates[best.kind]
    gain = _gain_of_all_rows(validation, best.kind, found, executor)
    residual = _fit(best.kind, data, found.tuned, seed, executor)
    progress(1.0)
    if residual is None:
        return _nothing(target_mm, tuple(trials.values()), "all rows together show nothing to learn")
    left_mm = target_mm - found.estimate_mm
    return Decision(
        residual,
        tuple(trials.values()),
        f"in cross-validation of the training data {best.kind} lowers the error from {best.before_mm:.3g} to "
        f"{best.after_mm:.3g} mm RMS",
        left_mm,
        validation.split,
        gain * (left_mm**2).mean(axis=0),
    )


def torque_compensation(
    features: Features, target_mm: Floats, groups: Labels, standstills: Labels, names: Sequence[str], *, seed: int
) -> Decision:
    """The second paper's network on the joint torques: fitted as the paper has it, and kept whether it helps or not.

    Args:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame.
        groups, standstills: as for `decide`.
        names: columns of the torques among the features.
        seed: of the folds.
    """
    units = _units(groups, standstills)
    if len(np.unique(units)) < _LEAST_UNITS:
        return _nothing(target_mm, (), _too_few(len(features), groups))
    trained = fit_torque_network(features, target_mm, units, names, seed=seed)
    trial = replace(_trial(TorqueNetwork.kind, target_mm, trained.left_out_mm, units), kept=True)
    return Decision(
        trained.network,
        (trial,),
        f"a part of the method: {len(trained.network.units)} units on the joint torques bring the error of rows left "
        f"out from {trial.before_mm:.3g} to {trial.after_mm:.3g} mm RMS",
        target_mm - trained.left_out_mm,
        folds(units, _FOLDS, seed),
        ((target_mm - trained.left_out_mm) ** 2).mean(axis=0),
    )


def _may_win(trials: Mapping[str, Trial]) -> bool:
    """Whether the chain may be the best: its parts help, and are not out of reach of the best so far.

    The estimate of a network that does not help is noise to the trees.
    """
    best = min(trial.after_mm for trial in trials.values())
    return trials["rbfn"].kept and trials["lightgbm"].after_mm < _REACH * best


def _nothing(target_mm: Floats, trials: tuple[Trial, ...], reason: str) -> Decision:
    """No learner."""
    return Decision(None, trials, reason, target_mm, np.zeros(len(target_mm), dtype=np.intp))


def _units(groups: Labels, standstills: Labels) -> Labels:
    """(n,) labels to test by: groups, or the standstills in them where the groups are too few for a test."""
    return groups if len(np.unique(groups)) >= _LEAST_UNITS else np.char.add(np.char.add(groups, "|"), standstills)


def _too_few(rows: int, groups: Labels) -> str:
    return f"{rows} fixes in {len(np.unique(groups))} groups are too few to learn a residual from"


def _gain_of_all_rows(validation: CrossValidation, kind: str, found: OutOfFold, executor: Executor) -> float:
    """Held-out squared error of a learner trained on all rows over that of the folds', trained on some.

    Error against one over the number of rows is taken for a straight line through those with half the rows and with
    all but a fold's. Two folds have no more than half, and nothing is hoped for.
    """
    if validation.count == 2:
        return 1.0
    data = validation.data
    halves = CrossValidation(data, 2, validation.seed, executor)
    half = halves.estimate(kind, found.tuned.settings if found.tuned else None)
    with_most, with_half = (float(((data.target_mm - e.estimate_mm) ** 2).sum()) for e in (found, half))
    used = 1.0 - 1.0 / validation.count
    gain = (with_half / with_most - 1.0) * (1.0 / used - 1.0) / (2.0 - 1.0 / used)
    return float(np.clip(1.0 - gain, *_ALL_ROWS))


def _fit(kind: str, data: Data, tuned: Tuned | None, seed: int, executor: Executor) -> Residual | None:
    if kind == "gp":
        return fit_gaussian_process(data.features, data.target_mm, seed)
    if kind == "lightgbm" and tuned is not None:
        return fit_boosting(data.features, data.target_mm, tuned, seed, executor)
    shape = best_shape(data, seed)
    network = fit_shape(data.features, data.target_mm, shape, seed)
    if tuned is None:
        return network
    return Chained(network, fit_boosting(with_network(data, shape, seed), data.target_mm, tuned, seed, executor))


def _trial(kind: str, target_mm: Floats, estimate: Floats, units: Labels) -> Trial:
    test = paired_test((target_mm**2).sum(axis=1), ((target_mm - estimate) ** 2).sum(axis=1), units)
    return Trial(kind, test.before_mm, test.after_mm, test.p, test.is_better)
