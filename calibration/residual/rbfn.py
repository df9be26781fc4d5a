"""The network that learns the residual (Zhou et al. 2022, Eqs. 12-13), and the features that it sees.

Joints and prism are what positions depend on; frames' origins say the same in more columns, and held-out errors are
no smaller with them. Signals take part where cross-validation finds them worth it.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calibration.npz import read_npz
from calibration.observations import Floats
from calibration.residual.features import Features, is_frame_origin
from calibration.residual.rbf_network import Hyperparameters, RbfNetwork, choose_hyperparameters

_FILE = "rbfn.npz"


@dataclass(frozen=True)
class Shape:
    """What `choose_shape` found: names of the network's inputs, and its hyperparameters."""

    names: tuple[str, ...]
    hyperparameters: Hyperparameters


@dataclass(frozen=True)
class Rbfn:
    """A fitted network.

    Attributes:
        names: of the features that are its inputs.
        network: fitted to them.
    """

    kind: ClassVar[str] = "rbfn"

    names: tuple[str, ...]
    network: RbfNetwork

    def predict(self, features: Features) -> Floats:
        """(n, 3) estimate of the residual in the base frame, mm."""
        return self.network.predict(features.columns(self.names))

    def fits(self, features: Features) -> bool:
        """Whether its inputs are among these columns."""
        return set(self.names) <= set(features.names)

    def to_files(self) -> dict[str, bytes]:
        """One npz file without pickled objects."""
        buffer = io.BytesIO()
        network = self.network
        np.savez(
            buffer,
            names=np.array(self.names, dtype=np.str_),
            centre=network.centre_,
            scale=network.scale_,
            units=network.units_,
            output=network.output_,
        )
        return {_FILE: buffer.getvalue()}

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> Rbfn:
        """Inverse of `to_files`; KeyError or ValueError where parts are missing or do not fit."""
        stored = read_npz(files[_FILE])
        names = tuple(stored["names"].astype(str).tolist())
        parts = ("centre", "scale", "units", "output")
        centre, scale, units, output = (np.asarray(stored[k], dtype=np.float64) for k in parts)
        inputs = (len(names),)
        if centre.shape != inputs or scale.shape != inputs or (*units.shape, 3) != (len(output), *inputs, 3):
            raise ValueError("shapes of the network do not fit each other")
        if output.shape[1:] != (3,) or not all(np.isfinite(part).all() for part in (centre, scale, units, output)):
            raise ValueError("the network has weights that are no numbers")
        return cls(names, RbfNetwork.of(centre, scale, units, output))


def choose_shape(features: Features, target_mm: Floats, groups: NDArray[np.str_], seed: int) -> Shape:
    """The inputs and hyperparameters with the least squared error on held-out groups.

    Args:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame.
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
    network = RbfNetwork(shape.hyperparameters, seed=seed)
    return Rbfn(shape.names, network.fit(features.columns(shape.names), target_mm))
