"""The compiled machine agrees with the readable kinematics and covariances, and predicts one row as it does many."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.effects.columns import NO_JOINT
from calibration.errors import CalibrationError
from calibration.identification.noise import covariance_by_joints, reading_covariance, station_covariance
from calibration.kinematics import fix_loops
from calibration.kinematics.chain import Chain, ChainData, Placement, X, Y, Z, rotation_about
from calibration.kinematics.compiled_chain import CompiledChain
from calibration.model.prediction import Predictor
from calibration.observations import Floats
from calibration.rig.description import Rig, parse_rig, shipped_rig
from tests.calibration.conftest import Session
from tests.calibration.kinematics.numpy_chain import NumpyChain

RIGS = Path(__file__).parents[2] / "rigs"
ROWS, COEFFICIENTS = 60, 3
COEFFICIENT_JOINT = np.array([0, 1, NO_JOINT])


def rig(name: str) -> Rig:
    path = RIGS / f"{name}.toml"
    return parse_rig(path.read_text(encoding="utf-8"), path.name) if path.exists() else shipped_rig(name)


class Case:
    """A machine with errors at two set-ups, rows anywhere, and an uncertainty that is singular."""

    def __init__(self, name: str) -> None:
        rng = np.random.default_rng(1)
        self.rig = rig(name)
        turn = rotation_about(Z, 0.7) @ rotation_about(Y, -0.3) @ rotation_about(X, 0.2)
        placements = {"a": Placement.identity(), "b": Placement(turn, np.array([9000.0, -200.0, 300.0]))}
        self.chain = Chain(self.rig, placements)
        self.x = rng.normal(0.0, [10.0 if p.unit == "mm" else 0.05 for p in self.chain.parameters])
        readings = np.column_stack([rng.uniform(*joint.limits, ROWS) for joint in self.rig.joints])
        self.data = ChainData(readings, rng.integers(0, len(self.rig.prisms), ROWS), rng.integers(0, 2, ROWS))
        root = rng.normal(size=(len(self.chain) + COEFFICIENTS, 20))
        root[0] = 0.0
        self.covariance: Floats = root @ root.T
        self.column = rng.normal(size=(ROWS, COEFFICIENTS))
        self.column[:, COEFFICIENT_JOINT == NO_JOINT] = 0.0
        self.shift_mm = rng.normal(size=(ROWS, 3, COEFFICIENTS))
        self.sigma_mm = np.where(np.arange(ROWS)[:, None] % 3 == 0, rng.uniform(1.0, 2.0, (ROWS, 3)), np.nan)
        self.rates = rng.normal(size=readings.shape)
        self.variance = rng.uniform(1e-5, 1e-3, readings.shape)
        self.machine = CompiledChain(self.chain, self.x, self.covariance, COEFFICIENT_JOINT, 0.5)


@pytest.fixture(params=["swdt82", "ys100", "ur10", "arm7", "lift_arm", "torso"])
def case(request: pytest.FixtureRequest) -> Case:
    return Case(request.param)


def test_places_and_derivatives_are_those_of_the_chain(case: Case) -> None:
    expected = NumpyChain(case.chain).linearise(case.x, case.data)
    found = case.machine.linearise(case.data, case.column, case.shift_mm)
    turn = case.machine.rotations(case.data)
    origin = np.array([case.chain.base(case.x, setup).translation_mm for setup in case.data.setup.tolist()])
    np.testing.assert_allclose(found.position_mm, expected.position_mm, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose((turn @ found.prism_mm[:, :, None])[:, :, 0] + origin, expected.position_mm, atol=1e-9)
    np.testing.assert_allclose(
        found.frames_mm[:, 1:], NumpyChain(case.chain).frames_mm(case.x, case.data), rtol=0.0, atol=1e-9
    )
    np.testing.assert_allclose(turn @ found.joint_jacobian, expected.joint_jacobian, rtol=0.0, atol=1e-9)
    jacobian = turn @ found.jacobian
    np.testing.assert_allclose(jacobian[:, :, :-COEFFICIENTS], expected.jacobian, rtol=0.0, atol=1e-9)
    by_coefficient = expected.joint_jacobian[:, :, COEFFICIENT_JOINT] * case.column[:, None, :] + turn @ case.shift_mm
    np.testing.assert_allclose(jacobian[:, :, -COEFFICIENTS:], by_coefficient, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(case.machine.locate(case.data).position_mm, found.position_mm)


def test_covariances_are_those_of_the_formulas(case: Case) -> None:
    lin = NumpyChain(case.chain).linearise(case.x, case.data)
    by_coefficient = lin.joint_jacobian[:, :, COEFFICIENT_JOINT] * case.column[:, None, :]
    by_coefficient = by_coefficient + case.machine.rotations(case.data) @ case.shift_mm
    jacobian = np.concatenate([lin.jacobian, by_coefficient], axis=2)
    located, of_fix, of_parameters = case.machine.spread(
        case.data, case.column, case.shift_mm, case.sigma_mm, case.rates, case.variance, jacobian=False
    )
    np.testing.assert_allclose(located.position_mm, lin.position_mm, rtol=0.0, atol=1e-9)
    expected = jacobian @ case.covariance @ jacobian.transpose(0, 2, 1)
    np.testing.assert_allclose(of_parameters, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    expected = station_covariance(case.rig, lin.position_mm, case.sigma_mm) + 0.25 * np.eye(3)
    velocity = reading_covariance(case.rig, lin.joint_jacobian, case.rates)
    velocity = velocity - reading_covariance(case.rig, lin.joint_jacobian, np.zeros_like(case.rates))
    expected = expected + velocity + covariance_by_joints(lin.joint_jacobian, case.variance)
    np.testing.assert_allclose(of_fix, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_what_a_learner_adds_is_turned_into_the_stations_frame_and_counts_as_far_as_it_is_trusted(case: Case) -> None:
    rng = np.random.default_rng(2)
    estimate, weight, of_base = rng.normal(size=(ROWS, 3)), rng.uniform(size=(ROWS, 1)), rng.uniform(size=(ROWS, 3))
    of_fix, of_parameters = (np.eye(3) + rng.uniform(-0.2, 0.2, (ROWS, 3, 3)) for _ in range(2))
    place, excess = rng.normal(size=(ROWS, 3)), np.array([[4.0, 4.0, 4.0], [1.0, 2.0, 3.0]])
    setup, bases = case.data.setup, case.machine.bases
    position, sigma = np.empty((ROWS, 3)), np.empty((ROWS, 3))
    fix_loops.add_learned(
        setup, bases, place, estimate, weight[:, 0], of_fix, of_parameters, of_base, 0.7, excess, position, sigma
    )
    turn = case.machine.rotations(case.data)
    np.testing.assert_allclose(position - place, np.einsum("nij,nj->ni", turn, estimate), rtol=0.0, atol=1e-12)
    fix, parameters = (np.diagonal(covariance, axis1=1, axis2=2) for covariance in (of_fix, of_parameters))
    lacking = np.einsum("nij,nj->ni", turn**2, (1.0 - weight) * excess[0] + weight * excess[1])
    expected = fix + parameters - 0.7 * weight * (parameters - of_base) + lacking
    np.testing.assert_allclose(sigma**2, expected, rtol=1e-12)


def test_a_rate_that_was_not_measured_is_none(case: Case) -> None:
    unmeasured, standing = np.full_like(case.rates, np.nan), np.zeros_like(case.rates)
    found = [
        case.machine.spread(case.data, case.column, None, case.sigma_mm, rates, case.variance, jacobian=False)[1]
        for rates in (unmeasured, standing)
    ]
    np.testing.assert_array_equal(*found)


def test_many_rows_are_predicted_as_each_alone_and_the_same_on_threads(session: Session) -> None:
    rows = np.arange(4000) % len(session.held_out)
    many = session.held_out.select(rows)
    alone = Predictor.of(session.model).predict(session.held_out)
    together = Predictor.of(session.model).predict(many)
    np.testing.assert_array_equal(together.position_mm, alone.position_mm[rows])
    np.testing.assert_array_equal(together.sigma_mm, alone.sigma_mm[rows])
    with ThreadPoolExecutor(2) as pool:
        threaded = Predictor.of(session.model).predict(many, pool)
    np.testing.assert_array_equal(threaded.position_mm, together.position_mm)
    one = Predictor.of(session.model).predict(session.held_out.select(np.array([7])))
    np.testing.assert_array_equal(one.sigma_mm[0], alone.sigma_mm[7])
    none = Predictor.of(session.model).predict(session.held_out.select(np.arange(0)))
    assert none.position_mm.shape == none.sigma_mm.shape == (0, 3)


def test_a_prediction_follows_the_model_that_was_replaced(session: Session) -> None:
    before = Predictor.of(session.model).predict(session.held_out)
    wider = replace(session.model, excess_sigma_mm=session.model.excess_sigma_mm + 10.0)
    assert (Predictor.of(wider).predict(session.held_out).sigma_mm > before.sigma_mm).all()


@pytest.mark.parametrize("count", [40, 4000], ids=["few", "many"])
def test_a_prediction_that_is_not_finite_is_refused_with_its_row(session: Session, count: int) -> None:
    rows = session.held_out.select(np.arange(count) % len(session.held_out))
    rates = np.zeros(count)
    rates[count - 3] = 1e200  # its square is infinite, and so is the uncertainty
    rows = replace(rows, extra={**rows.extra, f"{session.model.rig.joint_names[0]}_rate": rates})
    with pytest.raises(CalibrationError, match=f"of {rows.row_name(count - 3)} is not a finite number; check that row"):
        Predictor.of(session.model).predict(rows)
