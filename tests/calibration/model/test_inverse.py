"""What joint values to command, so that the true prism is where it should be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize

from calibration.errors import DataError, UnsafeError
from calibration.model.inverse import CLOSURE_MM, inverse
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Floats, Observations, parse_observations
from calibration.pipeline.calibrate import identify, train_residual
from calibration.residual.selection import Kind
from calibration.rig.description import parse_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import Session, rig_text
from tests.simulated.observations import simulate_observations

RIGS = Path(__file__).parents[2] / "rigs"
HIDDEN = "backlash@theta4:width_rad=3e-3,encoder_harmonic@theta3:cosk_rad=2e-3:sink_rad=1e-3"


def trained(text: str, hidden: str, effects: str, residual: Kind) -> CalibratedModel:
    """A model of a simulated machine with hidden effects, some of which it has as effects."""
    rig = parse_rig(text, "rig.toml")
    truth = RigTruth(rig, 5, effects=parse_effects(hidden))
    table = simulate_observations(truth, 240, 11, prisms_per_pose="one", noise_mm=0.5)
    observations = parse_observations(table.csv_text().encode(), rig, "simulated.csv")
    return train_residual(identify(rig, text, observations, effects=effects), observations, kind=residual)


@pytest.fixture(scope="module")
def boom() -> CalibratedModel:
    """A boom with a play among its effects and a network for the rest."""
    model = trained(rig_text("swdt82"), HIDDEN, "backlash@theta4", "rbfn")
    assert model.effects
    assert model.residual is not None
    return model


def boom_with_trees() -> CalibratedModel:
    model = trained(rig_text("swdt82"), HIDDEN, "backlash@theta4", "lightgbm")
    assert model.residual is not None
    return model


def arm() -> CalibratedModel:
    hidden = "encoder_harmonic@q2:cosk_rad=2e-3:sink_rad=1e-3"
    return trained(rig_text("ur10"), hidden, "encoder_harmonic@q2", "none")


def torso() -> CalibratedModel:
    return trained((RIGS / "torso.toml").read_text(encoding="utf-8"), "", "none", "none")


def rows(model: CalibratedModel, prisms: list[str], poses: int, seed: int) -> Observations:
    """Poses of the middle of the work volume, at each of them the prisms; positions are the model's own."""
    rng = np.random.default_rng(seed)
    each, n = len(prisms), poses * len(prisms)
    middle = {j.name: np.repeat(_between(j.limits, rng.uniform(0.15, 0.85, poses)), each) for j in model.rig.joints}
    columns = {f"{j.name}_dir": np.repeat(rng.choice([-1.0, 1.0], poses), each) for j in model.rig.joints}
    pose = np.repeat(np.arange(poses).astype(np.str_), each)
    empty, nothing = np.full(n, ""), np.full((n, 3), np.nan)
    found = Observations(np.tile(prisms, poses), middle, nothing, nothing, empty, empty, pose, columns)
    return replace(found, position_mm=Predictor.of(model).predict(found).position_mm)


def _between(limits: tuple[float, float], share: Floats) -> Floats:
    return limits[0] + (limits[1] - limits[0]) * share


def command_beside(model: CalibratedModel, found: Observations, seed: int, share: float = 0.01) -> Observations:
    """The same targets with another nominal command, the same for all rows of a pose."""
    rng, joints = np.random.default_rng(seed), {}
    for joint in model.rig.joints:
        off = share * (joint.limits[1] - joint.limits[0]) * rng.normal(size=len(found))
        joints[joint.name] = np.clip(found.joints[joint.name] + off[found.pose.astype(int)], *joint.limits)
    return replace(found, joints=joints)


def table(model: CalibratedModel, found: Observations) -> Floats:
    return np.column_stack([found.joints[name] for name in model.rig.joint_names])


