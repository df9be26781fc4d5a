"""Baselines that learners are compared with: the field's correction table, and the first paper's network as printed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats
from calibration.residual.features import Features
from calibration.residual.folds import folds
from calibration.residual.rbf.rbfn import k_means
from calibration.residual.rbf.relevance import gaussian

THETA = 0.05

_RINGS = 10
_SECTORS = 24
_HORIZONTAL = ("prism_x_mm", "prism_y_mm")
_CENTRES = 100
_THETAS = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4)
_FOLDS = 5
_PRISM = "prism_"  # the paper's inputs end with the frames


@dataclass(frozen=True)
class CorrectionTable:
    """The field's incumbent: a table of mean errors, one for each cell of boom reach and direction, of one prism.

    Cells are as a contractor lays them out: rings of a tenth of the longest reach, and sectors of 15 degrees.

    Attributes:
        ring_mm: width of a ring.
        correction_mm: (rings + 1, sectors, 3) in the base frame; zero where nothing was measured, and beyond all rings.
    """

    ring_mm: float
    correction_mm: Floats

    @classmethod
    def fit(cls, features: Features, target_mm: Floats) -> Self:
        """Average the errors in each cell.

        Args:
            features: n rows of one prism.
            target_mm: (n, 3) residuals in the base frame.
        """
        reach_mm = np.hypot(*features.columns(_HORIZONTAL).T)
        ring_mm = max(float(reach_mm.max()), 1.0) * (1.0 + 1e-9) / _RINGS  # the longest is inside
        cell = np.ravel_multi_index(_cells(features, ring_mm), (_RINGS + 1, _SECTORS))
        cells = (_RINGS + 1) * _SECTORS
        fixes = np.maximum(np.bincount(cell, minlength=cells), 1)
        total = np.column_stack([np.bincount(cell, column, cells) for column in target_mm.T])
        return cls(ring_mm, (total / fixes[:, None]).reshape(_RINGS + 1, _SECTORS, 3))

    def predict(self, features: Features) -> Floats:
        """(n, 3) correction in the base frame, mm."""
        ring, sector = _cells(features, self.ring_mm)
        inside = (ring < _RINGS)[:, None]
        return np.where(inside, self.correction_mm[ring, sector], 0.0)


def _cells(features: Features, ring_mm: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Ring and sector of every row; all that is beyond the rings is in one more."""
    x, y = features.columns(_HORIZONTAL).T
    ring = np.minimum(np.hypot(x, y) // ring_mm, _RINGS).astype(np.intp)
    sector = np.floor((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(np.intp) % _SECTORS
    return ring, sector


@dataclass(frozen=True)
class PaperRbfn:
    """The first paper's network (Zhou et al. 2022, Eqs. 12-13) as printed: 36 inputs, 100 centres, width 0.05.

    Inputs are the joint values and the frames' origins (on the paper's boom 9 + 27), each brought to 0..1 by the range
    of the training rows; the network belongs to one point of the boom, as the paper's does to the feed's end. Centres
    are those of k-means, which the paper does not say; the outputs x, y, z are sums of all units by least squares.

    The width needs a reading. As a Gaussian's standard deviation, 0.05 among 36 inputs in 0..1 leaves every unit zero
    but at its own centre, and the network would say nothing of any other pose. It is read here as the factor on the
    distance, exp(-(theta |x - c|)^2), as in the second paper's network and in the toolbox whose notation both follow.

    Attributes:
        theta: factor on distances.
        low: (d,) least value of each input.
        scale: (d,) one over its range; 0 for a constant one.
        centres: (m, d) among the inputs in 0..1.
        output: (m, 3) weights, mm.
    """

    theta: float
    low: Floats
    scale: Floats
    centres: Floats
    output: Floats

    @classmethod
    def fit(cls, features: Features, target_mm: Floats, *, theta: float = THETA, seed: int = 0) -> Self:
        """Fit to the rows of one prism.

        Args:
            features: n rows.
            target_mm: (n, 3) residuals in the base frame.
            theta: factor on distances.
            seed: of the centres' first places.
        """
        inputs = _inputs(features)
        low, size = inputs.min(axis=0), np.ptp(inputs, axis=0)
        scale = np.where(size > 0.0, 1.0 / np.where(size > 0.0, size, 1.0), 0.0)
        normalised = (inputs - low) * scale
        centres = k_means(normalised, _CENTRES, seed)
        output = np.linalg.lstsq(_activation(normalised, centres, theta), target_mm, rcond=None)[0]
        return cls(theta, low, scale, centres, np.asarray(output, dtype=np.float64))

    def predict(self, features: Features) -> Floats:
        """(n, 3) estimate of the residual in the base frame, mm."""
        return _activation((_inputs(features) - self.low) * self.scale, self.centres, self.theta) @ self.output


def best_theta(features: Features, target_mm: Floats, groups: NDArray[np.str_], *, seed: int = 0) -> float:
    """Find the factor on distances with the least squared error on held-out groups.

    Args:
        features: n rows of one prism.
        target_mm: (n, 3) residuals in the base frame.
        groups: (n,) labels that no fold separates, at least two.
        seed: of folds and centres.
    """
    split = folds(groups, _FOLDS, seed)
    error = dict.fromkeys(_THETAS, 0.0)
    for held in (split == fold for fold in np.unique(split)):
        inside, outside = features.select(~held), features.select(held)
        for theta in _THETAS:
            network = PaperRbfn.fit(inside, target_mm[~held], theta=theta, seed=seed)
            error[theta] += float(((target_mm[held] - network.predict(outside)) ** 2).sum())
    return min(error, key=lambda theta: error[theta])


def _inputs(features: Features) -> Floats:
    names = features.names[: features.geometry.shape[1]]
    return features.geometry[:, [not name.startswith(_PRISM) for name in names]]


def _activation(normalised: Floats, centres: Floats, theta: float) -> Floats:
    factor = theta * np.sqrt(2.0)  # `gaussian` halves the squared distance
    return gaussian(normalised * factor, centres * factor)
