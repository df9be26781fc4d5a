"""The learners of the residual by kind, their loaders, and the chain of network and trees.

The chain follows Zhou et al. 2022: trees receive the network's estimate as additional features. In training this is
the *out-of-fold* estimate, so that the trees do not rely on what the network has memorised.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats
from calibration.residual.features import Features
from calibration.residual.folds import folds
from calibration.residual.gaussian.process import GaussianProcess
from calibration.residual.rbf.rbfn import Rbfn, Shape, fit_shape
from calibration.residual.rbf.torque_network import TorqueNetwork
from calibration.residual.trees.boosting import Boosting, Importance

_NETWORK_SIGNALS = ("rbfn_x_mm", "rbfn_y_mm", "rbfn_z_mm")
_INNER_FOLDS = 5


class Residual(Protocol):
    """A fitted learner of the residual."""

    @property
    def kind(self) -> str:
        """`rbfn`, `lightgbm`, `chain`, `gp` or `rbf-tcm`."""

    def predict(self, features: Features) -> Floats:
        """Return the (n, 3) estimate of the residual in the base frame, mm."""

    def fits(self, features: Features) -> bool:
        """Return True if the features have the columns on which the learner was trained."""

    def to_files(self) -> dict[str, bytes]:
        """Return file name -> content of the files from which the learner can be restored."""


@dataclass(frozen=True)
class Chained:
    """A network, followed by trees that have its estimate as features."""

    kind: ClassVar[str] = "chain"

    rbfn: Rbfn
    boosting: Boosting

    def predict(self, features: Features) -> Floats:
        """Return the (n, 3) estimate of the residual in the base frame, mm."""
        return self.boosting.predict(with_estimate(features, self.rbfn.predict(features)))

    def fits(self, features: Features) -> bool:
        """Return True if both parts fit."""
        estimate = np.empty((len(features), len(_NETWORK_SIGNALS)))
        return self.rbfn.fits(features) and self.boosting.fits(with_estimate(features, estimate))

    def to_files(self) -> dict[str, bytes]:
        """Return the files of both parts."""
        return self.rbfn.to_files() | self.boosting.to_files()

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> Chained:
        """Restore a chain from `to_files`."""
        return cls(Rbfn.from_files(files), Boosting.from_files(files))


LOADERS: Mapping[str, Callable[[Mapping[str, bytes]], Residual]] = {
    learner.kind: learner.from_files for learner in (Rbfn, Boosting, Chained, GaussianProcess, TorqueNetwork)
}


def tree_importance(residual: Residual | None) -> tuple[Importance, ...] | None:
    """Return the features of the learner's trees, the most important first; None without trees."""
    trees = residual.boosting if isinstance(residual, Chained) else residual
    return trees.importance if isinstance(trees, Boosting) else None


def with_estimate(features: Features, estimate_mm: Floats) -> Features:
    """Append a network's estimate (n, 3), mm, to the features, for the trees of a chain."""
    return features.with_signals(_NETWORK_SIGNALS, estimate_mm)


def with_out_of_fold_estimate(
    features: Features, target_mm: Floats, labels: NDArray[np.str_], shape: Shape, seed: int
) -> Features:
    """Append to each row the estimate of a network that was trained without the row's fold.

    Args:
        features: n training rows.
        target_mm: (n, 3) residuals in the base frame.
        labels: (n,) labels; no fold separates rows with the same one.
        shape: shape of the networks.
        seed: seed of folds and networks.
    """
    out = np.empty_like(target_mm)
    split = folds(labels, _INNER_FOLDS, seed + 1)
    for fold in np.unique(split):
        held = split == fold
        out[held] = fit_shape(features.select(~held), target_mm[~held], shape, seed).predict(features.select(held))
    return with_estimate(features, out)
