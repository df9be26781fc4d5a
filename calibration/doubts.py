"""What speaks against using a model for given observations: what it was never trained on, one sentence each."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from calibration.effects.base import Situation
from calibration.effects.fitted import left_out
from calibration.effects.library import library
from calibration.limits import turns_deg
from calibration.observations import Observations
from calibration.residual.features import DEFLECTION, missing_signals
from calibration.torque_doubts import times_computed, unit_doubts
from calibration.torques import torque_columns

if TYPE_CHECKING:
    from calibration.model import CalibratedModel

_OUTSIDE = 0.1  # of a trained range
_OUTSIDE_DEG = 1.0  # at least
_OUTSIDE_MM = 10.0
_OUTSIDE_KG = 1.0
_OUTSIDE_LOAD = 0.25  # of a trained range: its ends are rarer poses than those of a joint's


def doubts(model: CalibratedModel, observations: Observations) -> Iterator[str]:
    """Every doubt about using the model for these observations, whatever their set-ups."""
    if len(observations) == 0:
        return
    situation = model.predictor.situation(observations)
    for prism in sorted(set(observations.prism.tolist())):
        if not model.coverage.fixes.get(prism):
            yield f"prism {prism!r} was never measured in training; its offset is the nominal one"
    yield from _of_readings(model, observations)
    yield from left_out(model.effects, situation)
    yield from _of_torques(model, situation)
    yield from _of_payload(model, situation)
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


def _of_torques(model: CalibratedModel, situation: Situation) -> Iterator[str]:
    """Torques that are not those of training: computed where they were measured, of another sign or beyond."""
    turning = {joint.name for joint in model.rig.joints if joint.kind == "revolute"}
    used = _loads_by_name(model) & turning
    for name in sorted(used):
        before, now = name in model.coverage.torques, situation.is_torque_measured(name)
        if before and not now and model.rig.masses:
            yield (
                f"the torque of {name} was measured in training ({name}_Nm), which this data lacks: it is computed "
                f"from the rig file's masses, whose error is in no standard deviation"
            )
        elif now and not before:
            yield (
                f"the torque of {name} was computed from the rig file's masses in training and is measured here "
                f"({name}_Nm): leave the column out, or calibrate with it"
            )
    times = times_computed(situation) if used else {}
    yield from unit_doubts(times)
    for effect in model.effects:
        name, value = effect.where, effect.coefficients[0].value
        is_learned_from_it = effect.family == "joint_compliance" and name in model.coverage.torques
        if is_learned_from_it and times.get(name, 0.0) * value < 0.0:
            yield f"{name}_Nm has the other sign than in training, where {effect.family}@{name} was learned from it"
    for name, (low, high) in model.coverage.loads.items():
        load, margin = situation.torque(name), _OUTSIDE_LOAD * (high - low)
        outside = int(((load < low - margin) | (load > high + margin)).sum())
        if outside:
            yield (
                f"the load on {name} is outside the {low:.0f} .. {high:.0f} N m of the training data in {outside} of "
                f"{len(load)} rows: what it does there was never seen"
            )


def _of_payload(model: CalibratedModel, situation: Situation) -> Iterator[str]:
    """Payloads that training did not have, in rows where a load that is used is computed from them."""
    carried, used = [mass.kg for mass in model.rig.masses if mass.payload], sorted(_loads_used(model))
    weighs = any(library()[effect.family].goes_with == "weights" for effect in model.effects)
    if not carried or not (used or weighs):
        return
    measured = [np.isfinite(situation.extra(f"{name}_Nm")) for name in used]
    computed = np.full(len(situation), weighs) | ~np.all(measured or [np.ones(len(situation), dtype=bool)], axis=0)
    payload = situation.extra("payload_kg")
    # Where training had none, the rig file's payload was taken.
    low, high = model.coverage.payload or (min(carried), max(carried))
    margin = max(_OUTSIDE * (high - low), _OUTSIDE_KG)
    outside = int((computed & ((payload < low - margin) | (payload > high + margin))).sum())
    if outside:
        yield (
            f"payload_kg: {outside} of {len(payload)} rows are outside the {low:g} .. {high:g} kg of the training "
            f"data; the loads that effects and residual use are beyond what was seen"
        )
    missing = int((computed & np.isnan(payload)).sum())
    if missing and model.coverage.payload is not None:
        yield f"payload_kg is missing in {missing} of {len(payload)} rows: the rig file's payload is taken there"


def _loads_used(model: CalibratedModel) -> set[str]:
    """Joints whose load effects or the residual use."""
    if model.residual is not None and not set(DEFLECTION).isdisjoint(model.residual.signals):
        return set(model.rig.joint_names)
    return _loads_by_name(model)


def _loads_by_name(model: CalibratedModel) -> set[str]:
    """Joints whose own load effects or the residual use."""
    learned = model.residual.signals if model.residual is not None else ()
    columns = zip(model.rig.joint_names, torque_columns(model.rig), strict=True)
    used = {e.where for e in model.effects if library()[e.family].goes_with == "torque"}
    return used | {name for name, column in columns if column in learned}


def _of_residual(model: CalibratedModel, observations: Observations) -> Iterator[str]:
    residual = model.residual
    if residual is None:
        return
    missing = missing_signals(model.rig, observations, residual.signals)
    if missing:
        yield f"the residual was trained with {', '.join(missing)}, which this data lacks"
    known = np.isin(observations.prism, residual.prisms) & np.isin(observations.setup, model.chain.setups)
    seen = model.residual_features(observations.select(known), residual.signals)
    yield from residual.region.doubts(seen, model.rig.joints)
    strange = sorted(set(observations.prism.tolist()) - set(residual.prisms))
    if strange:
        yield f"the residual was not trained on prism {', '.join(strange)} and is left out there"
