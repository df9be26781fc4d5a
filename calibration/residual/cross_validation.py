"""Cross-validation of residual learners: estimates for rows by learners that were trained without these rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats
from calibration.residual.features import Features
from calibration.residual.folds import folds
from calibration.residual.gaussian.process import CurveTerms, fit_gaussian_process
from calibration.residual.learners import with_estimate, with_out_of_fold_estimate
from calibration.residual.rbf.rbfn import Shape, choose_shape, fit_shape
from calibration.residual.trees.boosting import BoostingSettings, Tuned, cross_validate

Labels = NDArray[np.str_]
_T = TypeVar("_T")

MANY_ROWS = 1000  # from which on the best hyperparameters hardly depend on the fold left out
_PROBED_FOLDS = 2


@dataclass(frozen=True)
class Data:
    """Rows to learn a residual from.

    Attributes:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame.
        groups: (n,) labels; no fold separates rows with the same one.
        units: (n,) labels of groups or finer, for splits within a single group.
    """

    features: Features
    target_mm: Floats
    groups: Labels
    units: Labels

    def select(self, rows: NDArray[np.bool_]) -> Data:
        """Return rows by mask."""
        return Data(self.features.select(rows), self.target_mm[rows], self.groups[rows], self.units[rows])

    @property
    def labels(self) -> Labels:
        """(n,) labels to split by: groups; units if there is only one group; rows if there is only one unit."""
        for labels in (self.groups, self.units):
            if len(np.unique(labels)) > 1:
                return labels
        return np.arange(len(self.features)).astype(np.str_)


@dataclass(frozen=True)
class Shared:
    """Parts that the learners of all folds share if there are many rows; None for parts that each learner finds itself.

    Attributes:
        shape: shape of the networks.
        terms: initial terms in the search for a Gaussian process.
    """

    shape: Shape | None = None
    terms: CurveTerms | None = None


class CrossValidation:
    """Out-of-fold estimates of the learners for one division into folds.

    The learner of a fold finds its hyperparameters on the rows of the other folds. With many rows these hardly depend
    on the fold, so the result without the first fold is used for all: the shape of networks as it is, and the terms of
    Gaussian processes as a start, from which the evidence of its own rows leaves each fold the terms that it needs.

    Args:
        data: all rows.
        count: number of folds; there are fewer if there are fewer groups.
        seed: seed of folds and learners.
        executor: runs independent work; results do not depend on it.
        advance: called after each piece of work.
        shared: shared parts that are already known for these rows.

    Attributes:
        shared: shared parts known so far.
    """

    def __init__(
        self,
        data: Data,
        count: int,
        seed: int,
        executor: Executor,
        advance: Callable[[], None] = lambda: None,
        shared: Shared | None = None,
    ) -> None:
        self.data = data
        self.seed = seed
        self.split = folds(data.labels, count, seed)
        self.count = int(self.split.max()) + 1
        self._executor = executor
        self._advance = advance
        self._training = [data.select(self.split != fold) for fold in range(self.count)]
        self._held = [data.features.select(self.split == fold) for fold in range(self.count)]
        self.shared = Shared() if shared is None else shared
        self._has_many = len(data.features) >= MANY_ROWS
        self._own_shapes: list[Shape] = []

    def estimate(self, kind: str, settings: BoostingSettings | None = None) -> tuple[Floats, Tuned | None]:
        """Estimate each row by a learner that was trained without its fold.

        Args:
            kind: `rbfn`, `lightgbm`, `chain` or `gp`.
            settings: settings of the trees; tuned if left out.

        Returns:
            (n, 3) estimates, mm; and settings and number of trees, None without trees.
        """
        if kind == "gp":
            return self._joined(self._processes()), None
        if kind == "lightgbm":
            seen = [training.features for training in self._training]
            return self._trees(list(zip(seen, self._held, strict=True)), settings, None)
        shapes = self._shapes(self.count)
        if kind == "rbfn":
            return self._joined(self._map(_network_estimate, self._training, self._held, shapes)), None
        parts = self._map(_chain_features, self._training, self._held, shapes)
        return self._trees(parts, settings, parts[0][0].names)

    def probe(self, kind: str, settings: BoostingSettings) -> tuple[NDArray[np.bool_], Floats]:
        """Estimate the rows of two folds alone, to decide whether a learner is worth the work for all folds.

        Args:
            kind: `rbfn`, `lightgbm` or `chain`.
            settings: settings of the trees.

        Returns:
            (n,) mask of the rows of these folds, and their estimates, mm.
        """
        rows = self.split < _PROBED_FOLDS
        training, held = self._training[:_PROBED_FOLDS], self._held[:_PROBED_FOLDS]
        if kind == "lightgbm":
            parts = [(inside.features, outside) for inside, outside in zip(training, held, strict=True)]
            return rows, self._trees(parts, settings, None)[0][rows]
        shapes = self._shapes(_PROBED_FOLDS)
        if kind == "chain":
            parts = self._map(_chain_features, training, held, shapes)
            return rows, self._trees(parts, settings, parts[0][0].names)[0][rows]
        estimate_mm = np.empty_like(self.data.target_mm)
        for fold, found in enumerate(self._map(_network_estimate, training, held, shapes)):
            estimate_mm[self.split == fold] = found
        return rows, estimate_mm[rows]

    def _shapes(self, count: int) -> list[Shape]:
        """Return the shapes of the networks of the first folds."""
        if self._has_many:
            shape = self.shared.shape or self._map(best_shape, self._training[:1])[0]
            self.shared = replace(self.shared, shape=shape)
            return count * [shape]
        self._own_shapes += self._map(best_shape, self._training[len(self._own_shapes) : count])
        return self._own_shapes[:count]

    def _processes(self) -> list[Floats]:
        """Return estimates of each fold's rows by a Gaussian process."""
        found: list[tuple[Floats, CurveTerms | None]] = []
        if self._has_many and self.shared.terms is None:
            found = self._map(_process_estimate, self._training[:1], self._held[:1])
            self.shared = replace(self.shared, terms=found[0][1])
        rest = slice(len(found), None)
        work = partial(_process_estimate, start=self.shared.terms)
        return [estimate for estimate, _ in [*found, *self._map(work, self._training[rest], self._held[rest])]]

    def _map(self, work: Callable[..., _T], *of_folds: Sequence[object]) -> list[_T]:
        found = []
        for result in self._executor.map(partial(work, seed=self.seed), *of_folds):
            found.append(result)
            self._advance()
        return found

    def _joined(self, estimates: Sequence[Floats]) -> Floats:
        out = np.empty_like(self.data.target_mm)
        for fold, estimate in enumerate(estimates):
            out[self.split == fold] = estimate
        return out

    def _trees(
        self, parts: Sequence[tuple[Features, Features]], settings: BoostingSettings | None, names: Sequence[str] | None
    ) -> tuple[Floats, Tuned]:
        target, split = self.data.target_mm, self.split
        found = cross_validate(parts, target, split, self.seed, self._executor, settings=settings, names=names)
        self._advance()
        return found


def best_shape(data: Data, seed: int) -> Shape:
    """Return the shape of the network that is best for some rows."""
    return choose_shape(data.features, data.target_mm, data.labels, seed)


def _network_estimate(training: Data, held: Features, shape: Shape, *, seed: int) -> Floats:
    return fit_shape(training.features, training.target_mm, shape, seed).predict(held)


def _process_estimate(
    training: Data, held: Features, *, seed: int, start: CurveTerms | None = None
) -> tuple[Floats, CurveTerms | None]:
    """Return estimates of held-out rows and the terms of the process."""
    process = fit_gaussian_process(training.features, training.target_mm, seed, start)
    return (np.zeros((len(held), 3)), None) if process is None else (process.predict(held), process.found)


def _chain_features(training: Data, held: Features, shape: Shape, *, seed: int) -> tuple[Features, Features]:
    """Return features of training and held-out rows with the network's estimates, for the trees of a chain."""
    estimate = _network_estimate(training, held, shape, seed=seed)
    seen = with_out_of_fold_estimate(training.features, training.target_mm, training.labels, shape, seed)
    return seen, with_estimate(held, estimate)