def assert_on_target(model: CalibratedModel, targets: Observations) -> None:
    found = inverse(model, targets)
    there = Predictor.of(model).predict(found.observations).position_mm
    miss = np.linalg.norm(there - targets.position_mm, axis=1)
    np.testing.assert_allclose(found.closure_mm, miss, atol=1e-9)
    assert miss.max() <= CLOSURE_MM
    assert found.reached.all()
    low, high = np.array([joint.limits for joint in model.rig.joints]).T
    joints = table(model, found.observations)
    assert ((joints >= low) & (joints <= high)).all()


@pytest.mark.long
@pytest.mark.parametrize(
    ("build", "prisms"),
    [(arm, ["tmac"]), (torso, ["left"]), (torso, ["chest", "left", "right"]), (boom_with_trees, ["r"])],
)
def test_the_model_has_the_prisms_at_their_targets(build: Callable[[], CalibratedModel], prisms: list[str]) -> None:
    model = build()
    assert_on_target(model, command_beside(model, rows(model, prisms, 40, 1), 2))


@pytest.mark.slow
def test_two_prisms_of_a_feed_are_brought_to_their_targets_together(boom: CalibratedModel) -> None:
    targets = command_beside(boom, rows(boom, ["r", "s"], 20, 3), 4)
    assert_on_target(boom, targets)
    alone = inverse(boom, replace(targets, pose=np.full(len(targets), "")))
    assert alone.reached.all()
    joints = table(boom, alone.observations)
    assert np.abs(joints[0::2] - joints[1::2]).max() > 0.1


def test_of_all_commands_it_is_the_one_nearest_to_the_nominal(boom: CalibratedModel) -> None:
    targets = command_beside(boom, rows(boom, ["r"], 12, 5), 6, share=0.02)
    low, high = np.array([joint.limits for joint in boom.rig.joints]).T
    # Nominal commands at a limit as well: there the nearest command lies on it, or leaves it.
    joints = table(boom, targets)
    joints[6:, 0], joints[6:, 3] = low[0], high[3]
    targets = replace(targets, joints=dict(zip(boom.rig.joint_names, joints.T.copy(), strict=True)))
    found = inverse(boom, targets)
    assert found.reached.all()
    compared = 0
    for row in range(len(targets)):
        one = targets.select(np.array([row]))
        nominal = (joints[row] - low) / (high - low)
        commanded = (table(boom, found.observations)[row] - low) / (high - low)

        def miss(share: Floats, one: Observations = one) -> Floats:
            moved = dict(zip(boom.rig.joint_names, (low + share * (high - low))[:, None], strict=True))
            return (Predictor.of(boom).predict(replace(one, joints=moved)).position_mm - one.position_mm)[0] / 100.0

        def change(share: Floats, nominal: Floats = nominal) -> float:
            return 100.0 * float(((share - nominal) ** 2).sum())

        start = np.clip(commanded + 0.01, 0.0, 1.0)
        other = minimize(
            change,
            start,
            method="SLSQP",
            bounds=[(0.0, 1.0)] * len(low),
            constraints={"type": "eq", "fun": miss},
            options={"ftol": 1e-10},
        )
        if other.success and np.linalg.norm(miss(other.x)) < 1e-4:
            assert change(commanded) < 1.01 * change(other.x) + 1e-4
            compared += 1
    assert compared > 6


def test_a_target_out_of_reach_is_named_and_approached(boom: CalibratedModel) -> None:
    targets = command_beside(boom, rows(boom, ["r"], 5, 7), 8)
    far = targets.position_mm.copy()
    far[2] += [0.0, 0.0, 30_000.0]
    found = inverse(boom, replace(targets, position_mm=far))
    np.testing.assert_array_equal(found.reached, [True, True, False, True, True])
    there = Predictor.of(boom).predict(found.observations).position_mm
    assert found.closure_mm[2] == pytest.approx(np.linalg.norm(there[2] - far[2]))
    before = np.linalg.norm(Predictor.of(boom).predict(targets).position_mm[2] - far[2])
    assert 10_000.0 < found.closure_mm[2] < before
    assert found.warnings[0].startswith("1 of 5 targets are out of reach from their nominal commands")
    assert "mm, in row 2 (from 0)" in found.warnings[0]
    low, high = np.array([joint.limits for joint in boom.rig.joints]).T
    joints = table(boom, found.observations)
    assert ((joints >= low) & (joints <= high)).all()


