"""Build the calibration report's input from a calibrated model and its evaluations."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime

import numpy as np

from calibration.effects.base import FittedCoefficient
from calibration.effects.fitted import AppliedEffects
from calibration.evaluation.evaluation import Evaluation, instrument_noise_mm
from calibration.evaluation.latency import Latency
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Observations
from calibration.residual.learners import tree_importance
from daemon.report.calibration.inputs import (
    STAGES,
    EffectLine,
    ErrorTable,
    Floats,
    OutlierLine,
    ParameterLine,
    ReportInput,
    SetupLine,
)
from daemon.report.front import Facts
from daemon.report.words import readable_unit
from drivers.clock import NS_PER_S

_LIBRARIES = ("rigcal", "numpy", "scipy", "numba", "lightgbm")
# Unit of a coefficient -> ending of its name, factor, and unit as people read it.
_SMALL_UNITS = {"rad": ("_rad", 1e3, "mrad"), "rad/(N m)": ("_rad_per_Nm", 1e6, "mrad/(kN m)")}
_LABELS = {
    "fixes": "observations fitted",
    "data_sha256": "SHA-256 of the observations fitted",
    "rig_sha256": "SHA-256 of the rig file",
    "search": "global search",
    "residual_seed": "seed of the residual",
}


def report_input(
    training: Evaluation,
    held_out: Evaluation | None,
    *,
    made_utc_ns: int | None = None,
    sources: Mapping[str, str] | None = None,
    setups: Sequence[SetupLine] = (),
    latencies: Mapping[str, Latency | str] | None = None,
    stations: Mapping[str, str] | None = None,
    facts: Facts | None = None,
) -> ReportInput:
    """Gather the content of a calibration report.

    Args:
        training: the model on the rows it was fitted to.
        held_out: the model on rows it never saw, if there are any.
        made_utc_ns: time of the report; without it the same model and rows give the same report.
        sources: label -> text: files or sessions of the data, and the model's hash.
        setups: station set-ups and control points, where known.
        latencies: session -> latency of its fixes, or why it is unknown; None for data without sessions.
        stations: session -> name of the station that measured it, for the latencies.
        facts: the first lines of the report; derived from rows and model by default.
    """
    model = training.model
    judged = training if held_out is None else held_out
    learner = model.residual.learner if model.residual else None
    return ReportInput(
        rig=model.rig.name,
        joints=model.rig.joints,
        training=_error_table(training),
        held_out=None if held_out is None else _error_table(held_out),
        noise_mm=model.noise_mm,
        instrument_mm=instrument_noise_mm(judged.model, judged.observations),
        residual=learner.kind if learner else None,
        residual_reason=model.residual_reason,
        parameters=list(_parameters(model)),
        n_parameters=model.identifiability.parameters,
        rank=model.identifiability.rank,
        unidentifiable=model.identifiability.unidentifiable,
        outliers=list(_outliers(training)),
        warnings=judged.warnings,
        ignored_columns=judged.observations.ignored_columns,
        provenance=provenance(model, made_utc_ns, sources or {}),
        setups=setups,
        latencies=latencies or {},
        stations=stations or {},
        effects=list(_effects(training)),
        effects_reason=model.effects_reason,
        expected=judged.expected,
        axes=judged.axes,
        facts=facts or facts_of(training.observations, model, made_utc_ns=made_utc_ns),
        importance=[(line.feature, line.share) for line in tree_importance(learner) or () if line.share > 0.0],
    )


def facts_of(
    observations: Observations,
    model: CalibratedModel,
    *,
    name: str = "",
    made_utc_ns: int | None = None,
    tolerance_mm: float | None = None,
) -> Facts:
    """Derive the first lines of a report from rows and model, which do not contain operators and instruments.

    Args:
        observations: the rows that the model was fitted to.
        model: the model.
        name: name of the model, e.g. its directory.
        made_utc_ns: time of the report.
        tolerance_mm: permitted root mean square error; None if none is stated.
    """
    return Facts(
        rig=model.rig.name,
        model=name or f"fitted to data with SHA-256 {str(model.provenance.get('data_sha256', ''))[:12]}...",
        sessions=np.unique(observations.session).tolist(),
        setups=np.unique(observations.setup).tolist(),
        made_utc_ns=made_utc_ns,
        tolerance_mm=tolerance_mm,
    )


def _error_table(evaluation: Evaluation) -> ErrorTable:
    model, observations = evaluation.model, evaluation.observations
    predictor = Predictor.of(model)
    return ErrorTable(
        prism=observations.prism,
        joints=observations.joints,
        position_mm=measured_in_base_mm(model, observations),
        errors_mm={stage: predictor.to_base(observations, evaluation.errors_mm[stage]) for stage in STAGES},
    )


def measured_in_base_mm(model: CalibratedModel, observations: Observations) -> Floats:
    """Return the (n, 3) measured positions in the rig's base frame."""
    chain = model.chain
    origin = np.array([chain.base(model.values, s).translation_mm for s in range(len(chain.setups))])
    from_base_mm = observations.position_mm - origin[chain.bind(observations).setup]
    return Predictor.of(model).to_base(observations, from_base_mm)


