"""A grid of corrections: the nominal and the corrected position of each prism at nodes of joint values.

Between nodes the difference is interpolated linearly in every joint value.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from calibration.design.knowledge import setup_of
from calibration.design.visibility import Bodies, Flags, is_reachable, site
from calibration.effects.fitted import FittedEffect, missing_inputs
from calibration.effects.library import library
from calibration.errors import DataError
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.numerics.single_thread import one_blas_thread
from calibration.observations import Floats, Observations
from calibration.rig.description import Joint

T = TypeVar("T", bound=np.generic)

_CURVATURE_POSES = 256
_CURVATURE_STEP = 0.05  # of a joint's range
_PROOF_POSES = 500
_LEAST_RANGE = 1.0  # deg or mm; range of the grid for a joint that did not move in training
_CHUNK = 10_000
FINE_SHARE = 0.1  # of the corrections: tolerated interpolation error
_FIRST_POSES, _FINER = 64, 2  # nodes of the first grid, and the factor by which each next grid is larger
_LATER_S = 1e12  # `time_s` of the grid, after any training, so that all step changes have happened


@dataclass(frozen=True)
class CorrectionGrid:
    """Corrections at the nodes of a grid of joint values, in the base frame.

    Attributes:
        nodes: joint -> its values on the grid, ascending, deg or mm.
        readings: (g, joints) all combinations, with the last joint changing fastest.
        nominal_mm, corrected_mm: prism -> (g, 3) nominal position, and position of the model.
        reachable: (g,) True where the rig touches neither itself nor the floor.
        lacking: effects of the machine that the grid leaves out because they need more than joint values.
        rms_mm, p95_mm, max_mm: error of the interpolated corrections at random poses, all prisms together.
        correction_rms_mm: RMS size of the model's own corrections at these poses.
    """

    nodes: Mapping[str, Floats]
    readings: Floats
    nominal_mm: Mapping[str, Floats]
    corrected_mm: Mapping[str, Floats]
    reachable: Flags
    lacking: tuple[FittedEffect, ...]
    rms_mm: float
    p95_mm: float
    max_mm: float
    correction_rms_mm: float

    @property
    def is_coarse(self) -> bool:
        """True if the interpolation error is more than a tenth of the corrections."""
        return self.rms_mm > FINE_SHARE * self.correction_rms_mm


@one_blas_thread()
def correction_grid(
    model: CalibratedModel, prisms: Sequence[str], most_poses: int, rng: np.random.Generator
) -> CorrectionGrid:
    """Compute corrections over the trained joint values, with more nodes along joints with more curvature.

    Outside the trained range a model predicts by its kinematics only, and a grid that extended there would be coarser
    everywhere. The number of nodes is increased until the interpolation error is below a tenth of the
    corrections, or until `most_poses`.

    Args:
        model: the model. Its effects and residual are evaluated for data that have only joint values and were measured
            after the training.
        prisms: prisms of its rig, at least one.
        most_poses: greatest number of nodes.
        rng: draws the poses that determine the nodes and the interpolation error.

    Raises:
        DataError: a prism that the rig lacks, too few nodes for two at each joint, or a joint that was trained only
            beyond its limits.
    """
    unknown = sorted(set(prisms) - set(model.rig.prism_names))
    if unknown:
        allowed = ", ".join(model.rig.prism_names)
        raise DataError("grid", f"rig {model.rig.name!r} has no prism {unknown[0]!r}; it has {allowed}")
    joints = model.rig.joints
    least = 2 ** len(joints)
    if most_poses < least:
        reason = f"two values for each of {len(joints)} joints make {least:,} poses, but {most_poses:,} are allowed"
        raise DataError("grid", f"{reason}; allow more, or export another format, such as json or c-header")
    machine = Machine(model, setup_of(model))
    low, high = trained_ranges(model)
    bends_mm = _curvature_mm(machine, prisms, low, high, rng)
    poses = rng.uniform(low, high, (_PROOF_POSES, len(joints)))
    wanted_mm = np.concatenate([machine.correction_mm(prism, poses) for prism in prisms])
    correction_rms_mm = float(np.sqrt((wanted_mm**2).sum(axis=1).mean()))
    most = min(max(least, _FIRST_POSES), most_poses)
    while True:
        counts = _counts(bends_mm, most)
        nodes = {joint.name: np.linspace(*ends) for joint, *ends in zip(joints, low, high, counts, strict=True)}
        readings = np.stack(np.meshgrid(*nodes.values(), indexing="ij"), axis=-1).reshape(-1, len(joints))
        nominal_mm = {prism: machine.nominal_mm(prism, readings) for prism in prisms}
        corrected_mm = {prism: machine.corrected_mm(prism, readings) for prism in prisms}
        given_mm = [interpolated(nodes, corrected_mm[prism] - nominal_mm[prism], poses) for prism in prisms]
        off_mm = np.linalg.norm(np.concatenate(given_mm) - wanted_mm, axis=1)
        rms_mm = float(np.sqrt((off_mm**2).mean()))
        if rms_mm <= FINE_SHARE * correction_rms_mm or most == most_poses:
            break
        most = min(_FINER * most, most_poses)
    return CorrectionGrid(
        nodes,
        readings,
        nominal_mm,
        corrected_mm,
        machine.reachable(readings),
        machine.lacking(machine.rows(prisms[0], readings[:1])),
        rms_mm=rms_mm,
        p95_mm=float(np.quantile(off_mm, 0.95)),
        max_mm=float(off_mm.max()),
        correction_rms_mm=correction_rms_mm,
    )


def trained_ranges(model: CalibratedModel) -> tuple[Floats, Floats]:
    """Return (joints,) least and greatest trained values of the joints, inside their limits, deg or mm.

    Raises:
        DataError: a joint that was trained only beyond its limits.
    """
    low, high = np.array([_range(model, joint) for joint in model.rig.joints]).T
    return low, high


def interpolated(nodes: Mapping[str, Floats], values: Floats, readings: Floats) -> Floats:
    """Interpolate values at the nodes of a grid linearly in every joint.

    Args:
        nodes: joint -> its values on the grid, ascending.
        values: (g, 3) values at all combinations, with the last joint changing fastest.
        readings: (n, joints) joint values inside the grid.

    Returns:
        (n, 3) interpolated values.
    """
    shape = tuple(len(own) for own in nodes.values())
    table = RegularGridInterpolator(tuple(nodes.values()), values.reshape(*shape, 3))
    return np.asarray(table(readings), dtype=np.float64)


def _range(model: CalibratedModel, joint: Joint) -> tuple[float, float]:
    """Return the least and greatest value of a joint on the grid: as in training, but inside the limits and apart."""
    trained_low, trained_high = model.coverage.ranges[joint.name]
    spare = max(0.0, 0.5 * (_LEAST_RANGE - (trained_high - trained_low)))
    low, high = max(trained_low - spare, joint.limits[0]), min(trained_high + spare, joint.limits[1])
    if low >= high:
        raise DataError(
            "grid",
            f"{joint.name} was trained at {trained_low:.1f} .. {trained_high:.1f} {joint.unit}, beyond its limits "
            f"{joint.limits[0]:g} .. {joint.limits[1]:g}, and no value inside them was measured; correct the limits or "
            f"the zero in the rig file and calibrate again",
        )
    return low, high


@dataclass(frozen=True)
class Machine:
    """Positions of prisms in the base frame at joint values (n, joints): nominal, and of the model.

    Attributes:
        model: the model.
        setup: index of the set-up whose base is used.
    """

    model: CalibratedModel
    setup: int

    def nominal_mm(self, prism: str, readings: Floats) -> Floats:
        """Return (n, 3) nominal positions, mm."""
        model = self.model
        base = model.chain.base(model.nominal_values, self.setup)
        nominal_mm = Predictor.of(model).nominal_mm(self.rows(prism, readings))
        turned: Floats = (nominal_mm - base.translation_mm) @ base.rotation
        return turned

    def corrected_mm(self, prism: str, readings: Floats, extra: Mapping[str, Floats] | None = None) -> Floats:
        """Return (n, 3) positions of the model, mm; `extra` are further columns of the observations."""
        if extra is not None:
            rows = self.rows(prism, readings)
            return Predictor.of(self.model).base_mm(replace(rows, extra={**rows.extra, **extra}))
        return _in_chunks(lambda some: Predictor.of(self.model).base_mm(self.rows(prism, some)), readings)

    def correction_mm(self, prism: str, readings: Floats) -> Floats:
        """Return (n, 3) the model's positions minus the nominal ones, mm."""
        difference: Floats = self.corrected_mm(prism, readings) - self.nominal_mm(prism, readings)
        return difference

    def reachable(self, readings: Floats) -> Flags:
        """Return an (n,) mask, True where the rig touches neither itself nor the floor."""
        chain, values = self.model.chain, self.model.values
        at = site(chain, values, setup=self.setup)
        return _in_chunks(lambda some: is_reachable(Bodies.of(chain, values, some), at), readings)

    @property
    def effects(self) -> tuple[FittedEffect, ...]:
        """Effects of the model that move the machine."""
        return tuple(effect for effect in self.model.effects if library()[effect.family].moves_machine)

    def lacking(self, rows: Observations) -> tuple[FittedEffect, ...]:
        """Return the effects that move the machine and that lack an input in some of these rows."""
        context = Predictor.of(self.model).context(rows)
        return tuple(effect for effect in self.effects if missing_inputs([effect], context))

    def rows(self, prism: str, readings: Floats) -> Observations:
        """Return observations of a prism at these joint values, without positions."""
        n = len(readings)
        return Observations(
            prism=np.full(n, prism),
            joints=dict(zip(self.model.rig.joint_names, readings.T, strict=True)),
            position_mm=np.full((n, 3), np.nan),
            sigma_mm=np.full((n, 3), np.nan),
            setup=np.full(n, self.model.chain.setups[self.setup]),
            session=np.full(n, ""),
            pose=np.full(n, ""),
            extra={"time_s": np.full(n, _LATER_S)},
        )


