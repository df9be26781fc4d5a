"""Radial basis function network for the residual: Gaussian units, linear output by ridge regression.

Zhou et al. 2022, Eqs. 12-13. In addition to the paper, each input has its own width, units are placed by k-means with
distances in these widths, and the penalty on the weights is the norm of the resulting function (as of a Gaussian
process with these units), so that neighbouring units do not count twice. There is no constant term: far from all
training rows the estimate fades to zero.

Positions depend on joints and prism. The frames' origins contain the same information in more columns, and do not lower
held-out errors. Signals are used if they lower the error in cross-validation.
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
_WORTHWHILE = 0.03  # share of the held-out squared error that more units must save
_WIDTH_FACTORS = (0.7, 1.0, 1.4)  # on the widths with the highest evidence
_RIDGE_FACTORS = (0.3, 1.0, 3.0, 10.0)
_FOLDS = 3
_TUNING_ROWS = 2000
_FOLD_EVIDENCE_ROWS, _EVIDENCE_ROWS = 300, 500
_LLOYD_ROUNDS = 8
_CONSTANT = 1e-9  # relative
_JITTER = 1e-9  # of the mean diagonal of the normal equations
_BLOCK = 256  # rows whose activations fit in the processor's cache


@dataclass(frozen=True)
class Hyperparameters:
    """Hyperparameters of a network.

    Attributes:
        widths: widths of the units along each input, in the input's unit; an infinite width excludes an input.
        units: greatest number of units.
        ridge: factor on the weights' penalty, the norm of the resulting function.
    """

    widths: tuple[float, ...]
    units: int
    ridge: float


def choose_hyperparameters(
    x: Floats, y: Floats, groups: NDArray[np.str_] | None = None, *, seed: int = 0
) -> tuple[Hyperparameters, float]:
    """Find the hyperparameters with the least held-out error, on at most 2,000 rows.

    Widths are those with the highest evidence (`relevance`) times a factor. The ridge is the corresponding noise times
    another factor. Both factors and the number of units are chosen on folds, each with its own widths. The search for
    these starts from the widths of all rows: without that start it takes half as long again and sometimes ends in a
    lower maximum of the evidence. The held-out rows thus influence the choice slightly, so they must not be used to
    judge the result.

    Args:
        x: (n, d) inputs.
        y: (n, k) outputs, with a mean of about zero.
        groups: (n,) labels; no fold separates rows with the same one. By default every row has its own.
        seed: seed of folds, of the rows on which widths are estimated and of the initial units.

    Returns:
        The hyperparameters, and their mean squared error on held-out rows, summed over the outputs.

    Raises:
        ValueError: there are fewer than two groups.
    """
    labels = np.arange(len(x)).astype(np.str_) if groups is None else groups
    some = spread_rows(labels, _TUNING_ROWS, seed)
    split = folds(labels[some], _FOLDS, seed)
    if split.max() == 0:
        raise ValueError("all rows are in one group, so there are no held-out rows to choose hyperparameters")
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
    """Held-out rows, and networks trained on the other rows."""

    def __init__(
        self, x: Floats, y: Floats, groups: NDArray[np.str_], held: NDArray[np.bool_], seed: int, whole: Relevance
    ) -> None:
        self._x, self._y, self._held, self._seed = x, y, held, seed
        rows = spread_rows(groups[~held], _FOLD_EVIDENCE_ROWS, seed)
        self._widths, found = _evident_widths(x[~held], y[~held], rows, whole)
        self._ridge = found.ridge

    def errors(self, factor: float, count: int) -> dict[float, float]:
        """Return the squared error on held-out rows, by ridge factor, for widths times `factor` and `count` units."""
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
        """Return the weights (m, k)."""
        square = self._square + ridge * self._penalty
        square[np.diag_indices(len(square))] += _JITTER * np.trace(square) / len(square)
        return np.asarray(cho_solve(cho_factor(square, lower=True, overwrite_a=True), self._moment))


def _evident_widths(
    x: Floats, y: Floats, rows: NDArray[np.intp], start: Relevance | None = None
) -> tuple[Floats, Relevance]:
    """Return (d,) widths in the inputs' units with the highest evidence in `rows` of inputs (n, d), outputs (n, k)."""
    centre, spread = _standardisation(x)
    found = relevance(np.nan_to_num((x[rows] - centre) / spread), y[rows], start)
    return found.widths * spread, found


def _placed(x: Floats, hyperparameters: Hyperparameters, seed: int) -> tuple[Floats, Floats, Floats]:
    """Return centre and scale of the inputs (n, d), and the units in scaled inputs."""
    centre, scale = _standardisation(x)[0], 1.0 / np.array(hyperparameters.widths)
    return centre, scale, k_means(_scaled(x, centre, scale), hyperparameters.units, seed)


