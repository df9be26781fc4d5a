"""Features of observations for residual learners, computed in one place for both training and prediction."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from calibration.kinematics.chain import Chain
from calibration.kinematics.compiled_chain import Located
from calibration.kinematics.torques import GravityModel, gravity_torques, torque_columns
from calibration.numerics.jit import compiled, part
from calibration.observations import ROW, Floats, Observations
from calibration.rig.description import Rig

_NOT_FEATURES = frozenset({"time_s", ROW})  # a tree that splits on time cannot generalise to the future
_LEAST_MEASURED = 0.5  # share of the rows
_VARYING = 1e-6  # of the largest load; loads that vary less count as constant
DEFLECTION = ("deflection_x_mm", "deflection_y_mm", "deflection_z_mm")
_COMPLIANCE_RAD_PER_NM = 1e-7  # of every joint; only the shape of a deflection matters, not its size
_RIGID = 6  # degrees of freedom of a base
_FRAME_ORIGIN = re.compile(r"frame\d+_[xyz]_mm")
_PLACE = re.compile(r"(frame\d+|prism)_[xyz]_mm")


@dataclass(frozen=True)
class Features:
    """Features of n observations.

    Attributes:
        names: of all columns, geometry first.
        geometry: (n, g) joint values (deg or mm), frame origins and the prism in the base frame (mm); never missing.
        signals: (n, s) optional columns of the observations, joint torques and estimates of other learners; NaN where
            not measured.
        joint_jacobian: (n, 3, joints) derivative of the prism in the base frame by each joint, mm per deg or mm.
        parameter_jacobian: (n, 3, p) derivative by each constant of rows and prisms, and by shifts along and turns
            about the axes of the base, independent of the set-up; mm per mm or rad.
    """

    names: tuple[str, ...]
    geometry: Floats
    signals: Floats
    joint_jacobian: Floats
    parameter_jacobian: Floats

    def __len__(self) -> int:
        return len(self.geometry)

    def table(self) -> Floats:
        """Return all (n, g + s) columns."""
        return np.concatenate([self.geometry, self.signals], axis=1)

    def columns(self, names: Sequence[str]) -> Floats:
        """Return the (n, k) columns with these names; raise ValueError if one does not exist."""
        return self.table()[:, column_places(self.names, tuple(names))]

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Features:
        """Return rows by mask or by index."""
        return replace(
            self,
            geometry=self.geometry[rows],
            signals=self.signals[rows],
            joint_jacobian=self.joint_jacobian[rows],
            parameter_jacobian=self.parameter_jacobian[rows],
        )

    def with_signals(self, names: Sequence[str], columns: Floats) -> Features:
        """Append signal columns (n, k)."""
        return replace(self, names=(*self.names, *names), signals=np.hstack([self.signals, columns]))


@lru_cache(maxsize=64)
def column_places(names: tuple[str, ...], wanted: tuple[str, ...]) -> NDArray[np.intp]:
    """Return the indices of the wanted names among all; raise ValueError if one does not exist.

    Results are cached, as a learner asks for the same columns with each prediction.
    """
    return np.array([names.index(name) for name in wanted], dtype=np.intp)


def usable_signals(observations: Observations) -> tuple[str, ...]:
    """Return the names of optional columns that vary and are measured in at least half of the rows."""

    def is_usable(values: Floats) -> bool:
        measured = values[np.isfinite(values)]
        return 0 < len(measured) >= _LEAST_MEASURED * len(values) and bool(np.ptp(measured) > 0.0)

    columns = observations.extra.items()
    return tuple(sorted(name for name, values in columns if name not in _NOT_FEATURES and is_usable(values)))


def usable_torques(chain: Chain, x: Floats, observations: Observations) -> tuple[str, ...]:
    """Return names `torque_<joint>_Nm` or `torque_<joint>_N` of the loads that are known in every row and vary.

    Args:
        chain: kinematics.
        x: (p,) parameters of the chain.
        observations: the rows.
    """
    torques = gravity_torques(chain, x, observations)
    known = np.isfinite(torques).all(axis=0)
    loads = np.where(known, torques, 0.0)
    varying = np.ptp(loads, axis=0) > _VARYING * np.abs(loads).max(initial=0.0)
    return tuple(name for name, varies in zip(torque_columns(chain.rig), varying.tolist(), strict=True) if varies)


def usable_loads(chain: Chain, x: Floats, observations: Observations) -> tuple[str, ...]:
    """Return the names of loads that are known and vary, and of the deflection that they cause if any is a torque.

    Arguments as `usable_torques`.
    """
    torques = usable_torques(chain, x, observations)
    return (*torques, *DEFLECTION) if any(name.endswith("_Nm") for name in torques) else torques


def missing_signals(rig: Rig, observations: Observations, signals: Sequence[str]) -> tuple[str, ...]:
    """Return the names of signals without a value in any row; loads count as present if the rig has masses."""
    sources = {column: f"{joint.name}_Nm" for column, joint in zip(torque_columns(rig), rig.joints, strict=True)}
    found: list[str] = []
    for name in signals:
        if rig.masses and (name in sources or name in DEFLECTION):
            continue
        measured = observations.extra.get(sources.get(name, name))
        if measured is None or not np.isfinite(measured).any():
            found.append(sources.get(name, name))
    return tuple(found)


def _feature_names(rig: Rig, signals: Sequence[str]) -> tuple[str, ...]:
    joints = [j.column for j in rig.joints]
    frames = [f"frame{i + 1}_{axis}_mm" for i in range(len(rig.rows)) for axis in "xyz"]
    return (*joints, *frames, *(f"prism_{axis}_mm" for axis in "xyz"), *signals)


def no_features(chain: Chain, signals: Sequence[str]) -> Features:
    """Return features of zero rows, with the columns for a chain."""
    names, joints = _feature_names(chain.rig, signals), len(chain.rig.joints)
    return Features(
        names,
        np.empty((0, len(names) - len(signals))),
        np.empty((0, len(signals))),
        np.empty((0, 3, joints)),
        np.empty((0, 3, chain.base_start + _RIGID)),
    )


def is_frame_origin(name: str) -> bool:
    """Return True for a coordinate of a frame's origin."""
    return _FRAME_ORIGIN.fullmatch(name) is not None


