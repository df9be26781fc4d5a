"""Measured torques: used with either sign, and missed where they were used in training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.kinematics import Chain
from calibration.observations import Observations, parse_observations
from calibration.pipeline import evaluate, identify
from calibration.rig import Rig, shipped_rig
from calibration.torques import gravity_torques
from simulators.dataset import simulate_observations
from simulators.effects.spec import parse_effects
from simulators.truth import RigTruth
from tests.calibration.conftest import rig_text, rms

EFFECTS = "joint_compliance@theta2:compliance_rad_per_Nm=4e-7,joint_compliance@theta3:compliance_rad_per_Nm=6e-7"


def fixes(rig: Rig, truth: RigTruth, poses: int, seed: int, sign: float) -> Observations:
    data = simulate_observations(truth, poses, seed, noise_mm=0.03)
    observations = parse_observations(data.csv_text().encode(), rig, "simulated.csv")
    torques = sign * gravity_torques(Chain(rig, {}), np.zeros(len(Chain(rig, {}))), observations)
    columns = {f"{name}_Nm": torques[:, i] for i, name in enumerate(rig.joint_names)}
    return replace(observations, extra=dict(observations.extra) | columns)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torques_that_hold_the_load_serve_as_well_as_the_load(sign: float) -> None:
    rig = shipped_rig("ys100")
    truth = RigTruth(rig, 5, perturbation=0.6, effects=parse_effects(EFFECTS))
    training, held_out = fixes(rig, truth, 60, 5, sign), fixes(rig, truth, 100, 6, sign)
    model = identify(rig, rig_text("ys100"), training)
    assert {"theta2", "theta3"} <= {effect.where for effect in model.effects}
    assert rms(evaluate(model, held_out).errors_mm["effects"]) < 0.1
    assert any("holds the load" in warning for warning in model.warnings) == (sign < 0.0)


def test_a_torque_that_was_measured_in_training_is_missed() -> None:
    rig = shipped_rig("ys100")
    truth = RigTruth(rig, 5, perturbation=0.6, effects=parse_effects(EFFECTS))
    with_torques = fixes(rig, truth, 60, 5, 1.0)
    without = replace(with_torques, extra={k: v for k, v in with_torques.extra.items() if not k.endswith("_Nm")})
    measured, computed = (identify(rig, rig_text("ys100"), data) for data in (with_torques, without))
    assert any("theta2_Nm), which this data lacks" in doubt for doubt in measured.doubts(without))
    assert any("theta2_Nm): leave the column out" in doubt for doubt in computed.doubts(with_torques))
    assert not any("torque" in doubt for doubt in (*measured.doubts(with_torques), *computed.doubts(without)))


def test_coefficients_of_effects_count_among_what_the_data_must_determine() -> None:
    rig = shipped_rig("ys100")
    truth = RigTruth(rig, 5, perturbation=0.6, effects=parse_effects(EFFECTS))
    training = fixes(rig, truth, 60, 5, 1.0)
    plain, full = (identify(rig, rig_text("ys100"), training, effects=effects) for effects in ("none", "auto"))
    coefficients = sum(len(effect.coefficients) for effect in full.effects)
    assert coefficients > 0
    assert full.identifiability.parameters == plain.identifiability.parameters + coefficients