def _scaled(x: Floats, centre: Floats, scale: Floats) -> Floats:
    scaled: Floats = (x - centre) * scale
    scaled[np.isnan(scaled)] = 0.0
    return scaled


def _standardisation(x: Floats) -> tuple[Floats, Floats]:
    """Return (d,) mean and standard deviation of the finite values of each column; 0 and 1 if there are none."""
    known = np.isfinite(x)
    count = np.maximum(known.sum(axis=0), 1)
    centre = np.where(known, x, 0.0).sum(axis=0) / count
    spread = np.sqrt((np.where(known, x - centre, 0.0) ** 2).sum(axis=0) / count)
    constant = spread <= _CONSTANT * np.maximum(1.0, np.abs(centre))
    return centre, np.where(constant, 1.0, spread)


def k_means(rows: Floats, count: int, seed: int) -> Floats:
    """Return (m, d) centres of rows by k-means; the rows themselves if there are at most `count`.

    Args:
        rows: (n, d) points.
        count: number of centres.
        seed: seed of the initial centres.
    """
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
    """Names of a network's d inputs and its hyperparameters, as chosen by `choose_shape`."""

    names: tuple[str, ...]
    hyperparameters: Hyperparameters


@dataclass(frozen=True)
class Rbfn:
    """A fitted network.

    Attributes:
        names: names of the features that are its d inputs.
        centre: (d,) means of the inputs; a missing input (NaN) counts as its mean.
        scale: (d,) 1 / width.
        units: (m, d) units in scaled inputs.
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
        """Return the (n, 3) estimate of the residual in the base frame, mm."""
        scaled = _scaled(features.columns(self.names), self.centre, self.scale)
        if len(scaled) <= _BLOCK:
            return self._outputs(scaled)
        return np.concatenate([self._outputs(scaled[k : k + _BLOCK]) for k in range(0, len(scaled), _BLOCK)])

    def _outputs(self, scaled: Floats) -> Floats:
        return gaussian(scaled, self.units, self._half_squares) @ self.output

    def fits(self, features: Features) -> bool:
        """Return True if its inputs are among these columns."""
        return set(self.names) <= set(features.names)

    def to_files(self) -> dict[str, bytes]:
        """Return one npz file without pickled objects."""
        parts = {"centre": self.centre, "scale": self.scale, "units": self.units, "output": self.output}
        return {_FILE: write_npz({"names": np.array(self.names, dtype=np.str_), **parts})}

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> Rbfn:
        """Restore from `to_files`; KeyError or ValueError if parts are missing or do not match."""
        stored = read_npz(files[_FILE])
        names = tuple(stored["names"].astype(str).tolist())
        # Keep the stored memory order, as a different order changes rounding.
        parts = ("centre", "scale", "units", "output")
        centre, scale, units, output = (np.asarray(stored[k], dtype=np.float64) for k in parts)
        inputs = (len(names),)
        if centre.shape != inputs or scale.shape != inputs or (*units.shape, 3) != (len(output), *inputs, 3):
            raise ValueError("the shapes of the network's arrays do not match")
        if output.shape[1:] != (3,) or not all(np.isfinite(part).all() for part in (centre, scale, units, output)):
            raise ValueError("the network has weights that are not finite")
        return cls(names, centre, scale, units, output)


def choose_shape(features: Features, target_mm: Floats, groups: NDArray[np.str_], seed: int) -> Shape:
    """Find the inputs and hyperparameters with the least squared error on held-out groups.

    Args:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame, with a mean of about zero.
        groups: (n,) labels, at least two; no fold separates rows with the same one.
        seed: seed of folds and networks.
    """
    places = [name for name in features.names[: features.geometry.shape[1]] if not is_frame_origin(name)]
    signals = features.names[features.geometry.shape[1] :]
    found = []
    for names in dict.fromkeys((tuple(places), (*places, *signals))):
        chosen, error = choose_hyperparameters(features.columns(names), target_mm, groups, seed=seed)
        found.append((error, Shape(names, chosen)))
    return min(found, key=lambda pair: pair[0])[1]


def fit_shape(features: Features, target_mm: Floats, shape: Shape, seed: int) -> Rbfn:
    """Fit a network with given inputs and hyperparameters; arguments as for `choose_shape`."""
    x = features.columns(shape.names)
    centre, scale, units = _placed(x, shape.hyperparameters, seed)
    normal = _NormalEquations(gaussian(_scaled(x, centre, scale), units), target_mm, gaussian(units, units))
    return Rbfn(shape.names, centre, scale, units, normal.weights(shape.hyperparameters.ridge))
