"""What a residual learner sees of an observation, computed in one place for training and prediction alike."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.kinematics import Chain
from calibration.observations import Floats, Observations
from calibration.rig import Rig
from calibration.torques import gravity_torques, torque_columns

_NOT_FEATURES = frozenset({"time_s"})  # a tree that splits on time knows the past alone
_LEAST_MEASURED = 0.5
_VARYING = 1e-6  # of the largest load
_FRAME_ORIGIN = re.compile(r"frame\d+_[xyz]_mm")


@dataclass(frozen=True)
class Features:
    """Features of n observations.

    Attributes:
        names: of all columns, geometry first.
        geometry: (n, g) joint values (deg or mm), frame origins and the prism in the base frame (mm); never missing.
        signals: (n, s) optional columns of the observations, joint torques and estimates of other learners; NaN where
            not measured.
    """

    names: tuple[str, ...]
    geometry: Floats
    signals: Floats

    def __len__(self) -> int:
        return len(self.geometry)

    def table(self) -> Floats:
        """(n, g + s) all columns."""
        return np.hstack([self.geometry, self.signals])

    def columns(self, names: Sequence[str]) -> Floats:
        """(n, k) the columns of these names; ValueError for one that is not there."""
        return self.table()[:, [self.names.index(name) for name in names]]

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Features:
        """The given rows, by mask or by index."""
        return replace(self, geometry=self.geometry[rows], signals=self.signals[rows])

    def with_signals(self, names: Sequence[str], columns: Floats) -> Features:
        """With further signal columns (n, k)."""
        return Features((*self.names, *names), self.geometry, np.hstack([self.signals, columns]))


def usable_signals(observations: Observations) -> tuple[str, ...]:
    """Optional columns that vary and are measured in at least half of the rows."""
    names: list[str] = []
    for name, values in observations.extra.items():
        measured = values[np.isfinite(values)]
        if (
            name not in _NOT_FEATURES
            and len(measured) >= _LEAST_MEASURED * len(values)
            and len(measured) > 0
            and np.ptp(measured) > 0.0
        ):
            names.append(name)
    return tuple(sorted(names))


def usable_torques(chain: Chain, x: Floats, observations: Observations) -> tuple[str, ...]:
    """Columns `torque_<joint>_Nm`, `torque_<joint>_N` of the loads that are known in every row and vary."""
    torques = gravity_torques(chain, x, observations)
    known = np.isfinite(torques).all(axis=0)
    loads = np.where(known, torques, 0.0)
    varying = np.ptp(loads, axis=0) > _VARYING * np.abs(loads).max(initial=0.0)
    return tuple(name for name, varies in zip(torque_columns(chain.rig), varying.tolist(), strict=True) if varies)


def missing_signals(rig: Rig, observations: Observations, signals: Sequence[str]) -> tuple[str, ...]:
    """Signals that the observations have in no row; torques are computed wherever the rig has masses."""
    sources = {column: f"{joint.name}_Nm" for column, joint in zip(torque_columns(rig), rig.joints, strict=True)}
    found: list[str] = []
    for name in signals:
        if name in sources and rig.masses:
            continue
        measured = observations.extra.get(sources.get(name, name))
        if measured is None or not np.isfinite(measured).any():
            found.append(sources.get(name, name))
    return tuple(found)


def feature_names(rig: Rig, signals: Sequence[str]) -> tuple[str, ...]:
    """Names of the columns that `features` computes."""
    joints = [j.column for j in rig.joints]
    frames = [f"frame{i + 1}_{axis}_mm" for i in range(len(rig.rows)) for axis in "xyz"]
    return (*joints, *frames, *(f"prism_{axis}_mm" for axis in "xyz"), *signals)


def is_frame_origin(name: str) -> bool:
    """Whether a column is a coordinate of a frame's origin."""
    return _FRAME_ORIGIN.fullmatch(name) is not None


def features(chain: Chain, x: Floats, observations: Observations, signals: Sequence[str]) -> Features:
    """Compute the features.

    Args:
        chain, x: the identified kinematics.
        observations: n rows whose set-ups the chain knows.
        signals: optional columns to use, joint torques among them; one that is absent is NaN throughout.
    """
    data = chain.bind(observations)
    position = chain.positions_mm(x, data)
    prism = np.empty_like(position)
    for setup in range(len(chain.setups)):
        rows = data.setup == setup
        base = chain.base(x, setup)
        prism[rows] = (position[rows] - base.translation_mm) @ base.rotation
    frames = chain.frames_mm(x, data).reshape(len(data), -1)
    missing = np.full(len(data), np.nan)
    known = dict(observations.extra)
    if not set(signals).isdisjoint(torque_columns(chain.rig)):
        known |= zip(torque_columns(chain.rig), gravity_torques(chain, x, observations).T, strict=True)
    columns = [known.get(name, missing) for name in signals]
    return Features(
        feature_names(chain.rig, signals),
        np.hstack([data.readings, frames, prism]),
        np.column_stack(columns) if columns else np.empty((len(data), 0)),
    )