def test_a_pose_that_asks_for_more_than_its_joints_can_choose_is_named(session: Session) -> None:
    targets = rows(session.model, ["w", "b", "r", "s"], 1, 9)
    noise_mm = np.random.default_rng(1).normal(0.0, 2.0, (4, 3))
    found = inverse(session.model, replace(targets, position_mm=targets.position_mm + noise_mm))
    assert found.warnings[0].endswith("; 4 prisms of one pose have 12 coordinates for 9 joints")


def test_targets_that_are_farther_apart_than_the_prisms_are_named(session: Session) -> None:
    targets = rows(session.model, ["r", "s"], 1, 9)
    along = targets.position_mm[0] - targets.position_mm[1]
    apart = targets.position_mm + 2.0 * np.outer([1.0, -1.0], along / np.linalg.norm(along))
    found = inverse(session.model, replace(targets, position_mm=apart))
    np.testing.assert_allclose(found.closure_mm, 2.0, atol=0.01)
    assert not found.reached.any()
    distance = np.linalg.norm(along)
    sentence = f"are {distance + 4.0:.2f} mm apart and the prisms are {distance:.2f} mm: both cannot be reached"
    assert any(sentence in warning for warning in found.warnings)


def test_a_play_is_taken_up_from_the_side_that_the_row_gives(boom: CalibratedModel) -> None:
    target = rows(boom, ["r"], 1, 10).select(np.zeros(2, dtype=np.intp))
    sides = replace(target, pose=np.full(2, ""), extra={"theta4_dir": np.array([-1.0, 1.0])})
    found = inverse(boom, sides)
    assert found.reached.all()
    assert np.ptp(table(boom, found.observations), axis=0).max() > 0.01
    blind = inverse(boom, replace(sides, extra={}))
    assert "backlash@theta4 is left out: this data lacks the column theta4_dir" in blind.warnings
    assert blind.reached.all()


def test_commands_outside_what_was_trained_are_doubted(session: Session) -> None:
    target = rows(session.model, ["r"], 1, 11)
    beyond = replace(target, joints={**target.joints, "theta1": np.array([59.9])})
    narrow = replace(
        session.model,
        coverage=replace(session.model.coverage, ranges={**session.model.coverage.ranges, "theta1": (0.0, 10.0)}),
    )
    beyond = replace(beyond, position_mm=Predictor.of(narrow).predict(beyond).position_mm)
    assert any("theta1: 1 of 1 readings are outside" in warning for warning in inverse(narrow, beyond).warnings)


def test_targets_that_make_no_sense_are_refused(session: Session) -> None:
    targets = rows(session.model, ["r", "s"], 2, 12)
    with pytest.raises(DataError, match="there are none"):
        inverse(session.model, targets.select(np.arange(0)))
    with pytest.raises(DataError, match="every row needs a position"):
        inverse(session.model, replace(targets, position_mm=np.full((4, 3), np.nan)))
    holes = replace(targets, joints={**targets.joints, "theta1": np.array([0.0, 0.0, np.nan, 0.0])})
    with pytest.raises(DataError, match="needs the nominal command of every joint"):
        inverse(session.model, holes)
    torn = replace(targets, joints={**targets.joints, "theta1": np.array([0.0, 1.5, 3.0, 3.0])})
    with pytest.raises(DataError, match=r"column theta1_deg: the rows of pose '0' give 0 and 1.5 deg"):
        inverse(session.model, torn)
    with pytest.raises(UnsafeError, match="set-up 'elsewhere' is unknown"):
        inverse(session.model, replace(targets, setup=np.full(4, "elsewhere")))
