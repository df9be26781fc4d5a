"""Construction of a calibrated model, with its outliers, intervals and warnings, from fitted kinematics and effects."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import replace
from importlib import metadata

import numpy as np

from calibration.effects.context import EffectContext
from calibration.effects.library import library
from calibration.gap.adoption import Adopted
from calibration.identification.identifiability import identifiability
from calibration.identification.noise import reading_covariance, station_covariance
from calibration.identification.refinement import Prior
from calibration.identification.solve import Solution
from calibration.model.intervals import with_intervals
from calibration.model.joint_errors import joint_error_scale
from calibration.model.model import CalibratedModel, TrainingExtent
from calibration.model.prediction import Predictor
from calibration.observations import Observations, data_sha256, is_original, row_digests
from calibration.pipeline.training_warnings import training_warnings
from calibration.rig.description import Rig


def build_model(
    rig: Rig,
    rig_text: str,
    observations: Observations,
    adopted: Adopted,
    prior: Prior,
    provenance: Mapping[str, str | int | float],
) -> CalibratedModel:
    """Build the model of kinematics and effects, before a residual is learned.

    Args:
        rig: the rig description.
        rig_text: TOML text of the rig file.
        observations: training rows.
        adopted: kinematics and effects that were fitted to the training rows.
        prior: how the build tolerances were used.
        provenance: provenance of the fit that is not known here, such as seed and method.

    Returns:
        The model with its outliers, prediction intervals and warnings.
    """
    # The result of the kinematics alone stays in the model; effects are added to it.
    kinematics = replace(adopted.solution, fit=adopted.geometric, additions=None)
    fit, samples = kinematics.fit, kinematics.samples
    original = is_original(observations)
    distinct = observations.select(original)
    context = EffectContext(kinematics.chain, fit.x, observations)
    model = CalibratedModel(
        rig=rig,
        rig_text=rig_text,
        placements=kinematics.chain.placements,
        values=fit.x,
        covariance=fit.covariance,
        geometric_values=fit.x,
        nominal_values=kinematics.nominal.x,
        prior=prior,
        prior_scale=fit.prior_scale,
        excess_sigma_mm=float(np.sqrt(fit.excess_variance)),
        repeat_sigma_mm=float(np.sqrt(samples.repeat_variance)),
        effects_noise_mm=_noise_mm(kinematics, distinct),
        identifiability=kinematics.identifiability,
        coverage=TrainingExtent(
            {prism: int((distinct.prism == prism).sum()) for prism in rig.prism_names},
            {name: (float(v.min()), float(v.max())) for name, v in observations.joints.items()},
            tuple(name for name in rig.joint_names if context.is_torque_measured(name)),
            _payload(observations),
            _loads(adopted, context),
        ),
        fitted_rows=tuple(row_digests(distinct)),
        provenance={
            "data_sha256": data_sha256(observations, rig),
            "rig_sha256": hashlib.sha256(rig_text.encode()).hexdigest(),
            "fixes": len(distinct),
            **provenance,
            "search": kinematics.search,
            **_versions(),
        },
    )
    model = with_effects(model, adopted)
    outliers = (o for o in Predictor.of(model).find_outliers(observations) if original[o.row])
    model = replace(model, outliers=tuple(replace(o, row=observations.row_number(o.row)) for o in outliers))
    lacking = joint_error_scale(model, distinct, structured=adopted.structured)
    model = replace(model, joint_error_scale=lacking)
    model = with_intervals(model, distinct)
    return replace(model, warnings=(*adopted.warnings, *training_warnings(model, distinct, adopted.solution)))


def with_effects(model: CalibratedModel, taken: Adopted) -> CalibratedModel:
    """Return a model of the kinematics alone with the adopted effects added.

    Their coefficients count as parameters that the data must determine, except for those that are not reported.
    """
    solution, fit, parameters = taken.solution, taken.solution.fit, len(model.chain)
    seen = model.identifiability
    if taken.effects:
        listed = [c.name in {r.name for r in e.reported} for e in taken.effects for c in e.coefficients]
        seen = identifiability(
            solution.chain,
            solution.samples,
            fit.x,
            fit.excess_variance,
            additions=solution.additions,
            listed=np.array(listed),
        )
    return replace(
        model,
        values=fit.x[:parameters],
        covariance=fit.covariance,
        geometric_values=taken.geometric.x,
        prior_scale=fit.prior_scale,
        excess_sigma_mm=math.sqrt(fit.excess_variance),
        effects_noise_mm=math.sqrt(model.known_noise_mm2 + 3.0 * fit.excess_variance),
        effects=taken.effects,
        effects_reason=taken.reason,
        identifiability=seen,
    )


def _payload(observations: Observations) -> tuple[float, float] | None:
    """Return the lowest and highest `payload_kg`; None if no row has it."""
    payload = observations.extra.get("payload_kg", np.empty(0))
    measured = payload[np.isfinite(payload)]
    return (float(measured.min()), float(measured.max())) if len(measured) else None


def _loads(adopted: Adopted, context: EffectContext) -> dict[str, tuple[float, float]]:
    """Return the lowest and highest load on every joint that has an effect of its load."""
    loaded = {effect.where for effect in adopted.effects if library()[effect.family].load_kind == "torque"}
    loads = {name: context.torque(name) for name in sorted(loaded)}
    known = {name: load[np.isfinite(load)] for name, load in loads.items()}
    return {name: (float(load.min()), float(load.max())) for name, load in known.items() if len(load)}


def _noise_mm(solution: Solution, observations: Observations) -> float:
    """Return the RMS 3-D noise of one fix due to station, readings, timing, repeats and errors of the kinematics."""
    chain, fit, samples = solution.chain, solution.fit, solution.samples
    lin = chain.linearise(fit.x, samples.data)
    station = station_covariance(chain.rig, observations.position_mm, observations.sigma_mm)
    readings = reading_covariance(chain.rig, lin.joint_jacobian, samples.rates)
    mean = sum(float(np.trace(c, axis1=1, axis2=2).mean()) for c in (station, readings))
    return float(np.sqrt(mean + 3.0 * (fit.excess_variance + samples.repeat_variance)))


def _versions() -> dict[str, str]:
    return {name: metadata.version(name) for name in ("rigcal", "numpy", "scipy", "numba", "lightgbm")}
