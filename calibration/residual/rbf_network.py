"""A radial basis function network on arrays: Gaussian units with a width per input, linear output by ridge regression.

Zhou et al. 2022, Eqs. 12-13. Beyond the paper, each input has a width of its own, units stand at the centres of
k-means in distances of these widths, and the weights' penalty is the norm of the function that they make (that of a
Gaussian process of these units), so that near units do not count twice. There is no constant term: far from
everything that was trained on, the estimate fades to zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from calibration.observations import Floats
from calibration.residual.folds import folds
from calibration.residual.relevance import Relevance, gaussian, half_squares, relevance, spread_rows

_UNITS = (60, 250, 400)
_USUAL_UNITS = 250
_WORTHWHILE = 0.03  # share of the held-out squared error that further units must save
_WIDTH_FACTORS = (0.7, 1.0, 1.4)  # on the widths that have the most evidence
_RIDGE_FACTORS = (0.3, 1.0, 3.0, 10.0)
_FOLDS = 3
_TUNING_ROWS = 2000
_FOLD_EVIDENCE_ROWS, _EVIDENCE_ROWS = 300, 500
_LLOYD_ROUNDS = 8
_CONSTANT = 1e-9  # relative
_JITTER = 1e-9  # of the mean diagonal of the normal equations
_BLOCK = 256  # rows whose activations stay in the processor's cache


@dataclass(frozen=True)
class Hyperparameters:
    """Hyperparameters.

    Attributes:
        widths: of the units along each input, in the input's unit; infinite leaves an input out.
        units: how many, at most.
        ridge: of the weights, in the norm of the function that they make.
    """

    widths: tuple[float, ...]
    units: int
    ridge: float


class RbfNetwork:
    """A network of d inputs and k outputs, used as scikit-learn's estimators are.

    A missing input (NaN) counts as the mean of its column.

    Args:
        hyperparameters: None lets `fit` choose them by grouped cross-validation.
        seed: of folds, of the rows that widths are found on and of the units' first places.
    """

    def __init__(self, hyperparameters: Hyperparameters | None = None, *, seed: int = 0) -> None:
        self.hyperparameters = hyperparameters
        self.seed = seed

    def fit(self, x: Floats, y: Floats, groups: NDArray[np.str_] | None = None) -> Self:
        """Fit to n rows.

        Args:
            x: (n, d) inputs.
            y: (n, k) outputs, of mean about zero.
            groups: (n,) labels that no fold separates; every row is its own by default.

        Raises:
            ValueError: none given and fewer than two groups.
        """
        given = self.hyperparameters or choose_hyperparameters(x, y, groups, seed=self.seed)[0]
        self._place(x, given)
        design = gaussian(self._scaled(x), self.units_)
        self.output_ = _Normal(design, y, gaussian(self.units_, self.units_)).weights(given.ridge)
        return self

    @classmethod
    def of(cls, centre: Floats, scale: Floats, units: Floats, output: Floats) -> Self:
        """A network with fitted parts: (d,) means, (d,) one over widths, (m, d) scaled units, (m, k) weights."""
        network = cls()
        network.centre_, network.scale_, network.output_ = centre, scale, output
        network._stand(units)
        return network

    def predict(self, x: Floats) -> Floats:
        """(n, k) outputs for (n, d) inputs."""
        scaled = self._scaled(x)
        if len(scaled) <= _BLOCK:
            return self._outputs(scaled)
        out = np.empty((len(scaled), self.output_.shape[1]))
        for begin in range(0, len(scaled), _BLOCK):
            rows = slice(begin, begin + _BLOCK)
            out[rows] = self._outputs(scaled[rows])
        return out

    def _outputs(self, scaled: Floats) -> Floats:
        return gaussian(scaled, self.units_, self._half_squares) @ self.output_

    def _place(self, x: Floats, hyperparameters: Hyperparameters) -> None:
        """Scale the inputs and stand the units among them."""
        self.centre_, _ = standardisation(x)
        self.scale_ = 1.0 / np.array(hyperparameters.widths)
        self._stand(k_means(self._scaled(x), hyperparameters.units, self.seed))

    def _stand(self, units: Floats) -> None:
        self.units_, self._half_squares = units, half_squares(units)

    def _scaled(self, x: Floats) -> Floats:
        scaled: Floats = (x - self.centre_) * self.scale_
        scaled[np.isnan(scaled)] = 0.0
        return scaled


def choose_hyperparameters(
    x: Floats, y: Floats, groups: NDArray[np.str_] | None = None, *, seed: int = 0
) -> tuple[Hyperparameters, float]:
    """The hyperparameters with the least held-out error, found on at most 2,000 rows.

    Widths are those with the most evidence (`relevance`) times a factor, the ridge is the noise that goes with them
    times another; both factors and the number of units are chosen on folds with widths of their own. The search for
    those starts from the widths of all rows: from scratch it takes half as long again and at times finds a lower hill
    of the evidence. So the rows held out have a small say in the choice; they must not judge what is chosen.

    Args:
        x, y, groups, seed: as for `RbfNetwork`.

    Returns:
        The hyperparameters; their mean squared error on rows held out, summed over the outputs.

    Raises:
        ValueError: fewer than two groups.
    """
    labels = np.arange(len(x)).astype(np.str_) if groups is None else groups
    some = spread_rows(labels, _TUNING_ROWS, seed)
    split = folds(labels[some], _FOLDS, seed)
    if split.max() == 0:
        raise ValueError("the rows are all of one group, which leaves none to choose hyperparameters by")
    whole = _Widths.evident(x, y, spread_rows(labels, _EVIDENCE_ROWS, seed))
    trials = [_Fold(x[some], y[some], labels[some], split == fold, seed, whole) for fold in range(split.max() + 1)]
    error: dict[tuple[float, float], float] = {}
    for width in _WIDTH_FACTORS:
        for trial in trials:
            for ridge, squares in trial.errors(width, _USUAL_UNITS).items():
                error[width, ridge] = error.get((width, ridge), 0.0) + squares
    width, ridge = min(error, key=lambda factors: error[factors])
    by_units = {
        units: error[width, ridge]
        if units == _USUAL_UNITS
        else sum(trial.errors(width, units)[ridge] for trial in trials)
        for units in _UNITS
    }
    enough = (1.0 + _WORTHWHILE) * min(by_units.values())
    units = next(units for units, squares in by_units.items() if squares <= enough)
    chosen = Hyperparameters(tuple((width * whole.widths).tolist()), units, ridge * whole.ridge)
    return chosen, by_units[units] / len(some)


@dataclass(frozen=True)
class _Widths:
    """Widths in the inputs' units, and what they were found as."""

    widths: Floats
    relevance: Relevance

    @property
    def ridge(self) -> float:
        return self.relevance.noise / self.relevance.signal

    @classmethod
    def evident(cls, x: Floats, y: Floats, rows: NDArray[np.intp], start: Relevance | None = None) -> Self:
        """With the most evidence in these rows of (n, d) inputs and (n, k) outputs."""
        centre, spread = standardisation(x)
        found = relevance(np.nan_to_num((x[rows] - centre) / spread), y[rows], start)
        return cls(found.widths * spread, found)