def _in_chunks(function: Callable[[Floats], NDArray[T]], readings: Floats) -> NDArray[T]:
    return np.concatenate([function(readings[first : first + _CHUNK]) for first in range(0, len(readings), _CHUNK)])


def _curvature_mm(
    machine: Machine, prisms: Sequence[str], low: Floats, high: Floats, rng: np.random.Generator
) -> Floats:
    """Return (joints,) RMS error, mm, of linear interpolation of the corrections over each joint's whole range.

    It is the error for a parabola with the average curvature of the corrections: range^2 |f''| / sqrt(120).
    """
    span = high - low
    middle = rng.uniform(low + _CURVATURE_STEP * span, high - _CURVATURE_STEP * span, (_CURVATURE_POSES, len(span)))
    found = np.zeros(len(span))
    for prism in prisms:
        centre = machine.correction_mm(prism, middle)
        for joint in range(len(span)):
            step = np.zeros(len(span))
            step[joint] = _CURVATURE_STEP * span[joint]
            bend = (
                machine.correction_mm(prism, middle + step) + machine.correction_mm(prism, middle - step) - 2 * centre
            )
            found[joint] += (bend**2).sum(axis=1).mean()
    scale: Floats = np.sqrt(found / len(prisms)) / _CURVATURE_STEP**2 / math.sqrt(120.0)
    return scale


def _counts(error_mm: Floats, most: int) -> list[int]:
    """Return the number of nodes of each joint, found by adding nodes one by one.

    Each node is added where it reduces the squared error most relative to its cost. The error of n nodes is that of two
    nodes divided by (n - 1)^2; the cost is the logarithm of the factor by which the grid grows.
    """
    counts = [2] * len(error_mm)
    while True:
        gains = [
            (e / (n - 1) ** 2) ** 2 - (e / n**2) ** 2 if math.prod(counts) // n * (n + 1) <= most else -1.0
            for e, n in zip(error_mm.tolist(), counts, strict=True)
        ]
        worth = [gain / math.log((n + 1) / n) for gain, n in zip(gains, counts, strict=True)]
        best = int(np.argmax(worth))
        if worth[best] <= 0.0:
            return counts
        counts[best] += 1
