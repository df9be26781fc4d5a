"""Machines with many effects beside unknown structure, effects in a part of the data, and paths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.rig.description import Rig, shipped_rig
from simulators.blind.cases import draw
from simulators.blind.cells import Cell
from simulators.blind.duty_cycle import draw_poses
from simulators.blind.machine import UnknownDraw, draw_machine
from simulators.blind.machine_basis import MachineBasis
from simulators.blind.regime import draw_regime
from simulators.blind.scene import Scene, SceneSettings, draw_scene
from simulators.blind.visibility import Visibility
from simulators.effects.library import LIBRARY, parse_effects
from simulators.effects.part import Part, PartialEffect
from simulators.effects.unknown import draw_surface
from simulators.rig.noise import NoiseSettings, draw_noise


@pytest.fixture(scope="module")
def rig() -> Rig:
    return shipped_rig("swdt82")


@pytest.fixture(scope="module")
def scene(rig: Rig) -> Scene:
    return draw_scene(rig, 6, SceneSettings(poses=80, held_out=10))


@pytest.fixture(scope="module")
def visibility(scene: Scene) -> Visibility:
    fixes = scene.training
    return Visibility(scene.truth, fixes.prism, fixes.joints, fixes.noise.covariance_mm2)


def test_a_machine_has_ten_effects_of_six_families_that_show_beside_each_other(
    scene: Scene, visibility: Visibility
) -> None:
    hidden, unknown = draw_machine(scene, visibility, UnknownDraw(5.0, 1.0, 20.0), 3)

    effects = [h.effect for h in hidden]
    assert len({(e.family, e.where) for e in effects}) == 10
    assert len({e.family for e in effects}) == 6
    assert {e.family for e in effects} <= set(LIBRARY)
    assert min(MachineBasis(scene, visibility).beside(effects)) >= 3.0
    assert max(h.size for h in hidden) <= 15.2
    assert not {e.family for e in unknown} & set(LIBRARY)
    assert visibility.size(scene.displacement_mm(unknown)) == pytest.approx(np.sqrt(24.0), rel=0.05)


def test_of_an_effect_and_its_alias_nothing_is_seen_beside_the_other(scene: Scene, visibility: Visibility) -> None:
    scale, curve = parse_effects("angle_scale@theta4,joint_error_map@theta4")
    other = parse_effects("backlash@theta4")[0]

    basis = MachineBasis(scene, visibility)

    alone = visibility.size(scene.displacement_mm([scale]))
    assert basis.beside([scale, curve])[0] < 0.1 * alone
    assert basis.beside([scale, other])[0] > 0.8 * alone


def test_structure_of_two_joints_holds_nothing_that_one_of_them_decides(rig: Rig) -> None:
    surface = draw_surface(rig, 8)
    even = {}
    for name in (surface.first, surface.second):
        low, high = rig.joint(name).limits
        values = np.linspace(low, high, 81)
        even[name] = np.deg2rad(values) if rig.joint(name).kind == "revolute" else values
    first, second = np.meshgrid(even[surface.first], even[surface.second], indexing="ij")

    values = surface.values(rig, {surface.first: first.ravel(), surface.second: second.ravel()}).reshape(81, 81)

    assert np.sqrt(np.mean(values**2)) == pytest.approx(1.0)
    assert np.abs(values.mean(axis=0)).max() < 1e-9
    assert np.abs(values.mean(axis=1)).max() < 1e-9


@pytest.mark.parametrize("effect", ["joint_compliance@theta4", "boom_droop@boom", "linkage_coupling@theta1"])
@pytest.mark.parametrize("part", [Part("theta5", True, 5.0), Part("time_s", False, 9000.0)])
def test_an_effect_in_a_part_of_the_data_is_itself_there_and_nothing_elsewhere(
    scene: Scene, effect: str, part: Part
) -> None:
    whole = parse_effects(effect)[0]
    values = scene.training.joints.get(part.variable, scene.training.columns.get(part.variable))
    inside = part.holds(values)

    moved = scene.displacement_mm([PartialEffect(whole.where, whole, part)])

    assert 0 < inside.sum() < len(inside)
    assert np.allclose(moved[inside], scene.displacement_mm([whole])[inside], atol=1e-9)
    assert np.allclose(moved[~inside], 0.0, atol=1e-9)


def test_a_regimes_label_is_the_part_in_which_it_acts(scene: Scene, visibility: Visibility) -> None:
    regimes = [draw_regime(scene, visibility, 4.0, np.random.default_rng(seed)) for seed in (0, 1)]

    for regime in regimes:
        variable, border = regime.label["variable"], regime.label["border"]
        columns = {**scene.training.joints, **scene.training.columns, "row": np.arange(80.0)}
        moved = np.linalg.norm(scene.displacement_mm([regime.hidden.effect]), axis=1) > 1e-9
        if variable in columns:
            holds = Part(variable, regime.label["above"], border).holds(columns[variable])
            assert not moved[~holds].any()
            assert moved[holds].mean() > 0.8
        assert regime.label["low"] < border < regime.label["high"]
        assert regime.hidden.size == pytest.approx(4.0, rel=0.05)


def test_poses_of_a_path_follow_one_another(rig: Rig) -> None:
    poses = draw_poses(rig, "path", 200, np.random.default_rng(2))

    for joint in rig.joints:
        low, high = joint.limits
        values = poses[joint.name]
        assert np.abs(np.diff(values)).max() < 0.2 * (high - low)
        assert np.ptp(values) > 0.5 * (high - low)
        assert low <= values.min() <= values.max() <= high


def test_an_error_that_wanders_is_shared_by_neighbours_and_not_stated(rig: Rig) -> None:
    true_mm, pose = np.tile([2000.0, 6000.0, 500.0], (400, 1)), np.arange(400)
    settings = NoiseSettings(excess_wander=3.0, wander_poses=20.0, outliers=0.0)
    rng = np.random.default_rng(4)

    wandering = draw_noise(rig.station, true_mm, pose, settings, rng)
    plain = draw_noise(rig.station, true_mm, pose, replace(settings, excess_wander=0.0), rng)

    def of_neighbours(error_mm: np.ndarray) -> float:
        return float(np.corrcoef(error_mm[1:, 2], error_mm[:-1, 2])[0, 1])

    assert of_neighbours(wandering.error_mm) > 0.6
    assert of_neighbours(plain.error_mm) < 0.3
    assert np.array_equal(wandering.covariance_mm2, plain.covariance_mm2)


def test_a_path_is_a_case_without_effect(rig: Rig) -> None:
    drawn = draw(rig, Cell("path", (), 0.0, "path", "fine", 5))

    assert drawn is not None
    assert drawn.label["effects"] == []
    assert drawn.label["unknown"] == []
