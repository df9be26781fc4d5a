"""What residual learners see of an observation: every column by its name, and how the base's being off moves it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calibration.kinematics.chain import Chain, ChainData, Placement, X, Y, Z, rotation_about
from calibration.kinematics.compiled_chain import CompiledChain, Located
from calibration.kinematics.torques import GravityModel, torque_columns
from calibration.residual.features import DEFLECTION, Extractor, Features
from calibration.rig.description import shipped_rig

ROWS = 20
SMALL_RAD = 1e-6


@pytest.fixture
def chain() -> Chain:
    return Chain(shipped_rig("swdt82"), {"": Placement(rotation_about(Z, 0.4), np.array([0.0, 9000.0, 100.0]))})


@pytest.fixture
def readings(chain: Chain) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.column_stack([rng.uniform(*joint.limits, ROWS) for joint in chain.rig.joints])


@pytest.fixture
def located(chain: Chain, readings: np.ndarray) -> Located:
    prism = np.arange(ROWS) % len(chain.rig.prisms)
    return CompiledChain(chain, np.zeros(len(chain))).linearise(
        ChainData(readings, prism, np.zeros(ROWS, dtype=np.intp))
    )


def seen(chain: Chain, readings: np.ndarray, located: Located, *signals: str) -> Features:
    extra = {"valve_mA": np.arange(float(ROWS)), "theta4_Nm": np.where(np.arange(ROWS) < 5, 7.0, np.nan)}
    return Extractor(chain, np.zeros(len(chain)), signals)(readings, located, extra)


def test_joints_frames_and_prism_come_first_and_have_their_names(
    chain: Chain, readings: np.ndarray, located: Located
) -> None:
    found = seen(chain, readings, located, "valve_mA")
    np.testing.assert_array_equal(
        found.columns(["theta4_deg", "L3_mm"]), readings[:, [chain.joint_index["theta4"], -1]]
    )
    np.testing.assert_array_equal(found.columns([f"frame3_{axis}_mm" for axis in "xyz"]), located.frames_mm[:, 3])
    np.testing.assert_array_equal(found.columns([f"prism_{axis}_mm" for axis in "xyz"]), located.prism_mm)
    assert found.names[-1] == "valve_mA"
    assert found.table().shape == (ROWS, len(found.names))


def test_signals_are_in_the_order_asked_for_whether_measured_computed_or_absent(
    chain: Chain, readings: np.ndarray, located: Located
) -> None:
    torque = torque_columns(chain.rig)[chain.joint_index["theta4"]]
    found = seen(chain, readings, located, DEFLECTION[2], "no_such_mA", torque, "valve_mA", DEFLECTION[0])
    loads = GravityModel(chain, np.zeros(len(chain)))(readings, {})
    loads[:5, chain.joint_index["theta4"]] = 7.0
    turning = [joint.kind == "revolute" for joint in chain.rig.joints]
    bent = np.einsum("nij,nj->ni", located.joint_jacobian, loads * turning * math.degrees(1e-7))
    expected = [bent[:, 2], np.full(ROWS, np.nan), loads[:, chain.joint_index["theta4"]], np.arange(ROWS), bent[:, 0]]
    np.testing.assert_allclose(found.signals, np.column_stack(expected), rtol=1e-12)


def test_the_last_parameters_shift_and_turn_the_base_about_its_own_axes(
    chain: Chain, readings: np.ndarray, located: Located
) -> None:
    jacobian = seen(chain, readings, located).parameter_jacobian
    np.testing.assert_array_equal(jacobian[:, :, :-6], located.jacobian[:, :, : chain.base_start])
    np.testing.assert_array_equal(jacobian[:, :, -6:-3], np.broadcast_to(np.eye(3), (ROWS, 3, 3)))
    for axis in (X, Y, Z):
        turned = located.prism_mm @ (rotation_about(axis, SMALL_RAD) - rotation_about(axis, -SMALL_RAD)).T
        np.testing.assert_allclose(jacobian[:, :, axis - 3], turned / (2.0 * SMALL_RAD), rtol=0.0, atol=1e-4)
