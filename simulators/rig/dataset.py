"""Tables of observations of a simulated machine, and their true positions."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import Rig
from simulators.rig.truth import RigTruth

Floats = NDArray[np.float64]
Strings = NDArray[np.str_]


@dataclass(frozen=True)
class SimulatedObservations:
    """Observations of n fixes, with their true positions.

    Attributes:
        columns: columns of the observations CSV, in order: name -> (n,) strings or numbers.
        measured_mm: (n, 3) the fixes, the same as columns x_mm, y_mm, z_mm.
        oracle_mm: (n, 3) positions of the prisms on the true machine at the joints' *readings*: the prediction of a
            perfect model from the same row.
    """

    columns: Mapping[str, Floats | Strings]
    measured_mm: Floats
    oracle_mm: Floats

    def __len__(self) -> int:
        return len(self.measured_mm)

    @property
    def noise_rms_mm(self) -> float:
        """RMS of the 3-D difference between measurement and oracle; a model can only beat this by chance."""
        return float(np.sqrt(np.mean(np.sum((self.measured_mm - self.oracle_mm) ** 2, axis=1))))

    def csv_text(self) -> str:
        """Return the observations as CSV; numbers are written so that they can be read back exactly."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(self.columns)
        for row in zip(*(c.tolist() for c in self.columns.values()), strict=True):
            writer.writerow([repr(v) if isinstance(v, float) else v for v in row])
        return out.getvalue()


def random_poses(rig: Rig, n: int, rng: np.random.Generator) -> dict[str, Floats]:
    """Draw n poses uniformly within the joint limits: joint name -> (n,) deg or mm."""
    return {j.name: rng.uniform(*j.limits, n) for j in rig.joints}


def travel_m(rig: Rig, poses: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return `<joint>_travel_m` -> (n,) m travelled since the first pose, for every prismatic joint.

    Args:
        rig: description of the rig.
        poses: joint name -> (n,) mm, in the order in which the poses are visited.
    """
    return {
        f"{j.name}_travel_m": np.cumsum(np.abs(np.diff(poses[j.name], prepend=poses[j.name][:1]))) / 1e3
        for j in rig.joints
        if j.kind == "prismatic"
    }


def prisms_mm(
    truth: RigTruth, prism: Strings, joints: Mapping[str, Floats], columns: Mapping[str, Floats], *, setup: str = ""
) -> Floats:
    """Return the (n, 3) true position of each row's prism in the station's frame.

    Args:
        truth: the machine, with effects anchored in time and temperature.
        prism: (n,) names of the prisms.
        joints: joint name -> (n,) noise-free readings, deg or mm.
        columns: name -> (n,) further observation columns that effects need.
        setup: name of the station set-up.
    """
    out = np.empty((len(prism), 3))
    for name in np.unique(prism):
        rows = prism == name
        values = {k: v[rows] for k, v in joints.items()}
        out[rows] = truth.prism_mm(str(name), values, {k: v[rows] for k, v in columns.items()}, setup=setup)
    return out
