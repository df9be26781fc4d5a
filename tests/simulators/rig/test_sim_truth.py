"""The true machine against an independent computation: plain 4x4 matrices multiplied row by row."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.rig.description import Rig, shipped_rig
from simulators.effects.families.joints import JointCompliance
from simulators.effects.families.links import BoomDroop
from simulators.effects.library import parse_effects
from simulators.effects.variants import StiffeningCompliance
from simulators.rig.dataset import random_poses
from simulators.rig.truth import RigTruth, replace_effects
from tests.simulators.matrices import Matrix, frames_by_matrices, positions_by_matrices


def check_against_matrices(rig: Rig, perturbation: float) -> None:
    truth = RigTruth(rig, 5, perturbation=perturbation)
    joints = random_poses(rig, 20, np.random.default_rng(1))
    for prism in rig.prism_names:
        want = positions_by_matrices(truth, prism, joints)
        assert np.allclose(truth.prism_mm(prism, joints), want, atol=1e-7)


@pytest.mark.parametrize("name", ["swdt82", "ys100", "ur10"])
@pytest.mark.parametrize("perturbation", [0.0, 1.0, 20.0])
def test_the_product_of_exponentials_equals_multiplied_rows_for_shipped_rigs(name: str, perturbation: float) -> None:
    check_against_matrices(shipped_rig(name), perturbation)


def test_the_product_of_exponentials_equals_multiplied_rows_with_couplings_and_fixed_transforms(odd_rig: Rig) -> None:
    check_against_matrices(odd_rig, 1.0)


def test_the_nominal_boom_stands_where_its_table_says(swdt82: Rig) -> None:
    """All joints straight: row 1 to 9 by hand for prism w (frame 3 is 2500 above the second hinge's x)."""
    truth = RigTruth(swdt82, 1, perturbation=0.0)
    joints = {j.name: np.zeros(1) for j in swdt82.joints}
    place = truth.placement()
    base = (truth.prism_mm("w", joints) - place.position_mm) @ place.rotation
    # T1 = Tx(200) Rx(90) Tz(250): (200, -250, 0), z along -y; T2: +1382 x; T3: Rx(-90) turns z up, +2500 z, prism +300.
    assert np.allclose(base, [[1582.0, -250.0, 2800.0]])


def test_the_same_seed_builds_the_same_machine_and_another_seed_another(swdt82: Rig) -> None:
    joints = random_poses(swdt82, 3, np.random.default_rng(0))
    first, again, other = (RigTruth(swdt82, s).prism_mm("r", joints) for s in (4, 4, 5))
    assert np.array_equal(first, again)
    assert np.abs(first - other).max() > 1.0


def test_the_machine_deviates_by_its_build_tolerances(swdt82: Rig) -> None:
    lengths, angles, betas = [], [], []
    for seed in range(60):
        truth, nominal = RigTruth(swdt82, seed), RigTruth(swdt82, seed, perturbation=0.0)
        for own, ideal in zip(truth.constants, nominal.constants, strict=True):
            lengths += [own.a - ideal.a, own.d - ideal.d]
            angles += [own.alpha - ideal.alpha, own.theta - ideal.theta]
            betas.append(own.beta - ideal.beta)
    assert np.std(lengths) == pytest.approx(5.0, rel=0.1)
    assert np.rad2deg(np.std(angles)) == pytest.approx(0.2, rel=0.1)
    assert np.rad2deg(np.std(betas)) == pytest.approx(0.1, rel=0.15)


def test_an_unknown_prism_offset_is_drawn_even_for_a_nominal_machine() -> None:
    rig = shipped_rig("ur10")
    offset = RigTruth(rig, 3, perturbation=0.0).prism_offset_mm("tmac")
    assert np.linalg.norm(offset) > 10.0


@pytest.mark.parametrize("name", ["swdt82", "ys100", "ur10"])
def test_the_base_is_nearly_upright_and_a_few_metres_from_the_station(name: str) -> None:
    rig = shipped_rig(name)
    for seed in range(10):
        place = RigTruth(rig, seed).placement()
        assert np.allclose(place.rotation @ place.rotation.T, np.eye(3))
        assert np.linalg.det(place.rotation) == pytest.approx(1.0)
        assert np.rad2deg(np.arccos(place.rotation[2, 2])) < 3.0
        assert 1000.0 < np.linalg.norm(place.position_mm) < 15000.0


def test_gravity_points_down_in_the_station_frame_whatever_the_rig_calls_down(odd_rig: Rig) -> None:
    place = RigTruth(odd_rig, 2).placement()
    down = place.rotation @ np.array(odd_rig.gravity)
    assert np.rad2deg(np.arccos(-down[2])) < 3.0


def test_each_set_up_sees_the_machine_from_elsewhere(swdt82: Rig) -> None:
    truth = RigTruth(swdt82, 2)
    joints = random_poses(swdt82, 4, np.random.default_rng(0))
    a, b = truth.prism_mm("r", joints, setup="A"), truth.prism_mm("r", joints, setup="B")
    assert np.abs(a - b).max() > 100.0
    between_a, between_b = np.linalg.norm(a[1:] - a[0], axis=1), np.linalg.norm(b[1:] - b[0], axis=1)
    assert np.allclose(between_a, between_b)


def energy_joule(truth: RigTruth, joints: dict[str, float]) -> float:
    """Potential energy of the machine's own masses, by multiplied rows."""
    place = truth.placement()
    frames = frames_by_matrices(truth, joints)
    total = 0.0
    for mass in truth._masses:  # the true masses are nobody's business but this test's
        T = frames[mass.frame]
        point = place.rotation @ (T[:3, :3] @ mass.place_mm + T[:3, 3])
        total += mass.kg * 9.80665 * point[2] / 1e3
    return total


@pytest.mark.parametrize("name", ["swdt82", "ys100"])
def test_gravity_load_is_the_slope_of_potential_energy(name: str) -> None:
    check_gravity(shipped_rig(name))


def test_gravity_load_is_the_slope_of_potential_energy_with_couplings(odd_rig: Rig) -> None:
    check_gravity(odd_rig)


def check_gravity(rig: Rig) -> None:
    truth = RigTruth(rig, 8)
    pose = {k: float(v[0]) for k, v in random_poses(rig, 1, np.random.default_rng(2)).items()}
    for joint in rig.joints:
        step = 1e-3 if joint.kind == "revolute" else 1e-1
        up, down = (energy_joule(truth, pose | {joint.name: pose[joint.name] + s}) for s in (step, -step))
        width = np.deg2rad(2 * step) if joint.kind == "revolute" else 2 * step / 1e3
        load = truth.gravity_load(joint.name, {k: np.array([v]) for k, v in pose.items()})[0]
        assert load == pytest.approx(-(up - down) / width, rel=1e-5, abs=0.1)


def test_masses_are_within_fifteen_percent_of_the_rig_file(swdt82: Rig) -> None:
    kg = np.array([[m.kg for m in RigTruth(swdt82, s)._masses] for s in range(40)])
    ratio = kg[:, :-1] / [m.kg for m in swdt82.masses[:-1]]
    assert ratio.min() >= 0.85
    assert ratio.max() <= 1.15
    assert ratio.std() > 0.05


class TestEffects:
    @pytest.fixture
    def truth(self, swdt82: Rig) -> RigTruth:
        return RigTruth(swdt82, 3)

    @pytest.fixture
    def joints(self, swdt82: Rig) -> dict[str, Matrix]:
        return random_poses(swdt82, 30, np.random.default_rng(4))

    def shift(self, truth: RigTruth, text: str, prism: str, joints: dict[str, Matrix], **columns: Matrix) -> Matrix:
        hidden = replace_effects(truth, parse_effects(text))
        return hidden.prism_mm(prism, joints, columns) - truth.prism_mm(prism, joints)

    def test_backlash_moves_the_joint_by_half_its_width_to_the_side_it_came_from(self, truth, joints) -> None:
        for side in (-1.0, 1.0):
            moved = dict(joints, theta4=joints["theta4"] + side * np.rad2deg(0.5e-3))
            want = truth.prism_mm("r", moved) - truth.prism_mm("r", joints)
            got = self.shift(truth, "backlash@theta4:width_rad=1e-3", "r", joints, theta4_dir=np.full(30, side))
            assert np.allclose(got, want, atol=1e-6)

    def test_backlash_without_its_direction_is_refused(self, truth, joints) -> None:
        with pytest.raises(ValueError, match="theta4_dir"):
            self.shift(truth, "backlash@theta4", "r", joints)

    def test_transducer_scale_lengthens_as_read(self, truth, joints) -> None:
        want = truth.prism_mm("r", dict(joints, L2=joints["L2"] * 1.002)) - truth.prism_mm("r", joints)
        assert np.allclose(self.shift(truth, "transducer_scale@L2:scale=2e-3", "r", joints), want, atol=1e-6)

    def test_an_effect_at_a_coupled_joint_moves_both_rows(self, truth, joints) -> None:
        got = self.shift(truth, "encoder_harmonic@theta1:cosk_rad=0:sink_rad=1e-3:k=2", "w", joints)
        angle = np.deg2rad(joints["theta1"])
        true = angle
        for _ in range(20):
            true = angle + 1e-3 * np.sin(2 * true)
        want = truth.prism_mm("w", dict(joints, theta1=np.rad2deg(true))) - truth.prism_mm("w", joints)
        assert np.allclose(got, want, atol=1e-5)

    def test_compliance_lets_the_boom_sink_where_it_stands_after_sinking(self, truth, joints) -> None:
        hidden = replace_effects(truth, [JointCompliance("theta4", 2e-8)])
        sunk = joints["theta4"]
        for _ in range(12):
            load = truth.gravity_load("theta4", dict(joints, theta4=sunk))
            sunk = joints["theta4"] + np.rad2deg(2e-8 * load)
        want = truth.prism_mm("r", dict(joints, theta4=sunk))
        assert np.allclose(hidden.prism_mm("r", joints), want, atol=1e-4)
        assert np.all(hidden.prism_mm("r", joints)[:, 2] < truth.prism_mm("r", joints)[:, 2])

    def test_a_stiffening_joint_is_soft_without_load_and_stiff_under_it(self) -> None:
        truth = RigTruth(shipped_rig("ys100"), 3)
        hidden = replace_effects(truth, [StiffeningCompliance("theta2", 1.6e-6, 4e-7, 500.0)])
        poses = random_poses(truth.rig, 40, np.random.default_rng(4))
        load, sunk = truth.gravity_load("theta2", poses), poses["theta2"]
        for _ in range(12):
            load = truth.gravity_load("theta2", dict(poses, theta2=sunk))
            # The slope of the curve, integrated from no load to this one.
            grid = np.linspace(0.0, 1.0, 2001)[:, None] * load
            slope = 4e-7 + 1.2e-6 / (1.0 + (grid / 500.0) ** 2)
            sunk = poses["theta2"] + np.rad2deg(np.trapezoid(slope, grid, axis=0))
        assert np.allclose(hidden.prism_mm("tool", poses), truth.prism_mm("tool", dict(poses, theta2=sunk)), atol=1e-4)
        compliance = np.deg2rad(sunk - poses["theta2"]) / load
        order = np.argsort(np.abs(load))
        assert (np.diff(compliance[order]) < 1e-12).all()
        assert 4e-7 < compliance.min() < 0.5 * compliance.max() < 0.8e-6

    def test_payload_adds_to_the_load(self, truth, joints) -> None:
        empty, loaded = (
            self.shift(truth, "joint_compliance@theta4", "r", joints, payload_kg=np.full(30, kg)) for kg in (0.0, 400.0)
        )
        assert np.all(loaded[:, 2] < empty[:, 2])

    def test_droop_is_the_cantilever_of_the_textbook(self, swdt82: Rig) -> None:
        """A level boom, only its own masses nominal: compare with the formula computed from scratch."""
        truth = RigTruth(swdt82, 1, perturbation=0.0)
        pose = {"theta1": 0, "theta3": 90, "theta4": 0, "theta5": 0, "theta6": -90, "theta7": -90, "theta8": 0}
        joints = {k: np.array([float(v)]) for k, v in (pose | {"L2": 2168, "L3": 0}).items()}
        scale = 1e-13  # so small that loads do not move: the linear formula holds
        hidden = replace_effects(truth, [BoomDroop(flexibility_per_Nm2=scale)])
        moved = (hidden.prism_mm("b", joints) - truth.prism_mm("b", joints))[0] @ truth.placement().rotation
        frames = frames_by_matrices(truth, {k: float(v[0]) for k, v in joints.items()})
        root, tip = frames[4][:3, 3], frames[5][:3, 3]
        L, axis = np.linalg.norm(tip - root) / 1e3, (tip - root) / np.linalg.norm(tip - root)
        down = truth.placement().rotation.T @ [0.0, 0.0, -9.80665]
        F, M, W = np.zeros(3), np.zeros(3), np.zeros(3)
        for mass in swdt82.masses:
            T = frames[mass.frame]
            if mass.frame >= 5:
                F = F + mass.kg * down
                M = M + np.cross((T[:3, :3] @ mass.centre_mm + T[:3, 3] - tip) / 1e3, mass.kg * down)
            elif mass.frame == 4:
                W = W + mass.kg * down
        F, M, W = (v - (v @ axis) * axis for v in (F, M, W))
        shift = F * L**3 / 3 + np.cross(M, axis) * L**2 / 2 + W * L**3 / 8
        slope = np.cross(axis, F) * L**2 / 2 + M * L + np.cross(axis, W) * L**2 / 6
        prism = frames[5][:3, :3] @ np.array(swdt82.prism("b").offset_mm)
        assert np.allclose(moved, scale * (1e3 * shift + np.cross(slope, prism)), rtol=1e-3, atol=1e-12)
        assert moved[2] < 0

    def test_droop_leaves_what_is_before_the_boom_alone_and_sinks_the_tip(self, truth, joints) -> None:
        assert np.allclose(self.shift(truth, "boom_droop@boom", "w", joints), 0.0)
        sunk = self.shift(truth, "boom_droop@boom", "r", joints)[:, 2]
        assert np.median(sunk) < -5.0
        assert np.abs(sunk).max() < 100.0

    def test_a_joint_beyond_a_bent_boom_feels_its_load_where_the_boom_has_come_to_rest(self, truth, joints) -> None:
        text = ("joint_compliance@theta8:compliance_rad_per_Nm=1e-7", "boom_droop@boom:flexibility_per_Nm2=2e-8")
        both = self.shift(truth, ",".join(text), "r", joints)
        apart = sum(self.shift(truth, t, "r", joints) for t in text)
        difference = np.linalg.norm(both - apart, axis=1).max()
        assert 1e-3 < difference < 0.1 * np.linalg.norm(apart, axis=1).max()

    def test_effects_add_up(self, truth, joints) -> None:
        both = self.shift(truth, "transducer_scale@L2,transducer_scale@L3", "r", joints)
        apart = sum(self.shift(truth, f"transducer_scale@{w}", "r", joints) for w in ("L2", "L3"))
        assert np.allclose(both, apart, atol=1e-6)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("rust@theta4", "unknown effect 'rust'; known: angle_scale, backlash"),
            ("backlash", "give the place"),
            ("backlash@theta4:wide=1", "known: width_rad"),
            ("backlash@theta4:width_rad=x", "'x' is not a number"),
            ("backlash@theta4:width_rad=nan", "not a finite number"),
        ],
    )
    def test_a_misspelt_effect_is_refused_in_a_sentence(self, text: str, message: str) -> None:
        with pytest.raises(ValueError, match=message):
            parse_effects(text)

    @pytest.mark.parametrize(
        "text",
        [
            "backlash@L2",
            "transducer_scale@theta4",
            "joint_compliance@theta2",
            "stiffening_compliance@L2",
            "stiffening_compliance@theta4:knee_Nm=0",
            "boom_droop@theta4",
            "encoder_harmonic@L3",
        ],
    )
    def test_an_effect_at_an_impossible_place_is_refused(self, swdt82: Rig, text: str) -> None:
        with pytest.raises(ValueError, match=text.split("@", maxsplit=1)[0]):
            RigTruth(swdt82, 1, effects=parse_effects(text))

    def test_droop_needs_a_telescoping_boom(self) -> None:
        with pytest.raises(ValueError, match="no row with a driven length"):
            RigTruth(shipped_rig("ur10"), 1, effects=[BoomDroop()])
