"""Radial basis function network: Gaussian units on the geometry, linear output by ridge regression.

Zhou et al. 2022, Eqs. 12-13, with units, width and ridge chosen by grouped cross-validation. There is no constant term:
far from everything that was trained on, the estimate fades to zero.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats
from calibration.residual.features import Features
from calibration.residual.folds import folds

_UNITS = (30, 100, 250)
_WIDTHS = (0.35, 0.7, 1.4, 2.8)  # in median distances between observations
_RIDGES = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
_INNER_FOLDS = 3
_LLOYD_ROUNDS = 8
_FILE = "rbfn.npz"


@dataclass(frozen=True)
class Shape:
    """Hyperparameters: number of units, their width in median distances, ridge."""

    units: int
    width: float
    ridge: float


@dataclass(frozen=True)
class Rbfn:
    """A fitted network.

    Attributes:
        centre, scale: (g,) standardisation of the geometry; scale 0 leaves a column out.
        units: (m, g) standardised centres.
        width: of every unit, in standardised distance.
        output: (m, 3) weights, mm.
    """

    kind: ClassVar[str] = "rbfn"

    centre: Floats
    scale: Floats
    units: Floats
    width: float
    output: Floats

    def predict(self, features: Features) -> Floats:
        """(n, 3) estimate of the residual in the base frame, mm."""
        scaled = (features.geometry - self.centre) * self.scale
        estimate: Floats = _activation(_squared_distance(scaled, self.units), self.width) @ self.output
        return estimate

    def fits(self, names: Sequence[str], geometry: int) -> bool:
        """Whether it was trained on so many geometry columns."""
        return len(self.centre) == geometry <= len(names)

    def to_files(self) -> dict[str, bytes]:
        """One npz file without pickled objects."""
        buffer = io.BytesIO()
        np.savez(buffer, centre=self.centre, scale=self.scale, units=self.units, width=[self.width], output=self.output)
        return {_FILE: buffer.getvalue()}

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> Rbfn:
        """Inverse of `to_files`; KeyError or ValueError where parts are missing or do not fit."""
        with np.load(io.BytesIO(files[_FILE]), allow_pickle=False) as stored:
            centre, scale, units, width, output = (stored[k] for k in ("centre", "scale", "units", "width", "output"))
        if units.shape != (len(output), len(centre)) or scale.shape != centre.shape or output.shape[1:] != (3,):
            raise ValueError("shapes of the network do not fit each other")
        return cls(centre, scale, units, float(width[0]), output)


def choose_shape(features: Features, target_mm: Floats, groups: NDArray[np.str_], seed: int) -> Shape:
    """The hyperparameters with the least held-out squared error."""
    split = folds(groups, _INNER_FOLDS, seed)
    most = max(2, min(np.bincount(split).sum() - np.bincount(split).max(), len(features)) // 2)
    candidates = sorted({min(units, int(most)) for units in _UNITS})
    error: dict[Shape, float] = {}
    for fold in np.unique(split):
        held = split == fold
        centre, scale = _standardisation(features.geometry[~held])
        inside = (features.geometry[~held] - centre) * scale
        outside = (features.geometry[held] - centre) * scale
        for units in candidates:
            centres, reach = _units(inside, units, seed)
            near, far = _squared_distance(inside, centres), _squared_distance(outside, centres)
            for width in _WIDTHS:
                activation = _activation(near, width * reach)
                # One decomposition serves all ridges.
                size, axes = np.linalg.eigh(activation.T @ activation)
                moment = axes.T @ (activation.T @ target_mm[~held])
                unseen = _activation(far, width * reach) @ axes
                for ridge in _RIDGES:
                    left = target_mm[held] - unseen @ (moment / (np.maximum(size, 0.0) + ridge)[:, None])
                    shape = Shape(units, width, ridge)
                    error[shape] = error.get(shape, 0.0) + float((left**2).sum())
    return min(error, key=lambda shape: error[shape])


def fit_shape(features: Features, target_mm: Floats, shape: Shape, seed: int) -> Rbfn:
    """Fit with given hyperparameters."""
    centre, scale = _standardisation(features.geometry)
    scaled = (features.geometry - centre) * scale
    units, reach = _units(scaled, min(shape.units, len(features)), seed)
    width = shape.width * reach
    activation = _activation(_squared_distance(scaled, units), width)
    normal = activation.T @ activation + shape.ridge * np.eye(len(units))
    output = np.asarray(np.linalg.solve(normal, activation.T @ target_mm), dtype=np.float64)
    return Rbfn(centre, scale, units, width, output)


def _standardisation(geometry: Floats) -> tuple[Floats, Floats]:
    spread = geometry.std(axis=0)
    constant = spread <= 1e-9 * np.maximum(1.0, np.abs(geometry).max(axis=0))
    return geometry.mean(axis=0), np.where(constant, 0.0, 1.0 / np.where(constant, 1.0, spread))


def _squared_distance(a: Floats, b: Floats) -> Floats:
    square: Floats = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T
    return np.maximum(square, 0.0)


def _activation(squared_distance: Floats, width: float) -> Floats:
    return np.exp(squared_distance * (-0.5 / width**2))


def _units(scaled: Floats, count: int, seed: int) -> tuple[Floats, float]:
    """Centres by k-means and the median distance between observations."""
    generator = np.random.default_rng(seed)
    centres = scaled[np.sort(generator.permutation(len(scaled))[:count])]
    reach = float(np.median(np.sqrt(_squared_distance(scaled, centres))))
    for _ in range(_LLOYD_ROUNDS):
        nearest = _squared_distance(scaled, centres).argmin(axis=1)
        members = np.bincount(nearest, minlength=count)
        total = (nearest == np.arange(count)[:, None]) @ scaled
        centres = np.where(members[:, None] > 0, total / np.maximum(members, 1)[:, None], centres)
    return centres, max(reach, 1e-9)
