"""Out-of-fold estimates of every learner: what each says of rows that it was not trained on.

They compare the learners, tell how far off predictions are, and make the chain (Zhou et al. 2022), whose trees see the
network's estimate as further features: in training it is the *out-of-fold* estimate, so that the trees never lean on
what the network has memorised.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats
from calibration.residual.boosting import Settings, Tuned, cross_validate
from calibration.residual.features import Features
from calibration.residual.folds import folds
from calibration.residual.gaussian_process import fit_gaussian_process
from calibration.residual.rbfn import Shape, choose_shape, fit_shape

Labels = NDArray[np.str_]

NETWORK_SIGNALS = ("rbfn_x_mm", "rbfn_y_mm", "rbfn_z_mm")
_INNER_FOLDS = 5


@dataclass(frozen=True)
class Data:
    """What a residual is learned from.

    Attributes:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame.
        groups: (n,) labels that no fold separates.
        units: (n,) labels that are no coarser, for splits inside a single group.
    """

    features: Features
    target_mm: Floats
    groups: Labels
    units: Labels

    def __len__(self) -> int:
        return len(self.features)

    def select(self, rows: NDArray[np.bool_]) -> Data:
        """The given rows."""
        return replace(
            self,
            features=self.features.select(rows),
            target_mm=self.target_mm[rows],
            groups=self.groups[rows],
            units=self.units[rows],
        )

    @property
    def labels(self) -> Labels:
        """(n,) labels to split by: groups, or the units of the only one, or the rows of the only unit."""
        for labels in (self.groups, self.units):
            if len(np.unique(labels)) > 1:
                return labels
        return np.arange(len(self)).astype(np.str_)


@dataclass(frozen=True)
class OutOfFold:
    """Estimates of one learner.

    Attributes:
        estimate_mm: (n, 3) from the learner that was trained without the row's fold.
        tuned: settings and number of the trees; None without trees.
    """

    estimate_mm: Floats
    tuned: Tuned | None = None


class CrossValidation:
    """One division into folds, and what the learners make of it.

    Args:
        data: all rows.
        count: number of folds; fewer where there are fewer groups.
        seed: of folds and learners.
        executor: runs what is independent; results do not depend on it.
        advance: told after each piece of work.
    """

    def __init__(
        self, data: Data, count: int, seed: int, executor: Executor, advance: Callable[[], None] = lambda: None
    ) -> None:
        self.data = data
        self.seed = seed
        self.split = folds(data.labels, count, seed)
        self.count = int(self.split.max()) + 1
        self._executor = executor
        self._advance = advance
        self._training = [data.select(self.split != fold) for fold in range(self.count)]
        self._held = [data.features.select(self.split == fold) for fold in range(self.count)]
        self._shapes: list[Shape] = []

    def estimate(self, kind: str, settings: Settings | None = None) -> OutOfFold:
        """Out-of-fold estimates of `rbfn`, `lightgbm`, `chain` or `gp`; without `settings` the trees are tuned."""
        if kind == "gp":
            return OutOfFold(self._process())
        if kind == "lightgbm":
            return self._trees(list(zip([d.features for d in self._training], self._held, strict=True)), settings, None)
        if not self._shapes:
            for shape in self._executor.map(partial(best_shape, seed=self.seed), self._training):
                self._shapes.append(shape)
                self._advance()
        if kind == "rbfn":
            return OutOfFold(self._network())
        work = partial(_chain_features, seed=self.seed)
        parts = []
        for part in self._executor.map(work, self._training, self._held, self._shapes):
            parts.append(part)
            self._advance()
        return self._trees(parts, settings, parts[0][0].names)

    def _network(self) -> Floats:
        out = np.empty_like(self.data.target_mm)
        work = partial(_network_estimate, seed=self.seed)
        estimates = self._executor.map(work, self._training, self._held, self._shapes)
        for fold, estimate in enumerate(estimates):
            out[self.split == fold] = estimate
        return out

    def _process(self) -> Floats:
        out = np.empty_like(self.data.target_mm)
        estimates = self._executor.map(partial(_process_estimate, seed=self.seed), self._training, self._held)
        for fold, estimate in enumerate(estimates):
            out[self.split == fold] = estimate
            self._advance()
        return out

    def _trees(
        self, parts: Sequence[tuple[Features, Features]], settings: Settings | None, names: Sequence[str] | None
    ) -> OutOfFold:
        target, split = self.data.target_mm, self.split
        found = cross_validate(parts, target, split, self.seed, self._executor, settings=settings, names=names)
        self._advance()
        return OutOfFold(*found)


def best_shape(data: Data, seed: int) -> Shape:
    """Hyperparameters of the network by cross-validation inside `data`."""
    return choose_shape(data.features, data.target_mm, data.labels, seed)


def with_network(data: Data, shape: Shape, seed: int) -> Features:
    """The features with the network's out-of-fold estimates beside them."""
    out = np.empty_like(data.target_mm)
    split = folds(data.labels, _INNER_FOLDS, seed + 1)
    for fold in np.unique(split):
        held = split == fold
        network = fit_shape(data.features.select(~held), data.target_mm[~held], shape, seed)
        out[held] = network.predict(data.features.select(held))
    return data.features.with_signals(NETWORK_SIGNALS, out)


def _network_estimate(training: Data, held: Features, shape: Shape, *, seed: int) -> Floats:
    """What a network of the training rows says of the held-out ones."""
    return fit_shape(training.features, training.target_mm, shape, seed).predict(held)


def _process_estimate(training: Data, held: Features, *, seed: int) -> Floats:
    """What a Gaussian process of the training rows says of the held-out ones."""
    process = fit_gaussian_process(training.features, training.target_mm, seed)
    return np.zeros((len(held), 3)) if process is None else process.predict(held)


def _chain_features(training: Data, held: Features, shape: Shape, *, seed: int) -> tuple[Features, Features]:
    """What the chain's trees see of training rows and of held-out rows."""
    network = fit_shape(training.features, training.target_mm, shape, seed)
    return with_network(training, shape, seed), held.with_signals(NETWORK_SIGNALS, network.predict(held))
