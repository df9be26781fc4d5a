"""A Gaussian process on the joints' errors: the residual is J_q times a sum of curves, selected by their evidence.

Bending, slip and wrong readings in an arm act at a joint, and move the tip by that joint's lever arm, which is known
from the kinematics. So the process models the errors of the joints instead of those of the tip: error = sum over terms
of lever * f(variables), where a lever is a column of the joint Jacobian or an axis of the base frame, and f is a
Gaussian process of one or two variables among the joints' values, their loads, directions, rates and all signals.
Terms are selected by their evidence (`curve_search`). The parameters of the kinematics are corrected together with the
curves, as their fit had absorbed a part of what the curves now explain.

Curves are finite sums (`curves`), so that the work is proportional to the number of rows and not to its cube.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calibration.numerics.stored_arrays import read_npz, write_npz
from calibration.observations import Floats
from calibration.residual.features import Features, is_place
from calibration.residual.gaussian.curve_search import CurveSearch, Rows, Terms
from calibration.residual.gaussian.curves import Curve, CurveSum, Variable

_FILE = "gaussian_process.npz"
_META = "gaussian_process.json"

_WHOLE_TURN_DEG = 300.0  # an angle that covers more than this is periodic
_MOST_ROWS = 1500  # to select terms on, and in a block of the sums over all rows


@dataclass(frozen=True)
class CurveTerms:
    """Terms selected on some rows, with the name of each variable and whether it is periodic."""

    variables: tuple[tuple[str, bool], ...]
    terms: Terms


@dataclass(frozen=True)
class GaussianProcess:
    """A fitted process.

    Attributes:
        names: names of the features that are the variables, one for each axis.
        axes: variables, in the order of `names`.
        curves: terms over these variables.
        weights: weights of the curves' waves, deg or mm.
        parameters: (p,) corrections of the parameters of `Features.parameter_jacobian`, mm or rad.
        found: terms with which it was fitted; not stored.
    """

    kind: ClassVar[str] = "gp"

    names: tuple[str, ...]
    axes: tuple[Variable, ...]
    curves: tuple[Curve, ...]
    weights: Floats
    parameters: Floats
    found: CurveTerms | None = field(default=None, compare=False)

    @cached_property
    def _sum(self) -> CurveSum:
        return CurveSum(self.axes, self.curves, self.weights)

    def predict(self, features: Features) -> Floats:
        """Return the (n, 3) estimate of the residual in the base frame, mm."""
        moved = self._sum.moved_mm(features.columns(self.names), features.joint_jacobian)
        return moved + features.parameter_jacobian @ self.parameters

    def fits(self, features: Features) -> bool:
        """Return True if its variables are among these columns, and its levers and parameters match the rig's."""
        levers = features.joint_jacobian.shape[2] + 3
        return (
            set(self.names) <= set(features.names)
            and all(curve.lever < levers for curve in self.curves)
            and self.parameters.shape == features.parameter_jacobian.shape[2:]
        )

    def to_files(self) -> dict[str, bytes]:
        """Return weights as an npz file without pickled objects, and axes and curves as JSON."""
        document = {
            "axes": [
                {"feature": name, "low": a.low, "high": a.high, "is_periodic": a.is_periodic}
                for name, a in zip(self.names, self.axes, strict=True)
            ],
            "curves": [{"lever": c.lever, "axes": c.axes, "counts": c.counts} for c in self.curves],
        }
        arrays = {"weights": self.weights, "parameters": self.parameters}
        return {_FILE: write_npz(arrays), _META: json.dumps(document, indent=1).encode()}

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> GaussianProcess:
        """Restore from `to_files`; KeyError, TypeError or ValueError if parts are missing or do not match."""
        document = json.loads(files[_META])
        stored = read_npz(files[_FILE])
        weights, parameters = (np.asarray(stored[k], dtype=np.float64) for k in ("weights", "parameters"))
        axes = tuple(Variable(float(a["low"]), float(a["high"]), bool(a["is_periodic"])) for a in document["axes"])
        curves = tuple(
            Curve(int(c["lever"]), tuple(map(int, c["axes"])), tuple(map(int, c["counts"]))) for c in document["curves"]
        )
        for axis in axes:
            axis.check()
        for curve in curves:
            curve.check(axes)
        if weights.shape != (sum(c.size for c in curves),) or parameters.ndim != 1:
            raise ValueError("the weights of the Gaussian process do not match its curves")
        if not (np.isfinite(weights).all() and np.isfinite(parameters).all()):
            raise ValueError("the Gaussian process has weights that are not finite")
        return cls(tuple(str(a["feature"]) for a in document["axes"]), axes, curves, weights, parameters)


