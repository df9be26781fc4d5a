"""Selection of the residual learner: the best candidate in cross-validation is kept if it helps significantly.

Every learner is judged by its out-of-fold estimates, for rows on which it was not trained.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.numerics.statistics import paired_test
from calibration.observations import Floats
from calibration.residual.cross_validation import MANY_ROWS, CrossValidation, Data, Shared, best_shape
from calibration.residual.features import Features
from calibration.residual.folds import folds
from calibration.residual.gaussian.process import fit_gaussian_process
from calibration.residual.learners import Chained, Residual, with_out_of_fold_estimate
from calibration.residual.rbf.rbfn import fit_shape
from calibration.residual.rbf.torque_network import TorqueNetwork, fit_torque_network
from calibration.residual.trees.boosting import BoostingSettings, Tuned, fit_boosting

Kind = Literal["default", "none", "rbfn", "lightgbm", "chain", "gp"]
Labels = NDArray[np.str_]

_FOLDS = 5
_FEW_ROWS, _MORE_FOLDS = 600, 10  # below so many rows, more folds predict the error of a learner of all rows better
_LEAST_ROWS = 50
_LEAST_UNITS = 10
_MOST_GAIN = 2.0  # largest extrapolated share of gain in squared error, per share of rows that a fold leaves out
_REACH = 1.5  # ratio of errors; the chain of Zhou et al. 2022 gains a quarter over the better of its parts
_OUT_OF_REACH, _BEHIND = 1.6, 1.02  # ratios of errors on two folds, for few and many rows, beyond which to discard
_MOST_PROGRESS = 0.95


@dataclass(frozen=True)
class Trial:
    """Result of one learner on held-out groups.

    Attributes:
        kind: kind of the learner.
        before_mm: RMS of the 3-D error without it.
        after_mm: RMS of the 3-D error with it.
        p: probability of such a gain by chance (paired one-sided t-test over groups).
        kept: whether the learner passed the test.
    """

    kind: str
    before_mm: float
    after_mm: float
    p: float
    kept: bool


@dataclass(frozen=True)
class Selection:
    """Result of `select_residual`.

    Attributes:
        residual: the learner, fitted to all rows; None if no learner helps.
        trials: results of the learners that were compared.
        reason: one sentence about the decision.
        left_mm: (n, 3) out-of-fold errors of the learner; the targets themselves without a learner.
        split: (n,) fold that held each row out; all zero without a learner.
        variance_mm2: (3,) expected squared error of the learner on new rows, along the axes of the base frame; zeros
            without a learner.
    """

    residual: Residual | None
    trials: tuple[Trial, ...]
    reason: str
    left_mm: Floats
    split: NDArray[np.intp]
    variance_mm2: Floats = field(default_factory=lambda: np.zeros(3))


def select_residual(
    features: Features,
    target_mm: Floats,
    groups: Labels,
    standstills: Labels,
    *,
    kind: Kind,
    seed: int,
    executor: Executor,
    progress: Callable[[float], None],
) -> Selection:
    """Compare the candidates and fit the best one that helps.

    The expected error is the out-of-fold error of the selected learner, the least of up to four on the same rows. It is
    therefore slightly lower than the error on new rows, especially if the learners are about equally good.

    Args:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame.
        groups: (n,) labels; no fold separates rows with the same one.
        standstills: (n,) finer labels (`standstill_labels`), the units of the test if there are too few groups.
        kind: one learner, or `default` for the best.
        seed: seed of folds and learners.
        executor: runs independent work; the selection does not depend on it.
        progress: called with the share of the work that is done.
    """
    if kind == "none":
        return _nothing(target_mm, (), "switched off")
    units = _units(groups, standstills)
    if len(features) < _LEAST_ROWS or len(np.unique(groups)) < 2 or len(np.unique(units)) < _LEAST_UNITS:
        return _nothing(target_mm, (), _left_out(kind, _too_few(groups)))
    data = Data(features, target_mm, groups, units)
    steps = itertools.count(1)
    validation = CrossValidation(
        data, _FOLDS, seed, executor, lambda: progress(_MOST_PROGRESS * (1.0 - 0.9 ** next(steps)))
    )
    estimates: dict[str, tuple[Floats, Tuned | None]] = {}
    trials: dict[str, Trial] = {}
    tuned = None
    for name in ("gp", "rbfn", "lightgbm", "chain") if kind == "default" else (kind,):
        if kind == "default" and name == "chain" and not _may_win(trials):
            continue
        if estimates and (name != "chain" or len(features) >= MANY_ROWS):
            best_mm = min((found for found, _ in estimates.values()), key=lambda found: _squares(target_mm - found))
            probed, probe_mm = validation.probe(name, tuned.settings if tuned else BoostingSettings())
            if _squares(target_mm[probed] - probe_mm) > _reach(name, len(features)) ** 2 * _squares(
                (target_mm - best_mm)[probed]
            ):
                trial = _trial(name, target_mm[probed], probe_mm, units[probed])
                trials[name] = replace(trial, kept=False)
                continue
        estimate_mm, tuned = estimates[name] = validation.estimate(name, tuned.settings if tuned else None)
        trials[name] = _trial(name, target_mm, estimate_mm, units)
    compared = tuple(trials.values())
    best = min((t for t in compared if t.kept), key=lambda t: t.after_mm, default=None)
    if best is None:
        return _nothing(target_mm, compared, _left_out(kind, _no_gain(compared)))
    estimate_mm, tuned = estimates[best.kind]
    if len(features) < _FEW_ROWS:
        validation = CrossValidation(data, _MORE_FOLDS, seed, executor)
        estimate_mm, _ = validation.estimate(best.kind, tuned.settings if tuned else None)
    left_mm = target_mm - estimate_mm
    gain = _gain_of_all_rows(validation, best.kind, left_mm, tuned, executor)
    residual = _fit(best.kind, data, tuned, validation.shared, seed, executor)
    progress(1.0)
    if residual is None:
        return _nothing(target_mm, compared, _left_out(kind, "there is nothing to learn in all rows together"))
    return Selection(
        residual,
        compared,
        f"in cross-validation of the training data {best.kind} lowers the error from {best.before_mm:.3g} to "
        f"{best.after_mm:.3g} mm RMS",
        left_mm,
        validation.split,
        gain * (left_mm**2).mean(axis=0),
    )


def torque_compensation(
    features: Features, target_mm: Floats, groups: Labels, standstills: Labels, names: Sequence[str], *, seed: int
) -> Selection:
    """Fit the second paper's network on the joint torques, and keep it even if it does not help, as the paper does.

    Args:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame.
        groups: (n,) as for `select_residual`.
        standstills: (n,) as for `select_residual`.
        names: columns of the torques among the features.
        seed: seed of the folds.
    """
    units = _units(groups, standstills)
    if len(np.unique(units)) < _LEAST_UNITS:
        return _nothing(target_mm, (), _too_few(groups))
    network, estimate_mm = fit_torque_network(features, target_mm, units, names, seed=seed)
    trial = replace(_trial(TorqueNetwork.kind, target_mm, estimate_mm, units), kept=True)
    left_mm = target_mm - estimate_mm
    return Selection(
        network,
        (trial,),
        f"a part of the method: {len(network.units)} units on the joint torques change the error of rows left "
        f"out from {trial.before_mm:.3g} to {trial.after_mm:.3g} mm RMS",
        left_mm,
        folds(units, _FOLDS, seed),
        (left_mm**2).mean(axis=0),
    )


def _nothing(target_mm: Floats, trials: tuple[Trial, ...], reason: str) -> Selection:
    return Selection(None, trials, reason, target_mm, np.zeros(len(target_mm), dtype=np.intp))


def _squares(error_mm: Floats) -> float:
    return float((error_mm**2).sum())


def _units(groups: Labels, standstills: Labels) -> Labels:
    """Return (n,) labels to test by: groups, or the standstills in them if the groups are too few for a test."""
    return groups if len(np.unique(groups)) >= _LEAST_UNITS else np.char.add(np.char.add(groups, "|"), standstills)


def _left_out(kind: Kind, reason: str) -> str:
    """Return the reason why there is no residual; it names the learner if a specific one was requested."""
    return reason if kind == "default" else f"{kind} was requested and is left out: {reason}"


def _no_gain(compared: Sequence[Trial]) -> str:
    if len(compared) > 1:
        return "in cross-validation of the training data no learner lowers the error beyond chance"
    (only,) = compared
    return (
        f"in cross-validation of the training data the error is {only.before_mm:.3g} mm RMS without it and "
        f"{only.after_mm:.3g} with it, no gain beyond chance (p {only.p:.2g})"
    )


def _too_few(groups: Labels) -> str:
    return f"{len(groups)} fixes in {len(np.unique(groups))} groups are too few to learn a residual from"


def _trial(kind: str, target_mm: Floats, estimate_mm: Floats, units: Labels) -> Trial:
    test = paired_test((target_mm**2).sum(axis=1), ((target_mm - estimate_mm) ** 2).sum(axis=1), units)
    return Trial(kind, test.before_mm, test.after_mm, test.p, test.is_better)


def _may_win(trials: Mapping[str, Trial]) -> bool:
    """Return True if the chain may be the best: its network helps, and its trees are not far behind the best so far.

    To the trees, the estimate of a network that does not help is only noise.
    """
    best = min(trial.after_mm for trial in trials.values())
    return trials["rbfn"].kept and trials["lightgbm"].after_mm < _REACH * best


def _reach(kind: str, rows: int) -> float:
    """Return the largest ratio to the best learner's error, on two folds, at which a learner is tried on all folds.

    With few rows tuning may still gain much, and trying is cheap. The chain, which is the most work, must be ahead.
    """
    if rows < MANY_ROWS:
        return _OUT_OF_REACH
    return 1.0 if kind == "chain" else _BEHIND


def _gain_of_all_rows(
    validation: CrossValidation, kind: str, left_mm: Floats, tuned: Tuned | None, executor: Executor
) -> float:
    """Return the expected squared error of a learner trained on all rows, relative to that of the folds' learners.

    The error is assumed to be linear in 1 / number of rows, and extrapolated from training on half of the rows and on
    all but one fold. With two folds both are the same, so no gain is assumed.
    """
    if validation.count == 2:
        return 1.0
    data = validation.data
    halves = CrossValidation(data, 2, validation.seed, executor, shared=validation.shared)
    half_mm, _ = halves.estimate(kind, tuned.settings if tuned else None)
    with_most, with_half = float((left_mm**2).sum()), float(((data.target_mm - half_mm) ** 2).sum())
    used = 1.0 - 1.0 / validation.count
    gain = (with_half / with_most - 1.0) * (1.0 / used - 1.0) / (2.0 - 1.0 / used)
    return float(np.clip(1.0 - gain, 1.0 - min(0.5, _MOST_GAIN * (1.0 / used - 1.0)), 1.0))


def _fit(kind: str, data: Data, tuned: Tuned | None, shared: Shared, seed: int, executor: Executor) -> Residual | None:
    if kind == "gp":
        return fit_gaussian_process(data.features, data.target_mm, seed, shared.terms)
    if kind == "lightgbm" and tuned is not None:
        return fit_boosting(data.features, data.target_mm, tuned, seed, executor)
    shape = shared.shape or best_shape(data, seed)
    network = fit_shape(data.features, data.target_mm, shape, seed)
    if tuned is None:
        return network
    seen = with_out_of_fold_estimate(data.features, data.target_mm, data.labels, shape, seed)
    return Chained(network, fit_boosting(seen, data.target_mm, tuned, seed, executor))
