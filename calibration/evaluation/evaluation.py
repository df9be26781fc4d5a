"""Evaluation of a model on observations: errors of every stage, warnings, axes and expected accuracy."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from calibration.design.accuracy import ExpectedAccuracy, expected_accuracy
from calibration.errors import DataError, UnsafeError
from calibration.identification.checks import row_warnings
from calibration.identification.noise import joint_rates, reading_covariance, station_covariance
from calibration.identification.reading_steps import rounding
from calibration.identification.samples import averaged
from calibration.identification.sweeps.circles import find_axes
from calibration.identification.sweeps.cross_check import AxisCheck, cross_check, disagreements
from calibration.model.intervals import SetupErrors
from calibration.model.model import CalibratedModel, Outlier
from calibration.model.prediction import Predictor
from calibration.model.rebase import with_refitted_base
from calibration.model.warnings import farthest, model_warnings
from calibration.numerics.single_thread import one_blas_thread
from calibration.observations import Floats, Observations, are_among, data_sha256, originals
from calibration.residual.conformal import Coverage
from calibration.residual.learners import tree_importance

_STRANGE = 3.0  # median ratio of error to expected error; 0.9 for a correct model
_STRANGE_BODY = 30.0  # median error over training scatter; above calibrated models far from training; not measured
_LEAST_TO_JUDGE = 10
_FEATURES_SHOWN = 10  # as in Zhou et al. 2022, Fig. 10
STAGES = ("nominal", "geometric", "effects", "hybrid")


@dataclass(frozen=True)
class Evaluation:
    """Errors of every stage of a model on measured rows, with warnings about model and rows.

    Attributes:
        model: the model, with the base refitted if that was requested.
        observations: the rows.
        errors_mm: stage -> (n, 3) measured minus modelled, in the station's frame.
        sigma_mm: (n, 3) standard deviation that the model predicts for the hybrid stage's errors.
        coverage: share of the hybrid stage's errors inside their intervals. If the base was refitted on these rows, the
            intervals of each half of the rows are determined from the other half.
        outliers: rows with errors larger than noise explains.
        fitted: number of the rows that the model was fitted to.
        warnings: warnings about model and data.
        axes: comparison of the model with the joint axes that single-joint sweeps among the rows show.
        expected: accuracy that the model expects over the work volume; None if the rig has no reachable pose there.
    """

    model: CalibratedModel
    observations: Observations
    errors_mm: Mapping[str, Floats]
    sigma_mm: Floats
    coverage: Coverage
    outliers: tuple[Outlier, ...]
    fitted: int
    warnings: tuple[str, ...]
    axes: tuple[AxisCheck, ...]
    expected: ExpectedAccuracy | None

    def __len__(self) -> int:
        return len(self.observations)

    def stages(self, prism: str | None = None) -> list[dict[str, str | float]]:
        """Return mean, RMS, maximum and standard deviation of the 3-D error of every stage.

        Args:
            prism: use only the rows of this prism; all rows by default.
        """
        rows = np.ones(len(self), dtype=bool) if prism is None else self.observations.prism == prism
        return [{"stage": stage, **statistics(sizes_mm(self.errors_mm[stage][rows]))} for stage in STAGES]

    def as_dict(self, seconds: float) -> dict[str, object]:
        """Return the JSON object of `calibrate` and `evaluate` (docs/reference/formats.md).

        Args:
            seconds: measured duration.
        """
        return {
            "rig": self.model.rig.name,
            "n": len(self),
            "fitted": self.fitted,
            "seconds": seconds,
            "stages": self.stages(),
            "per_prism": {prism: self.stages(prism) for prism in np.unique(self.observations.prism).tolist()},
            "effects": [effect.as_dict() for effect in self.model.effects],
            "residual": self.model.residual.learner.kind if self.model.residual else None,
            "residual_reason": self.model.residual_reason,
            "noise_mm": self.model.noise_mm,
            "identifiability": self.model.identifiability.as_dict(),
            "warnings": list(self.warnings),
            "ignored_columns": list(self.observations.ignored_columns),
            "expected_accuracy": self.expected.as_dict() if self.expected else None,
            "axes": [asdict(axis) for axis in self.axes],
            "importance": self._importance(),
            "intervals": self.coverage.as_dict(),
        }

    def _importance(self) -> list[dict[str, str | float]] | None:
        found = tree_importance(self.model.residual.learner) if self.model.residual else None
        return None if found is None else [asdict(feature) for feature in found[:_FEATURES_SHOWN]]


@one_blas_thread()
def evaluate(model: CalibratedModel, observations: Observations, *, refit_base: bool = False) -> Evaluation:
    """Compute the errors of every stage on observations.

    Args:
        model: the model.
        observations: rows with positions.
        refit_base: fit only the base transform of every set-up on these rows, for each stage separately.

    Raises:
        DataError: no rows, or rows without positions.
        UnsafeError: the model does not know a set-up, or these rows cannot determine its base.
    """
    require_positions(observations)
    effects, learned, left_out = model, model.residual is not None, None
    if refit_base:
        effects = placed = with_refitted_base(model, observations)
        if placed.residual is not None:
            effects = with_refitted_base(replace(model, residual=None), observations)
        left_out = SetupErrors.of(placed, observations)
        model = replace(placed, intervals=left_out.intervals)
    prediction = Predictor.of(model).predict(observations)
    fitted = _fitted(model, observations)
    is_training = fitted == len(observations)
    warnings = [w if is_training else f"in training: {w}" for w in model.warnings]
    if left_out is not None:
        names = ", ".join(repr(s) for s in model.placements)
        fixes = len(np.unique(originals(observations)))
        warnings.append(f"the base transform of set-up {names} was fitted on these {fixes} fixes")
        if learned and model.residual is None:
            warnings.append(f"the residual is left out here, in all rows: {model.residual_reason}")
    warnings += [w for w in model_warnings(model, observations) if w not in warnings]
    errors = {
        "nominal": observations.position_mm - Predictor.of(effects).nominal_mm(observations),
        "geometric": observations.position_mm - Predictor.of(effects).geometric_mm(observations),
        "effects": observations.position_mm - Predictor.of(effects).effects_mm(observations),
        "hybrid": observations.position_mm - prediction.position_mm,
    }
    left_mm = statistics(sizes_mm(errors["hybrid"]))["rms_mm"]
    _, rounded = rounding(Predictor.of(effects).context(observations), left_mm)
    warnings += [
        w for w in (*row_warnings(model.rig, observations), *([rounded] if rounded else [])) if w not in warnings
    ]
    strange = list(_strange(errors["hybrid"], prediction.formal_mm, model.noise_mm, refit_base=refit_base))
    outliers = Predictor.of(effects).find_outliers(observations)
    warnings += strange
    if outliers and not (strange or rounded or is_training):
        warnings.append(
            f"{len(outliers)} of {len(observations)} fixes are farther off than noise explains, "
            f"{farthest(observations, outliers)}; the errors include them"
        )
    coverage = prediction.coverage(errors["hybrid"]) if left_out is None else left_out.coverage()
    axes = _axes(effects, observations)
    warnings += [w for w in disagreements(axes) if w not in warnings]
    return Evaluation(
        model,
        observations,
        errors,
        prediction.sigma_mm,
        coverage,
        outliers,
        fitted,
        tuple(warnings),
        axes,
        _expected(model),
    )


def _fitted(model: CalibratedModel, observations: Observations) -> int:
    """Return how many rows the model was fitted to; older models recognise only their whole training table."""
    if model.fitted_rows:
        return int(are_among(observations, model.fitted_rows).sum())
    is_same = model.provenance.get("data_sha256") == data_sha256(observations, model.rig)
    return len(observations) if is_same else 0


def _strange(error_mm: Floats, formal_mm: Floats, noise_mm: float, *, refit_base: bool) -> Iterator[str]:
    """Yield a warning if errors are far above the expected ones: the model does not, or no longer, fit this machine.

    The uncertainty of a base that was fitted to these same rows includes their scatter and can explain errors of any
    size. With such a base, the errors are therefore also compared with the scatter of the training.
    """
    size_mm = sizes_mm(error_mm)
    times, most = float(np.median(size_mm / sizes_mm(formal_mm))), _STRANGE
    where, moved, scale = "", "a moved base or prism", "the expected error"
    if times <= most and refit_base:
        times, most = float(np.median(size_mm)) / noise_mm, _STRANGE_BODY
        where, moved, scale = ", whatever its base transform", "a moved prism", "the scatter of its training"
    if len(error_mm) >= _LEAST_TO_JUDGE and times > most:
        yield (
            f"the model does not describe this data{where}: half of the fixes are off by more than {times:,.0f} times "
            f"{scale}; check for another machine or rig file, {moved}, or a column that was read differently"
        )


def _axes(model: CalibratedModel, observations: Observations) -> tuple[AxisCheck, ...]:
    """Compare the model with the single-joint sweeps among the rows, with joint values corrected by the effects.

    The uncertainty of the effects' coefficients is neglected, so an axis is reported as disagreeing slightly earlier.
    """
    parameters = len(model.chain)
    axes = find_axes(model.chain, averaged(model.chain, Predictor.of(model).corrected(observations)))
    return cross_check(model.chain, model.values, model.covariance[:parameters, :parameters], axes)


def _expected(model: CalibratedModel) -> ExpectedAccuracy | None:
    try:
        return expected_accuracy(model, np.random.default_rng(0))
    except UnsafeError:
        return None


def require_positions(observations: Observations) -> None:
    """Raise DataError if there are no rows, or a row has no measured position."""
    if len(observations) == 0:
        raise DataError("observations", "there are none")
    if not np.isfinite(observations.position_mm).all():
        raise DataError("observations", "every row needs a measured position", column="x_mm")


def sizes_mm(error_mm: Floats) -> Floats:
    """Return the norms (n,) of (n, 3) errors."""
    return np.asarray(np.linalg.norm(error_mm, axis=1))


def statistics(size_mm: Floats) -> dict[str, float]:
    """Return the statistics of (n,) sizes of errors, for JSON."""
    return {
        "mean_mm": float(size_mm.mean()),
        "rms_mm": float(np.sqrt((size_mm**2).mean())),
        "max_mm": float(size_mm.max()),
        "std_mm": float(size_mm.std()),
    }


def instrument_noise_mm(model: CalibratedModel, observations: Observations) -> float:
    """Return the RMS 3-D error, mm, that station and encoders explain on these rows."""
    lin = Predictor.of(model).linearise(observations)
    station: Floats = station_covariance(model.rig, lin.position_mm, observations.sigma_mm)
    readings = reading_covariance(model.rig, lin.joint_jacobian, joint_rates(model.rig, observations))
    return math.sqrt(float(np.trace(station + readings, axis1=1, axis2=2).mean()))