def fit_gaussian_process(
    features: Features, target_mm: Floats, seed: int, start: CurveTerms | None = None
) -> GaussianProcess | None:
    """Select terms and estimate their amplitudes, lengths and weights.

    Args:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame.
        seed: seed of the draw of rows on which terms are selected, if there are more than 1,500.
        start: terms found for most of these rows, which save much of the search.

    Returns:
        The fitted process, or None if no term has significant evidence or nothing varies.
    """
    names, axes = _variables(features)
    if not names or not target_mm.any():
        return None
    values = features.columns(names)
    scaled = np.column_stack([a.scaled(v) for a, v in zip(axes, values.T, strict=True)])
    some = np.sort(np.random.default_rng(seed).permutation(len(features))[:_MOST_ROWS])
    joints = features.joint_jacobian.shape[2]
    own = {j: names.index(features.names[j]) for j in range(joints) if features.names[j] in names}
    moved = np.sqrt((features.parameter_jacobian**2).sum(axis=1).mean(axis=0))
    unit = np.where(moved > 0.0, 1.0 / np.where(moved > 0.0, moved, 1.0), 0.0)

    def rows(of: NDArray[np.intp]) -> Rows:
        along_base = np.broadcast_to(np.eye(3), (len(of), 3, 3))
        levers = np.concatenate([features.joint_jacobian[of], along_base], axis=2)
        return Rows(axes, scaled[of], levers, features.parameter_jacobian[of] * unit, target_mm[of])

    variables = tuple((name, axis.is_periodic) for name, axis in zip(names, axes, strict=True))
    known = start.terms if start is not None and start.variables == variables else None
    search = CurveSearch(rows(some), own, known)
    search.run()
    if not search.curves:
        return None
    p = len(unit)
    size = p + sum(curve.size for curve in search.curves)
    gram, moment = np.zeros((size, size)), np.zeros(size)
    for part in np.array_split(np.arange(len(features)), math.ceil(len(features) / _MOST_ROWS)):
        matrix = rows(part).matrix(search.curves)
        gram += matrix.T @ matrix
        moment += matrix.T @ target_mm[part].ravel()
    weights = search.weights(gram, moment)
    used = sorted({axis for curve in search.curves for axis in curve.axes})
    curves = tuple(replace(c, axes=tuple(used.index(a) for a in c.axes)) for c in search.curves)
    return GaussianProcess(
        tuple(names[a] for a in used),
        tuple(axes[a] for a in used),
        curves,
        weights[p:],
        weights[:p] * unit,
        CurveTerms(variables, search.terms),
    )


def _variables(features: Features) -> tuple[tuple[str, ...], tuple[Variable, ...]]:
    """Return the variables of curves: joints and signals that vary, without positions that follow from the joints."""
    table = features.table()
    names, axes = [], []
    for name, values in zip(features.names, table.T, strict=True):
        known = values[np.isfinite(values)]
        if is_place(name) or len(known) == 0 or np.ptp(known) <= 1e-9 * max(1.0, float(np.abs(known).max())):
            continue
        goes_round = name in features.names[: features.joint_jacobian.shape[2]] and name.endswith("_deg")
        names.append(name)
        axes.append(
            Variable(float(known.min()), float(known.max()), goes_round and bool(np.ptp(known) > _WHOLE_TURN_DEG))
        )
    return tuple(names), tuple(axes)
