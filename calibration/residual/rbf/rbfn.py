"""The radial basis function network that learns the residual: Gaussian units, linear output by ridge regression.

Zhou et al. 2022, Eqs. 12-13. Beyond the paper, each input has a width of its own, units stand at the centres of
k-means in distances of these widths, and the weights' penalty is the norm of the function that they make (that of a
Gaussian process of these units), so that near units do not count twice. There is no constant term: far from
everything that was trained on, the estimate fades to zero.

Joints and prism are what positions depend on; frames' origins say the same in more columns, and held-out errors are
no smaller with them. Signals take part where cross-validation finds them worth it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from calibration.numerics.stored_arrays import read_npz, write_npz
from calibration.observations import Floats
from calibration.residual.features import Features, is_frame_origin
from calibration.residual.folds import folds
from calibration.residual.rbf.relevance import Relevance, gaussian, half_squares, relevance, spread_rows

_FILE = "rbfn.npz"

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
    """Hyperparameters of a network.

    Attributes:
        widths: of the units along each input, in the input's unit; infinite leaves an input out.
        units: how many, at most.
        ridge: of the weights, in the norm of the function that they make.
    """

    widths: tuple[float, ...]
    units: int
    ridge: float


def choose_hyperparameters(
    x: Floats, y: Floats, groups: NDArray[np.str_] | None = None, *, seed: int = 0
) -> tuple[Hyperparameters, float]:
    """Find the hyperparameters with the least held-out error, on at most 2,000 rows.

    Widths are those with the most evidence (`relevance`) times a factor, the ridge is the noise that goes with them
    times another; both factors and the number of units are chosen on folds with widths of their own. The search for
    those starts from the widths of all rows: from scratch it takes half as long again and at times finds a lower hill
    of the evidence. So the rows held out have a small say in the choice; they must not judge what is chosen.

    Args:
        x: (n, d) inputs.
        y: (n, k) outputs, of mean about zero.
        groups: (n,) labels that no fold separates; every row is its own by default.
        seed: of folds, of the rows that widths are found on and of the units' first places.

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
    widths, found = _evident_widths(x, y, spread_rows(labels, _EVIDENCE_ROWS, seed))
    trials = [_Fold(x[some], y[some], labels[some], split == fold, seed, found) for fold in range(split.max() + 1)]
    error: dict[tuple[float, float], float] = {}
    for factor in _WIDTH_FACTORS:
        for trial in trials:
            for ridge, squares in trial.errors(factor, _USUAL_UNITS).items():
                error[factor, ridge] = error.get((factor, ridge), 0.0) + squares
    factor, ridge = min(error, key=lambda factors: error[factors])
    by_units = {
        units: error[factor, ridge]
        if units == _USUAL_UNITS
        else sum(trial.errors(factor, units)[ridge] for trial in trials)
        for units in _UNITS
    }
    enough = (1.0 + _WORTHWHILE) * min(by_units.values())
    units = next(units for units, squares in by_units.items() if squares <= enough)
    chosen = Hyperparameters(tuple((factor * widths).tolist()), units, ridge * found.ridge)
    return chosen, by_units[units] / len(some)


class _Fold:
    """Rows held out, and networks of the others."""

    def __init__(
        self, x: Floats, y: Floats, groups: NDArray[np.str_], held: NDArray[np.bool_], seed: int, whole: Relevance
    ) -> None:
        self._x, self._y, self._held, self._seed = x, y, held, seed
        rows = spread_rows(groups[~held], _FOLD_EVIDENCE_ROWS, seed)
        self._widths, found = _evident_widths(x[~held], y[~held], rows, whole)
        self._ridge = found.ridge

    def errors(self, factor: float, count: int) -> dict[float, float]:
        """Squared error on the rows held out, by ridge factor, for widths times `factor` and `count` units."""
        given = Hyperparameters(tuple((factor * self._widths).tolist()), count, self._ridge)
        centre, scale, units = _placed(self._x[~self._held], given, self._seed)
        activation = gaussian(_scaled(self._x, centre, scale), units)
        inside, unseen, left = activation[~self._held], activation[self._held], self._y[self._held]
        normal = _NormalEquations(inside, self._y[~self._held], gaussian(units, units))
        return {
            ridge: float(((left - unseen @ normal.weights(ridge * self._ridge)) ** 2).sum()) for ridge in _RIDGE_FACTORS
        }


class _NormalEquations:
    """Normal equations of a design (n, m), outputs (n, k) and the penalty (m, m) of the weights."""

    def __init__(self, design: Floats, y: Floats, penalty: Floats) -> None:
        self._square, self._moment, self._penalty = design.T @ design, design.T @ y, penalty

    def weights(self, ridge: float) -> Floats:
        """(m, k)."""
        square = self._square + ridge * self._penalty
        square[np.diag_indices(len(square))] += _JITTER * np.trace(square) / len(square)
        return np.asarray(cho_solve(cho_factor(square, lower=True, overwrite_a=True), self._moment))


