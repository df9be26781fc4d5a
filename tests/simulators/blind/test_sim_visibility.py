"""What calibration cannot absorb of a displacement, and whether anyone could tell which effect made it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.rig.description import shipped_rig
from simulators.blind.aliases import alias_scene
from simulators.blind.alternatives import nearest_alternative
from simulators.blind.cells import ALIASES
from simulators.blind.hiding import hide
from simulators.blind.scene import Scene, SceneSettings, draw_scene
from simulators.blind.visibility import Visibility, reading_covariance_mm2, timing_covariance_mm2
from simulators.effects.library import parse_effects
from simulators.rig.screws import Floats
from simulators.rig.truth import RigTruth

N = 80


@pytest.fixture(scope="module")
def scene() -> Scene:
    return draw_scene(shipped_rig("swdt82"), 4, SceneSettings(poses=N, held_out=1))


def visibility(scene: Scene, sigma_mm: float = 1.0) -> Visibility:
    noise = np.broadcast_to(sigma_mm**2 * np.eye(3), (N, 3, 3))
    return Visibility(scene.truth, scene.training.prism, scene.training.joints, noise)


def rms(displacement_mm: Floats) -> float:
    return float(np.sqrt(np.mean(displacement_mm**2)))


def test_a_machine_within_its_tolerances_is_absorbed_by_calibration(scene: Scene) -> None:
    # The same draw, half a tolerance nearer to nominal.
    other = RigTruth(scene.truth.rig, 4, perturbation=0.5)
    moved = scene.training.places_mm(other) - scene.training.places_mm(scene.truth)

    assert rms(moved) > 3.0
    assert visibility(scene).size(moved) < 0.2 * rms(moved)


def test_where_the_base_stands_is_never_seen(scene: Scene) -> None:
    at = scene.training.places_mm(scene.truth) - scene.truth.placement().position_mm
    turned = np.cross([1e-4, -2e-4, 3e-4], at) + np.array([0.4, -0.3, 0.2])

    assert rms(turned) > 0.4
    assert visibility(scene).size(turned) < 1e-3 * rms(turned)


def test_noise_is_seen_but_for_the_freedom_of_the_constants(scene: Scene) -> None:
    noise = np.random.default_rng(5).normal(0.0, 2.0, (N, 3))

    size = visibility(scene, sigma_mm=2.0).size(noise)

    freedom = sum(len(row.identify) for row in scene.truth.rig.rows) + 3 + 6
    assert np.sqrt(1.0 - freedom / (3 * N)) - 0.1 < size < 1.05


def test_visible_size_is_in_units_of_the_noise(scene: Scene) -> None:
    moved = scene.displacement_mm(parse_effects("backlash@theta3:width_rad=1e-3"))
    size = visibility(scene).size(moved)

    assert visibility(scene).size(3.0 * moved) == pytest.approx(3.0 * size)
    # Coarser noise also lets the constants take less, each being held by its tolerance.
    assert 0.5 < visibility(scene, sigma_mm=2.0).size(moved) / size < 0.6


def test_reading_noise_is_what_readings_do_to_the_prism(scene: Scene) -> None:
    fixes, few, many = scene.training, 3, 4000
    sigma = {"theta4": np.full(few, 0.02), "L2": np.full(few, 0.5)}
    here = {name: values[:few] for name, values in fixes.joints.items()}
    scattered = {name: np.repeat(values, many) for name, values in here.items()}
    rng = np.random.default_rng(6)
    for name, spread in sigma.items():
        scattered[name] = scattered[name] + rng.normal(0.0, np.repeat(spread, many))

    found = reading_covariance_mm2(scene.truth, fixes.prism[:few], here, sigma)

    drawn = scene.truth.prism_mm(str(fixes.prism[0]), scattered).reshape(few, many, 3)
    for own, places in zip(found, drawn, strict=True):
        np.testing.assert_allclose(own, np.cov(places.T), atol=0.06 * np.trace(own))


def test_an_error_of_the_instant_moves_the_prism_along_its_path(scene: Scene) -> None:
    fixes = scene.training
    late = {"theta4": np.full(N, 0.01), "L2": np.full(N, 2.0)}
    ahead = {**fixes.joints, **{name: fixes.joints[name] + step for name, step in late.items()}}
    path = fixes.places_mm(scene.truth, ahead) - fixes.places_mm(scene.truth)

    found = timing_covariance_mm2(scene.truth, fixes.prism, fixes.joints, late)

    np.testing.assert_allclose(found, path[:, :, None] * path[:, None, :], rtol=0.02, atol=0.02)


def test_a_hidden_effect_shows_as_large_as_was_asked_for(scene: Scene) -> None:
    shown = visibility(scene, sigma_mm=1.5)
    (hidden,) = hide(scene, ["backlash"], 0.5, shown.size, 1)

    assert shown.size(scene.displacement_mm([hidden.effect])) == pytest.approx(0.5, rel=0.02)


def test_two_effects_are_told_apart_where_the_data_differ(scene: Scene) -> None:
    effect = parse_effects("load_hysteresis@theta4:rad_per_Nm=2e-8")[0]

    assert nearest_alternative(scene, visibility(scene), effect).is_separable


def test_an_effect_far_below_the_noise_cannot_be_told_apart(scene: Scene) -> None:
    effect = parse_effects("load_hysteresis@theta4:rad_per_Nm=2e-10")[0]

    assert not nearest_alternative(scene, visibility(scene), effect).is_separable


@pytest.mark.long
@pytest.mark.parametrize("turned_round", [False, True])
@pytest.mark.parametrize("families", ALIASES)
def test_an_alias_is_data_in_which_one_effect_is_as_the_other(
    scene: Scene, families: str, *, turned_round: bool
) -> None:
    """Whichever of the two it is: that one is nearer to the size that is plausible for it makes it no likelier."""
    made, where = alias_scene(scene, families, np.random.default_rng(0))
    shown = visibility(made)
    one, other = sorted(families.split("|"), reverse=turned_round)
    (hidden,) = hide(made, [one], 1.0, shown.size, 2, where=[where])

    found = nearest_alternative(made, shown, hidden.effect)

    assert found.alternative == f"{other}@{where}"
    assert not found.is_separable


def test_alias_columns_are_recorded_with_their_sensors_errors(scene: Scene) -> None:
    made, where = alias_scene(scene, "cylinder_compression|transducer_scale", np.random.default_rng(0))
    true, recorded = (part[f"{where}_bar"] for part in (made.training.columns, made.training.recorded))
    before = scene.training.recorded[f"{where}_bar"] - scene.training.columns[f"{where}_bar"]

    np.testing.assert_allclose(recorded - true, before, atol=1e-9)
    assert np.corrcoef(true, made.training.joints[where])[0, 1] == pytest.approx(1.0)
    assert replace(made, training=scene.training, held_out=scene.held_out) == scene
