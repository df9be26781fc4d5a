"""Baselines for comparison with the learners: the industry's correction table and the first paper's network."""

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

THETA = 0.05  # the paper's factor on distances

_RINGS = 10
_SECTORS = 24
_HORIZONTAL = ("prism_x_mm", "prism_y_mm")
_CENTRES = 100
_THETAS = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4)
_FOLDS = 5
_PRISM = "prism_"  # prefix of columns that are not among the paper's inputs


@dataclass(frozen=True)
class CorrectionTable:
    """Industry practice: a table of the mean errors of one prism in each cell of boom reach and direction.

    Cells are as contractors define them: rings of a tenth of the longest reach, and sectors of 15 degrees.

    Attributes:
        ring_mm: width of a ring.
        correction_mm: (rings + 1, sectors, 3) in the base frame; zero in cells without fixes and beyond the last ring.
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
        ring_mm = max(float(reach_mm.max()), 1.0) * (1.0 + 1e-9) / _RINGS  # the longest reach is inside
        cell = np.ravel_multi_index(_cells(features, ring_mm), (_RINGS + 1, _SECTORS))
        cells = (_RINGS + 1) * _SECTORS
        fixes = np.maximum(np.bincount(cell, minlength=cells), 1)
        total = np.column_stack([np.bincount(cell, column, cells) for column in target_mm.T])
        return cls(ring_mm, (total / fixes[:, None]).reshape(_RINGS + 1, _SECTORS, 3))

    def predict(self, features: Features) -> Floats:
        """Return the (n, 3) correction in the base frame, mm."""
        ring, sector = _cells(features, self.ring_mm)
        inside = (ring < _RINGS)[:, None]
        return np.where(inside, self.correction_mm[ring, sector], 0.0)


def _cells(features: Features, ring_mm: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return ring and sector of every row; rows beyond the last ring are in an additional one."""
    x, y = features.columns(_HORIZONTAL).T
    ring = np.minimum(np.hypot(x, y) // ring_mm, _RINGS).astype(np.intp)
    sector = np.floor((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(np.intp) % _SECTORS
    return ring, sector


@dataclass(frozen=True)
class PaperRbfn:
    """The first paper's network (Zhou et al. 2022, Eqs. 12-13) as printed: 36 inputs, 100 centres, width 0.05.

    Inputs are the joint values and the frames' origins (9 + 27 on the paper's boom), each scaled to 0..1 by its range
    in the training rows. A network is for one point of the boom, as the paper's is for the end of the feed. Centres
    are found by k-means, as the paper does not specify them. The outputs x, y, z are weighted sums of all units, fitted
    by least squares.

    The meaning of the width has to be inferred. As the standard deviation of a Gaussian, 0.05 among 36 inputs in 0..1
    makes every unit zero except at its own centre, so the network would predict zero at all other poses. Here it is the
    factor on the distance, exp(-(theta |x - c|)^2), as in the second paper's network and in the toolbox whose notation
    both papers follow.

    Attributes:
        theta: factor on distances.
        low: (d,) lowest training value of each input.
        scale: (d,) 1 / range of each input; 0 for a constant one.
        centres: (m, d) in scaled inputs.
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
            seed: seed of the initial centres.
        """
        inputs = _inputs(features)
        low, size = inputs.min(axis=0), np.ptp(inputs, axis=0)
        scale = np.where(size > 0.0, 1.0 / np.where(size > 0.0, size, 1.0), 0.0)
        normalised = (inputs - low) * scale
        centres = k_means(normalised, _CENTRES, seed)
        output = np.linalg.lstsq(_activation(normalised, centres, theta), target_mm, rcond=None)[0]
        return cls(theta, low, scale, centres, np.asarray(output, dtype=np.float64))

    def predict(self, features: Features) -> Floats:
        """Return the (n, 3) estimate of the residual in the base frame, mm."""
        return _activation((_inputs(features) - self.low) * self.scale, self.centres, self.theta) @ self.output


def best_theta(features: Features, target_mm: Floats, groups: NDArray[np.str_], *, seed: int = 0) -> float:
    """Find the factor on distances with the least squared error on held-out groups.

    Args:
        features: n rows of one prism.
        target_mm: (n, 3) residuals in the base frame.
        groups: (n,) labels, at least two; no fold separates rows with the same one.
        seed: seed of folds and centres.
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