def _evident_widths(
    x: Floats, y: Floats, rows: NDArray[np.intp], start: Relevance | None = None
) -> tuple[Floats, Relevance]:
    """(d,) widths in the inputs' units with the most evidence in some rows of (n, d) inputs and (n, k) outputs."""
    centre, spread = _standardisation(x)
    found = relevance(np.nan_to_num((x[rows] - centre) / spread), y[rows], start)
    return found.widths * spread, found


def _placed(x: Floats, hyperparameters: Hyperparameters, seed: int) -> tuple[Floats, Floats, Floats]:
    """Centre and scale of the inputs (n, d), and units among them."""
    centre, scale = _standardisation(x)[0], 1.0 / np.array(hyperparameters.widths)
    return centre, scale, k_means(_scaled(x, centre, scale), hyperparameters.units, seed)


def _scaled(x: Floats, centre: Floats, scale: Floats) -> Floats:
    scaled: Floats = (x - centre) * scale
    scaled[np.isnan(scaled)] = 0.0
    return scaled


def _standardisation(x: Floats) -> tuple[Floats, Floats]:
    """(d,) mean and standard deviation of the finite values of each column; 0 and 1 where there are none."""
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


# -- the learner -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Shape:
    """Names of a network's d inputs and its hyperparameters, as `choose_shape` finds them."""

    names: tuple[str, ...]
    hyperparameters: Hyperparameters


@dataclass(frozen=True)
class Rbfn:
    """A fitted network.

    Attributes:
        names: of the features that are its d inputs.
        centre: (d,) means of the inputs; a missing input (NaN) counts as its mean.
        scale: (d,) one over the widths.
        units: (m, d) in scaled inputs.
        output: (m, 3) weights, mm.
    """

    kind: ClassVar[str] = "rbfn"

    names: tuple[str, ...]
    centre: Floats
    scale: Floats
    units: Floats
    output: Floats

    @cached_property
    def _half_squares(self) -> Floats:
        return half_squares(self.units)

    def predict(self, features: Features) -> Floats:
        """(n, 3) estimate of the residual in the base frame, mm."""
        scaled = _scaled(features.columns(self.names), self.centre, self.scale)
        if len(scaled) <= _BLOCK:
            return self._outputs(scaled)
        return np.concatenate([self._outputs(scaled[k : k + _BLOCK]) for k in range(0, len(scaled), _BLOCK)])

    def _outputs(self, scaled: Floats) -> Floats:
        return gaussian(scaled, self.units, self._half_squares) @ self.output

    def fits(self, features: Features) -> bool:
        """True if its inputs are among these columns."""
        return set(self.names) <= set(features.names)

    def to_files(self) -> dict[str, bytes]:
        """One npz file without pickled objects."""
        parts = {"centre": self.centre, "scale": self.scale, "units": self.units, "output": self.output}
        return {_FILE: write_npz({"names": np.array(self.names, dtype=np.str_), **parts})}

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> Rbfn:
        """Inverse of `to_files`; KeyError or ValueError where parts are missing or do not fit."""
        stored = read_npz(files[_FILE])
        names = tuple(stored["names"].astype(str).tolist())
        # In the order that they were stored in: another one rounds otherwise.
        parts = ("centre", "scale", "units", "output")
        centre, scale, units, output = (np.asarray(stored[k], dtype=np.float64) for k in parts)
        inputs = (len(names),)
        if centre.shape != inputs or scale.shape != inputs or (*units.shape, 3) != (len(output), *inputs, 3):
            raise ValueError("shapes of the network do not fit each other")
        if output.shape[1:] != (3,) or not all(np.isfinite(part).all() for part in (centre, scale, units, output)):
            raise ValueError("the network has weights that are no numbers")
        return cls(names, centre, scale, units, output)


def choose_shape(features: Features, target_mm: Floats, groups: NDArray[np.str_], seed: int) -> Shape:
    """Find the inputs and hyperparameters with the least squared error on held-out groups.

    Args:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame, of mean about zero.
        groups: (n,) labels that no fold separates, at least two.
        seed: of folds and networks.
    """
    places = [name for name in features.names[: features.geometry.shape[1]] if not is_frame_origin(name)]
    signals = features.names[features.geometry.shape[1] :]
    found = []
    for names in dict.fromkeys((tuple(places), (*places, *signals))):
        chosen, error = choose_hyperparameters(features.columns(names), target_mm, groups, seed=seed)
        found.append((error, Shape(names, chosen)))
    return min(found, key=lambda pair: pair[0])[1]


def fit_shape(features: Features, target_mm: Floats, shape: Shape, seed: int) -> Rbfn:
    """Fit with given inputs and hyperparameters; arguments as for `choose_shape`."""
    x = features.columns(shape.names)
    centre, scale, units = _placed(x, shape.hyperparameters, seed)
    normal = _NormalEquations(gaussian(_scaled(x, centre, scale), units), target_mm, gaussian(units, units))
    return Rbfn(shape.names, centre, scale, units, normal.weights(shape.hyperparameters.ridge))
