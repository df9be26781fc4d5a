"""Warnings about using a model for observations that differ from its training data."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from calibration.effects.context import EffectContext
from calibration.effects.fitted import missing_inputs
from calibration.effects.library import library
from calibration.kinematics.torques import torque_columns
from calibration.model.model import CalibratedModel, Outlier
from calibration.model.prediction import Predictor
from calibration.observations import Floats, Observations
from calibration.residual.features import DEFLECTION, missing_signals
from calibration.rig.limits import turns_deg

_OUTSIDE = 0.1  # of a trained range
_OUTSIDE_DEG = 1.0  # at least
_OUTSIDE_MM = 10.0
_OUTSIDE_KG = 1.0
_OUTSIDE_LOAD = 0.25  # of a trained range, whose ends are reached in fewer poses than those of a joint's range
_UNITS = {"kN m": 1e-3, "kgf m": 1.0 / 9.80665, "N mm": 1e3}
_ALIKE = 0.7  # correlation about zero, below which a factor is meaningless
_FAR = 5.0  # factor that wrong masses cannot explain
_NEAR = 2.0  # greatest ratio between a factor and the unit that explains it
_LEAST_ROWS = 10
_LEAST_LOAD = 0.01  # of the largest load of any joint; smaller loads are not compared
_SIGMAS = 3.0  # least size of a factor, in standard errors
_LISTED = 5  # rows


def model_warnings(model: CalibratedModel, observations: Observations) -> tuple[str, ...]:
    """Return warnings about using the model for observations that differ from its training data, one sentence each.

    The observations may be of any set-up.
    """
    return tuple(_warnings(model, observations)) if len(observations) else ()


def _warnings(model: CalibratedModel, observations: Observations) -> Iterator[str]:
    context = Predictor.of(model).context(observations)
    for prism in sorted(set(observations.prism.tolist())):
        if not model.coverage.fixes.get(prism):
            yield f"prism {prism!r} was never measured in training; its offset is the nominal one"
    yield from _of_readings(model, observations)
    yield from missing_inputs(model.effects, context)
    yield from _of_torques(model, context)
    yield from _of_payload(model, context)
    yield from _of_residual(model, observations)


def _of_readings(model: CalibratedModel, observations: Observations) -> Iterator[str]:
    turns = dict(zip(model.rig.joint_names, turns_deg(model.rig).tolist(), strict=True))
    for name, (low, high) in model.coverage.ranges.items():
        joint = model.rig.joint(name)
        margin = max(_OUTSIDE * (high - low), _OUTSIDE_DEG if joint.kind == "revolute" else _OUTSIDE_MM)
        above = observations.joints[name] - (low - margin)
        if turns[name] > 0.0:
            above %= turns[name]
        outside = int(((above < 0.0) | (above > high - low + 2.0 * margin)).sum())
        if outside:
            yield (
                f"{name}: {outside} of {len(above)} readings are outside the {low:.1f} .. {high:.1f} {joint.unit} "
                f"of the training data"
            )


def _of_torques(model: CalibratedModel, context: EffectContext) -> Iterator[str]:
    """Yield warnings about torques that differ from training: computed or measured, in their sign, or out of range."""
    turning = {joint.name for joint in model.rig.joints if joint.kind == "revolute"}
    used = _loads_by_name(model) & turning
    for name in sorted(used):
        before, now = name in model.coverage.torques, context.is_torque_measured(name)
        if before and not now and model.rig.masses:
            yield (
                f"the torque of {name} was measured in training ({name}_Nm), which this data lacks: it is computed "
                f"from the rig file's masses, whose error is not in any standard deviation"
            )
        elif now and not before:
            yield (
                f"the torque of {name} was computed from the rig file's masses in training and is measured here "
                f"({name}_Nm): leave the column out, or calibrate with it"
            )
    times = times_computed(context) if used else {}
    yield from torque_unit_warnings(times)
    for effect in model.effects:
        name, value = effect.where, effect.coefficients[0].value
        is_learned_from_it = effect.family == "joint_compliance" and name in model.coverage.torques
        if is_learned_from_it and times.get(name, 0.0) * value < 0.0:
            yield f"{name}_Nm has the opposite sign to training, where {effect.family}@{name} was fitted to it"
    for name, (low, high) in model.coverage.loads.items():
        load, margin = context.torque(name), _OUTSIDE_LOAD * (high - low)
        outside = int(((load < low - margin) | (load > high + margin)).sum())
        if outside:
            yield (
                f"the load on {name} is outside the {low:.0f} .. {high:.0f} N m of the training data in {outside} of "
                f"{len(load)} rows: its effect there is unknown"
            )


def _of_payload(model: CalibratedModel, context: EffectContext) -> Iterator[str]:
    """Yield warnings about payloads outside the training data, in rows where a load in use is computed from them."""
    carried, used = [mass.kg for mass in model.rig.masses if mass.payload], sorted(_loads_used(model))
    weighs = any(library()[effect.family].load_kind == "weights" for effect in model.effects)
    if not carried or not (used or weighs):
        return
    measured = [np.isfinite(context.extra(f"{name}_Nm")) for name in used]
    computed = np.full(len(context), weighs) | ~np.all(measured or [np.ones(len(context), dtype=bool)], axis=0)
    payload = context.extra("payload_kg")
    # Training data without a payload used that of the rig file.
    low, high = model.coverage.payload or (min(carried), max(carried))
    margin = max(_OUTSIDE * (high - low), _OUTSIDE_KG)
    outside = int((computed & ((payload < low - margin) | (payload > high + margin))).sum())
    if outside:
        yield (
            f"payload_kg: {outside} of {len(payload)} rows are outside the {low:g} .. {high:g} kg of the training "
            f"data; the loads that effects and residual use are beyond those in training"
        )
    missing = int((computed & np.isnan(payload)).sum())
    if missing and model.coverage.payload is not None:
        yield f"payload_kg is missing in {missing} of {len(payload)} rows: the rig file's payload is used there"


def _loads_used(model: CalibratedModel) -> set[str]:
    """Return the joints whose loads are used by effects or the residual."""
    if model.residual is not None and not set(DEFLECTION).isdisjoint(model.residual.signals):
        return set(model.rig.joint_names)
    return _loads_by_name(model)


def _loads_by_name(model: CalibratedModel) -> set[str]:
    """Return the joints whose own load is used by effects or the residual."""
    learned = model.residual.signals if model.residual is not None else ()
    columns = zip(model.rig.joint_names, torque_columns(model.rig), strict=True)
    used = {e.where for e in model.effects if library()[e.family].load_kind == "torque"}
    return used | {name for name, column in columns if column in learned}


def _of_residual(model: CalibratedModel, observations: Observations) -> Iterator[str]:
    residual = model.residual
    if residual is None:
        return
    missing = missing_signals(model.rig, observations, residual.signals)
    if missing:
        yield f"the residual was trained with {', '.join(missing)}, which this data lacks"
    known = np.isin(observations.prism, residual.prisms) & np.isin(observations.setup, model.chain.setups)
    seen = Predictor.of(model).features(observations.select(known), residual.signals)
    yield from residual.region.warnings(seen, model.rig.joints)
    strange = sorted(set(observations.prism.tolist()) - set(residual.prisms))
    if strange:
        yield f"the residual was not trained on prism {', '.join(strange)} and is left out there"


def farthest(observations: Observations, outliers: Sequence[Outlier]) -> str:
    """Return a clause that describes one or more outliers: their size, and the rows of the farthest."""
    worst = sorted(outliers, key=lambda outlier: -outlier.sigma)
    rows = observations.row_name(*sorted(outlier.row for outlier in worst[:_LISTED]))
    more = f" and {len(worst) - _LISTED} more" if len(worst) > _LISTED else ""
    return f"up to {worst[0].sigma:,.0f} sigma off, in {rows}{more}"


def times_computed(context: EffectContext) -> Mapping[str, float]:
    """Compare measured torques with the loads that are computed from the rig file's masses.

    Returns:
        Joint -> ratio of its column `<name>_Nm` to its load, for joints with a sufficient load and a ratio of more than
        three standard errors.
    """
    rows = context.observations
    extra = {name: values for name, values in rows.extra.items() if not name.endswith("_Nm")}
    computed = replace(context, observations=replace(rows, extra=extra))
    out = {}
    turning = [joint.name for joint in context.rig.joints if joint.kind == "revolute"]
    most = max((_rms(computed.torque(name)) for name in turning if context.rig.masses), default=0.0)
    for joint in context.rig.joints if context.rig.masses else ():
        if joint.kind != "revolute" or f"{joint.name}_Nm" not in rows.extra:
            continue
        measured, load = context.extra(f"{joint.name}_Nm"), computed.torque(joint.name)
        known = np.isfinite(measured)
        size = float(np.linalg.norm(measured[known]) * np.linalg.norm(load[known]))
        product = float(measured[known] @ load[known])
        if known.sum() < _LEAST_ROWS or abs(product) <= _ALIKE * size or _rms(load[known]) <= _LEAST_LOAD * most:
            continue
        squares = float(load[known] @ load[known])
        factor = product / squares
        error = _rms(measured[known] - factor * load[known]) / math.sqrt(squares)
        if computed.greatest_torque(joint.name) > 0.0 and abs(factor) > _SIGMAS * error:
            out[joint.name] = factor
    return out


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values[np.isfinite(values)] ** 2))) if np.isfinite(values).any() else 0.0


def torque_unit_warnings(times_computed: Mapping[str, float]) -> Iterator[str]:
    """Yield warnings about columns `<name>_Nm` that seem not to be in N m, one sentence for each unit."""
    columns: dict[str, list[str]] = {}
    for name, times in times_computed.items():
        if not 1.0 / _FAR < abs(times) < _FAR:
            unit = next((u for u, size in _UNITS.items() if 1.0 / _NEAR < abs(times) / size < _NEAR), "another unit")
            columns.setdefault(unit, []).append(f"{name}_Nm ({abs(times):.2g} times)")
    for unit, strange in columns.items():
        yield (
            f"measured torques differ by far from the loads of the rig file's masses, as if in {unit} or of another "
            f"shaft: {', '.join(strange)}; convert them to N m at the joint"
        )