def is_place(name: str) -> bool:
    """Return True for a coordinate of a frame's origin or of the prism, which follow from the joints."""
    return _PLACE.fullmatch(name) is not None


class Extractor:
    """Computes features of observations; build it once for a model.

    Args:
        chain: the identified kinematics.
        x: (p,) parameters of the kinematics.
        signals: optional columns to use, including joint torques; a column that is absent is filled with NaN.
    """

    def __init__(self, chain: Chain, x: Floats, signals: Sequence[str]) -> None:
        computed = (*torque_columns(chain.rig), *DEFLECTION)
        self._names = _feature_names(chain.rig, signals)
        self._measured = tuple(name for name in signals if name not in computed)
        place = {name: index for index, name in enumerate((*self._measured, *computed))}
        self._source = np.array([place[name] for name in signals], dtype=np.intp)
        turning = np.array([joint.kind == "revolute" for joint in chain.rig.joints])
        self._deg_per_nm = math.degrees(_COMPLIANCE_RAD_PER_NM) * turning
        self._loads = None if set(signals).isdisjoint(computed) else GravityModel(chain, x)
        self._parameters = chain.base_start + _RIGID

    def __call__(self, readings: Floats, located: Located, extra: Mapping[str, Floats]) -> Features:
        """Compute the features of n rows.

        Args:
            readings: (n, joints) deg or mm, as corrected by the effects.
            located: frames and Jacobians at these readings, including the Jacobian by parameters.
            extra: optional columns of the rows.
        """
        n, signals = len(readings), len(self._source)
        missing = np.full(n, np.nan)
        measured = np.array([extra.get(name, missing) for name in self._measured], dtype=np.float64)
        out = Features(
            self._names,
            np.empty((n, len(self._names) - signals)),
            np.empty((n, signals)),
            located.joint_jacobian,
            np.empty((n, 3, self._parameters)),
        )
        _fill(
            np.ascontiguousarray(readings),
            located.frames_mm,
            located.prism_mm,
            located.joint_jacobian,
            located.jacobian,
            np.full(readings.shape, np.nan) if self._loads is None else self._loads(readings, extra),
            self._deg_per_nm,
            measured.reshape(len(self._measured), n),
            self._source,
            out.geometry,
            out.signals,
            out.parameter_jacobian,
        )
        return out


@part()
def _deflection(by_joint: Floats, loads: Floats, deg_per_nm: Floats) -> float:
    """Return the displacement of one coordinate by joints that yield to their loads."""
    moved = 0.0
    for j in range(len(loads)):
        if math.isfinite(loads[j]):
            moved += by_joint[j] * (loads[j] * deg_per_nm[j])
    return moved


@part()
def _rigid(place: Floats, out: Floats) -> None:
    """Fill `out` (3, 6) with the derivatives of a position by shifts along and turns about the base frame's axes."""
    out[:] = 0.0
    for axis in range(3):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        out[axis, axis] = 1.0
        out[one, 3 + axis], out[other, 3 + axis] = -place[other], place[one]


@compiled
def _fill(
    readings: Floats,
    frames: Floats,
    place: Floats,
    by_joint: Floats,
    by_parameter: Floats,
    loads: Floats,
    deg_per_nm: Floats,
    measured: Floats,
    source: NDArray[np.intp],
    geometry: Floats,
    signals: Floats,
    parameters: Floats,
) -> None:
    """Fill `geometry`, `signals` and `parameters`, the Jacobian, of a `Features` of n rows.

    `frames` to `by_parameter` are fields of a `Located`. `loads` (n, joints), N m or N, are NaN where not known, and
    then cause no deflection. `deg_per_nm` (joints,) is the compliance of each joint. `source` (s,) is the index of each
    signal among the `measured` columns (m, n), the loads and the three coordinates of the deflection, in this order.
    """
    joints, places, first = readings.shape[1], frames.shape[1] - 1, parameters.shape[2] - _RIGID
    for n in range(len(readings)):
        geometry[n, :joints] = readings[n]
        for frame in range(places):
            geometry[n, joints + 3 * frame : joints + 3 * frame + 3] = frames[n, 1 + frame]
        geometry[n, joints + 3 * places :] = place[n]
        for k in range(len(source)):
            column = source[k]
            if column < len(measured):
                signals[n, k] = measured[column, n]
            elif column < len(measured) + joints:
                signals[n, k] = loads[n, column - len(measured)]
            else:
                signals[n, k] = _deflection(by_joint[n, column - len(measured) - joints], loads[n], deg_per_nm)
        parameters[n, :, :first] = by_parameter[n, :, :first]
        _rigid(place[n], parameters[n, :, first:])
