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
        columns: the observations CSV's columns, in order: name -> (n,) strings or numbers.
        measured_mm: (n, 3) the fixes, as in x_mm, y_mm, z_mm.
        oracle_mm: (n, 3) where the true machine has the prism *if the joints are as read*: what a perfect model
            would predict from the same row.
    """

    columns: Mapping[str, Floats | Strings]
    measured_mm: Floats
    oracle_mm: Floats

    def __len__(self) -> int:
        return len(self.measured_mm)

    @property
    def noise_rms_mm(self) -> float:
        """RMS of the 3-D difference of measurement and oracle: no model can do better but by luck."""
        return float(np.sqrt(np.mean(np.sum((self.measured_mm - self.oracle_mm) ** 2, axis=1))))

    def csv_text(self) -> str:
        """Observations CSV; numbers are written so that they read back exactly."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(self.columns)
        for row in zip(*(c.tolist() for c in self.columns.values()), strict=True):
            writer.writerow([repr(v) if isinstance(v, float) else v for v in row])
        return out.getvalue()


def random_poses(rig: Rig, n: int, rng: np.random.Generator) -> dict[str, Floats]:
    """Draw n poses evenly within the joint limits: joint name -> (n,) deg or mm."""
    return {j.name: rng.uniform(*j.limits, n) for j in rig.joints}


def travel_m(rig: Rig, poses: Mapping[str, Floats]) -> dict[str, Floats]:
    """`<joint>_travel_m` of every prismatic joint -> (n,) m travelled from the first pose, visited in this order."""
    return {
        f"{j.name}_travel_m": np.cumsum(np.abs(np.diff(poses[j.name], prepend=poses[j.name][:1]))) / 1e3
        for j in rig.joints
        if j.kind == "prismatic"
    }


def prisms_mm(
    truth: RigTruth, prism: Strings, joints: Mapping[str, Floats], columns: Mapping[str, Floats], *, setup: str = ""
) -> Floats:
    """(n, 3) true positions of a prism for each row, in the station's frame.

    Args:
        truth: the machine, its effects anchored in time and temperature.
        prism: (n,) names.
        joints: joint name -> (n,) noise-free readings, deg or mm.
        columns: further observation columns that effects need -> (n,).
        setup: station set-up.
    """
    out = np.empty((len(prism), 3))
    for name in np.unique(prism):
        rows = prism == name
        values = {k: v[rows] for k, v in joints.items()}
        out[rows] = truth.prism_mm(str(name), values, {k: v[rows] for k, v in columns.items()}, setup=setup)
    return out