def _parameters(model: CalibratedModel) -> Iterator[ParameterLine]:
    for p in model.parameters:
        if math.isinf(p.prior_sigma):
            continue  # no prior, so there is no tolerance to compare with
        scale, unit = (math.degrees(1.0), "deg") if p.unit == "rad" else (1.0, p.unit)
        yield ParameterLine(
            name=p.name,
            unit=unit,
            correction=p.value * scale,
            sigma=p.standard_error * scale,
            tolerance=p.prior_sigma * scale,
            determined=p.name not in model.identifiability.marked,
        )


def _effects(training: Evaluation) -> Iterator[EffectLine]:
    model, observations = training.model, training.observations
    context = Predictor.of(model).context(observations)
    for effect in model.effects:
        alone = AppliedEffects((effect,), model.chain)
        columns = alone.columns(context)
        if columns.shift_mm is None:
            change, unit = np.abs(columns.column @ alone.values).max(), model.rig.joint(effect.where).unit
        else:
            change, unit = np.linalg.norm(columns.shifted_mm(alone.values), axis=1).max(), "mm"
        yield EffectLine(
            family=effect.family,
            where=effect.where,
            change=float(change),
            unit=unit,
            coefficients=[_readable(c) for c in effect.reported],
        )


def _readable(coefficient: FittedCoefficient) -> tuple[str, float, float, str]:
    """Return name, value, standard error and unit, scaled to avoid long rows of zeros."""
    suffix, scale, unit = _SMALL_UNITS.get(
        coefficient.unit, ("", *readable_unit(coefficient.unit, abs(coefficient.value)))
    )
    name = coefficient.name.removesuffix(suffix)
    return name, coefficient.value * scale, coefficient.standard_error * scale, unit


def _outliers(training: Evaluation) -> Iterator[OutlierLine]:
    for outlier in training.outliers:
        yield OutlierLine(
            row=training.observations.row_name(outlier.row),
            prism=str(training.observations.prism[outlier.row]),
            error_mm=float(np.linalg.norm(training.errors_mm["effects"][outlier.row])),
            sigmas=outlier.sigma,
        )


def provenance(model: CalibratedModel, made_utc_ns: int | None, sources: Mapping[str, str]) -> dict[str, str]:
    """Return label -> text: time, sources, the model's own provenance, and versions.

    Args:
        model: the model.
        made_utc_ns: time of the report; None to leave it out.
        sources: further lines, before those of the model.
    """
    lines = {"rig": model.rig.name, **sources}
    if made_utc_ns is not None:
        made = datetime.fromtimestamp(made_utc_ns // NS_PER_S, UTC)
        lines = {"made": f"{made:%Y-%m-%d %H:%M} UTC", **lines}
    facts = {name: value for name, value in model.provenance.items() if name not in _LIBRARIES}
    lines |= {_LABELS.get(name, name.replace("_", " ")): str(value) for name, value in facts.items()}
    lines["prior"] = model.prior if model.prior_scale == 1 else f"{model.prior}, tolerances x {model.prior_scale:.3g}"
    versions = [f"{name} {model.provenance[name]}" for name in _LIBRARIES if name in model.provenance]
    return lines | {"versions": ", ".join(versions)}