class _Fold(RbfNetwork):
    """Rows held out, and a network of the others."""

    def __init__(
        self, x: Floats, y: Floats, groups: NDArray[np.str_], held: NDArray[np.bool_], seed: int, whole: _Widths
    ) -> None:
        super().__init__(seed=seed)
        self._x, self._y, self._held = x, y, held
        rows = spread_rows(groups[~held], _FOLD_EVIDENCE_ROWS, seed)
        found = _Widths.evident(x[~held], y[~held], rows, whole.relevance)
        self._widths, self._noise = found.widths, found.ridge

    def errors(self, factor: float, units: int) -> dict[float, float]:
        """Ridge factor -> squared error on the rows held out, for widths times `factor` and so many units."""
        self._place(self._x[~self._held], Hyperparameters(tuple((factor * self._widths).tolist()), units, self._noise))
        activation = gaussian(self._scaled(self._x), self.units_)
        inside, unseen, left = activation[~self._held], activation[self._held], self._y[self._held]
        normal = _Normal(inside, self._y[~self._held], gaussian(self.units_, self.units_))
        return {
            ridge: float(((left - unseen @ normal.weights(ridge * self._noise)) ** 2).sum()) for ridge in _RIDGE_FACTORS
        }


class _Normal:
    """Normal equations of a design (n, m), outputs (n, k) and the penalty (m, m) of the weights."""

    def __init__(self, design: Floats, y: Floats, penalty: Floats) -> None:
        self._square, self._moment, self._penalty = design.T @ design, design.T @ y, penalty

    def weights(self, ridge: float) -> Floats:
        """(m, k)."""
        square = self._square + ridge * self._penalty
        square[np.diag_indices(len(square))] += _JITTER * np.trace(square) / len(square)
        return np.asarray(cho_solve(cho_factor(square, lower=True, overwrite_a=True), self._moment))


def standardisation(x: Floats) -> tuple[Floats, Floats]:
    """(d,) mean and standard deviation of what is there of each column; 0 and 1 where nothing is."""
    known = np.isfinite(x)
    count = np.maximum(known.sum(axis=0), 1)
    centre = np.where(known, x, 0.0).sum(axis=0) / count
    spread = np.sqrt((np.where(known, x - centre, 0.0) ** 2).sum(axis=0) / count)
    constant = spread <= _CONSTANT * np.maximum(1.0, np.abs(centre))
    return centre, np.where(constant, 1.0, spread)


def k_means(rows: Floats, count: int, seed: int) -> Floats:
    """(m, d) centres of the rows by k-means; the rows themselves where they are not more than `count`."""
    if len(rows) <= count:
        return rows
    centres = rows[np.sort(np.random.default_rng(seed).permutation(len(rows))[:count])]
    for _ in range(_LLOYD_ROUNDS):
        nearest = (rows @ centres.T - 0.5 * (centres**2).sum(axis=1)).argmax(axis=1)
        members = np.bincount(nearest, minlength=count)
        total = np.column_stack([np.bincount(nearest, column, count) for column in rows.T])
        centres = np.where(members[:, None] > 0, total / np.maximum(members, 1)[:, None], centres)
    return centres
