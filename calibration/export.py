"""A calibrated model for other programs: one document of what was identified, and a grid of corrections.

A controller that knows only its own nominal kinematics can still profit: at the nodes of a grid of joint values the
grid says how far each prism is from where the drawings have it. Between nodes the difference is interpolated linearly
in every joint value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from calibration.accuracy import expected_accuracy
from calibration.design.knowledge import setup_of
from calibration.design.visibility import Bodies, is_reachable, site
from calibration.effects.fitted import left_out
from calibration.effects.library import library
from calibration.errors import DataError, UnsafeError
from calibration.model import CalibratedModel
from calibration.observations import Floats, Observations
from calibration.rig import Joint
from calibration.single_thread import one_blas_thread

FORMAT, VERSION = "rigcal calibration", 1

_CURVATURE_POSES = 256
_CURVATURE_STEP = 0.05  # of a joint's range
_PROOF_POSES = 500
_LEAST_RANGE = 1.0  # deg or mm, of a joint that stood still in training
_CHUNK = 10_000
_LATER_S = 1e12  # `time_s` of the grid, after any training: what has jumped then has jumped


@dataclass(frozen=True)
class CorrectionGrid:
    """Corrections at the nodes of a grid of joint values, in the base frame.

    Attributes:
        nodes: joint -> its values on the grid, rising, deg or mm.
        readings: (g, joints) all combinations, the last joint changing fastest.
        nominal_mm, corrected_mm: prism -> (g, 3) by the drawings, and by the model.
        reachable: (g,) whether the rig touches neither itself nor the floor.
        left_out: a sentence for every effect of the machine that needs more than joint values.
        rms_mm, p95_mm, max_mm: how far the interpolated corrections are from the model's own, in random poses on the
            grid, all prisms taken together.
        correction_rms_mm: how large the model's own corrections are there.
    """

    nodes: Mapping[str, Floats]
    readings: Floats
    nominal_mm: Mapping[str, Floats]
    corrected_mm: Mapping[str, Floats]
    reachable: NDArray[np.bool_]
    left_out: tuple[str, ...]
    rms_mm: float
    p95_mm: float
    max_mm: float
    correction_rms_mm: float

    @property
    def is_coarse(self) -> bool:
        """Whether interpolating leaves more than half of the error that the table is there to take away."""
        return self.rms_mm > 0.5 * self.correction_rms_mm

    def correction_mm(self, prism: str, readings: Floats) -> Floats:
        """(n, 3) what to add to the nominal place of a prism at (n, joints) readings inside the grid."""
        difference = self.corrected_mm[prism] - self.nominal_mm[prism]
        shape = tuple(len(values) for values in self.nodes.values())
        table = RegularGridInterpolator(tuple(self.nodes.values()), difference.reshape(*shape, 3))
        return np.asarray(table(readings), dtype=np.float64)


def document(model: CalibratedModel) -> dict[str, object]:
    """Everything that was identified, as JSON can hold it; lengths mm, angles rad."""
    chain = model.chain
    nominal = {op.parameter: op.constant for ops in (*chain.row_ops, *chain.prism_ops) for op in ops}
    try:
        expected: object = expected_accuracy(model, np.random.default_rng(0)).as_dict()
    except UnsafeError:
        expected = None
    bases = [chain.base(model.values, number) for number in range(len(chain.setups))]
    return {
        "format": FORMAT,
        "version": VERSION,
        "rig": model.rig.name,
        "convention": model.rig.convention,
        "rig_file": model.rig_text,
        "parameters": [
            {
                "name": p.name,
                "unit": p.unit,
                "kind": p.kind,
                "nominal": nominal[index],
                "correction": p.value,
                "value": nominal[index] + p.value,
                "standard_error": p.standard_error,
            }
            for index, p in enumerate(model.parameters)
            if p.kind != "base"
        ],
        "bases": [
            {"setup": setup, "rotation": base.rotation.tolist(), "translation_mm": base.translation_mm.tolist()}
            for setup, base in zip(chain.setups, bases, strict=True)
        ],
        "effects": [effect.as_dict() for effect in model.effects],
        "residual": model.residual.learner.kind if model.residual else None,
        "noise_mm": model.noise_mm,
        "expected_accuracy": expected,
        "identifiability": model.identifiability.as_dict(),
        "trained_on": {
            "fixes": dict(model.coverage.fixes),
            "ranges": {name: list(ends) for name, ends in model.coverage.ranges.items()},
        },
        "warnings": list(model.warnings),
        "provenance": dict(model.provenance),
    }


@one_blas_thread()
def correction_grid(
    model: CalibratedModel, prisms: Sequence[str], most_poses: int, rng: np.random.Generator
) -> CorrectionGrid:
    """Corrections over the joint values that the model was trained on, with more nodes where they bend more.

    Elsewhere a model says what its kinematics say, and a grid that reached there would be coarser everywhere.

    Args:
        model: the model. Effects and residual are taken as for data that have joint values and nothing else, measured
            after the training.
        prisms: of its rig, at least one.
        most_poses: the grid has no more nodes.
        rng: draws the poses by which nodes are placed and the interpolation is judged.

    Raises:
        DataError: a prism that the rig lacks, too few nodes for two at each joint, or a joint that was trained beyond
            its limits alone.
    """
    unknown = sorted(set(prisms) - set(model.rig.prism_names))
    if unknown:
        raise DataError("grid", f"rig {model.rig.name!r} has no prism {unknown[0]!r}; it has {model.rig.prism_names}")
    joints = model.rig.joints
    least = 2 ** len(joints)
    if most_poses < least:
        raise DataError("grid", f"two values for each of {len(joints)} joints make {least} poses; allow so many")
    number = setup_of(model, None)
    places = _Places(model, number)
    low, high = np.array([_range(model, joint) for joint in joints]).T
    counts = _counts(_curvature_mm(places, prisms, low, high, rng), most_poses)
    values = [np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)]
    readings = np.stack(np.meshgrid(*values, indexing="ij"), axis=-1).reshape(-1, len(joints))
    at = site(model.chain, model.values, setup=number)
    grid = CorrectionGrid(
        {joint.name: nodes for joint, nodes in zip(joints, values, strict=True)},
        readings,
        {prism: places.nominal_mm(prism, readings) for prism in prisms},
        {prism: places.corrected_mm(prism, readings) for prism in prisms},
        np.concatenate(
            [
                is_reachable(Bodies.of(model.chain, model.values, readings[start : start + _CHUNK]), at)
                for start in range(0, len(readings), _CHUNK)
            ]
        ),
        places.left_out(prisms[0], readings[:1]),
        *(math.nan,) * 4,  # told below, once it can be interpolated
    )
    poses = rng.uniform(low, high, (_PROOF_POSES, len(joints)))
    wanted = [places.difference_mm(prism, poses) for prism in prisms]
    given = [grid.correction_mm(prism, poses) for prism in prisms]
    off_mm = np.linalg.norm(np.concatenate(given) - np.concatenate(wanted), axis=1)
    return replace(
        grid,
        rms_mm=float(np.sqrt((off_mm**2).mean())),
        p95_mm=float(np.quantile(off_mm, 0.95)),
        max_mm=float(off_mm.max()),
        correction_rms_mm=float(np.sqrt((np.concatenate(wanted) ** 2).sum(axis=1).mean())),
    )


def _range(model: CalibratedModel, joint: Joint) -> tuple[float, float]:
    """Least and greatest value of a joint on the grid: as in training, inside its limits, and some way apart."""
    trained_low, trained_high = model.coverage.ranges[joint.name]
    spare = max(0.0, 0.5 * (_LEAST_RANGE - (trained_high - trained_low)))
    low, high = max(trained_low - spare, joint.limits[0]), min(trained_high + spare, joint.limits[1])
    if low >= high:
        raise DataError(
            "grid",
            f"{joint.name} was trained at {trained_low:.1f} .. {trained_high:.1f} {joint.unit}, beyond its limits "
            f"{joint.limits[0]:g} .. {joint.limits[1]:g}: no command inside them was measured; correct limits or zero "
            f"in the rig file and calibrate again",
        )
    return low, high


@dataclass(frozen=True)
class _Places:
    """Where prisms are in the base frame, by the drawings and by the model."""

    model: CalibratedModel
    setup: int

    def nominal_mm(self, prism: str, readings: Floats) -> Floats:
        model = self.model
        base = model.chain.base(model.nominal_values, self.setup)
        turned: Floats = (model.nominal_mm(self._rows(prism, readings)) - base.translation_mm) @ base.rotation
        return turned

    def corrected_mm(self, prism: str, readings: Floats) -> Floats:
        return np.concatenate(
            [
                self.model.base_mm(self._rows(prism, readings[start : start + _CHUNK]))
                for start in range(0, len(readings), _CHUNK)
            ]
        )

    def left_out(self, prism: str, readings: Floats) -> tuple[str, ...]:
        model = self.model
        of_machine = [effect for effect in model.effects if library()[effect.family].moves_machine]
        return left_out(of_machine, model.predictor.situation(self._rows(prism, readings)))

    def difference_mm(self, prism: str, readings: Floats) -> Floats:
        difference: Floats = self.corrected_mm(prism, readings) - self.nominal_mm(prism, readings)
        return difference

    def _rows(self, prism: str, readings: Floats) -> Observations:
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


def _curvature_mm(
    places: _Places, prisms: Sequence[str], low: Floats, high: Floats, rng: np.random.Generator
) -> Floats:
    """(joints,) RMS error of interpolating the corrections linearly between the ends of each joint's range, mm.

    Of a parabola as bent as the corrections are on the average: it is range^2 |f''| / sqrt(120).
    """
    span = high - low
    middle = rng.uniform(low + _CURVATURE_STEP * span, high - _CURVATURE_STEP * span, (_CURVATURE_POSES, len(span)))
    found = np.zeros(len(span))
    for prism in prisms:
        centre = places.difference_mm(prism, middle)
        for joint in range(len(span)):
            step = np.zeros(len(span))
            step[joint] = _CURVATURE_STEP * span[joint]
            bend = places.difference_mm(prism, middle + step) + places.difference_mm(prism, middle - step) - 2 * centre
            found[joint] += (bend**2).sum(axis=1).mean()
    scale: Floats = np.sqrt(found / len(prisms)) / _CURVATURE_STEP**2 / math.sqrt(120.0)
    return scale


def _counts(error_mm: Floats, most: int) -> list[int]:
    """How many nodes each joint gets: one more, again and again, where it lowers the squared error most for its price.

    The error of n nodes is that of two over (n - 1)^2; the price is the factor by which the grid grows.
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
