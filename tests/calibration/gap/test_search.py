"""What the gap workflow answers, by the truth that is hidden; and the mathematics that its answers rest on."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from calibration.effects.library import library
from calibration.gap.projected.projection import SoftProjection, from_products, without_folds
from calibration.gap.result import GapResult
from calibration.identification.reading_steps import step_of
from calibration.observations import parse_observations
from calibration.pipeline.find_gap import find_gap
from daemon.rig_files import load_rig
from simulators.blind.aliases import alias_scene
from simulators.blind.cases import Drawn, draw
from simulators.blind.cells import Cell, Poses
from simulators.blind.hiding import hide
from simulators.blind.scene import SceneSettings, draw_scene
from simulators.blind.visibility import Visibility
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.daemon.support.gap import session_csv
from tests.simulated.observations import simulate_observations

SOURCE = load_rig("swdt82")


def answered(cell: Cell) -> tuple[Drawn, GapResult]:
    drawn = draw(SOURCE.rig, cell)
    assert drawn is not None
    return drawn, find_gap(SOURCE.rig, SOURCE.text, parse_observations(drawn.train.encode(), SOURCE.rig, "case.csv"))


def hidden(drawn: Drawn) -> set[tuple[str, str]]:
    return {(effect["family"], effect["where"]) for effect in drawn.label["effects"]}


@pytest.mark.long
def test_two_effects_are_both_named_where_they_are_and_the_gap_closes() -> None:
    drawn, gap = answered(Cell("pair", ("angle_scale", "linkage_coupling"), 1.0, "wide", "fine", 43))
    assert gap.verdict == "named"
    assert {(effect.family, effect.where) for effect in gap.effects} == hidden(drawn)
    assert [len(round_.adopted) for round_ in gap.rounds] == [1, 1, 0]
    assert not gap.remaining_significant
    assert gap.rounds[-1].held_out_mm < gap.rounds[0].held_out_mm


@pytest.mark.long
def test_scatter_far_beyond_the_instruments_is_no_effect_but_not_passed_over_in_silence() -> None:
    drawn = draw(SOURCE.rig, Cell("null", (), 0.0, "wide", "fine", 42))
    assert drawn is not None
    quiet = parse_observations(drawn.train.encode(), SOURCE.rig, "case.csv")
    shaken = np.random.default_rng(7).normal(scale=6.0, size=quiet.position_mm.shape)
    loud = find_gap(SOURCE.rig, SOURCE.text, replace(quiet, position_mm=quiet.position_mm + shaken))
    assert (loud.verdict, loud.effects) == ("none", ())
    assert any("the fixes scatter by" in warning for warning in loud.warnings)
    silent = find_gap(SOURCE.rig, SOURCE.text, quiet)
    assert not any("the fixes scatter by" in warning for warning in silent.warnings)


@pytest.mark.long
@pytest.mark.parametrize("width", [3e-3, -3e-3])
def test_play_has_its_name_on_whichever_side_of_it_the_encoder_is(width: float) -> None:
    data = session_csv(60, hidden=f"backlash@theta4:width_rad={width}")
    gap = find_gap(SOURCE.rig, SOURCE.text, parse_observations(data, SOURCE.rig, "session.csv"))
    assert [(effect.family, effect.where) for effect in gap.effects] == [("backlash", "theta4")]
    assert gap.effects[0].coefficients[0].value == pytest.approx(width, rel=0.2)


@pytest.mark.long
def test_a_disc_that_is_off_its_axis_and_oval_is_an_encoder_error_and_no_curve() -> None:
    robot = load_rig("ys100")
    once, twice = "cosk_rad=2e-4:sink_rad=1e-4:k=1", "cosk_rad=-1e-4:sink_rad=8e-5:k=2"
    disc = parse_effects(f"encoder_harmonic@theta1:{once},encoder_harmonic@theta1:{twice}")
    data = simulate_observations(RigTruth(robot.rig, 3, effects=disc), 150, 3, noise_mm=0.05).csv_text().encode()
    gap = find_gap(robot.rig, robot.text, parse_observations(data, robot.rig, "session.csv"))
    assert [(effect.family, effect.where) for effect in gap.effects] == [("encoder_harmonic", "theta1")]
    values = [c.value for c in gap.effects[0].reported]
    np.testing.assert_allclose(values, (2e-4, 1e-4, -1e-4, 8e-5), atol=2e-5)


@pytest.mark.long
def test_what_is_too_large_for_its_name_is_not_said_to_be_outside_of_the_library() -> None:
    data = session_csv(60, hidden="transducer_scale@L2:scale=0.03")
    gap = find_gap(SOURCE.rig, SOURCE.text, parse_observations(data, SOURCE.rig, "session.csv"))
    assert (gap.verdict, gap.effects) == ("unidentified", ())
    assert gap.description is not None
    reason = "transducer_scale@L2 would explain this, but scale would exceed its physical limits"
    assert gap.description.endswith(reason)


@pytest.mark.long
def test_effects_that_would_explain_next_to_nothing_of_a_gap_are_no_set() -> None:
    """A distance meter's cyclic error, as a stranger's station may have it, leaves four times the noise."""
    drawn = draw(SOURCE.rig, Cell("null", (), 0.0, "wide", "fine", 49))
    assert drawn is not None
    quiet = parse_observations(drawn.train.encode(), SOURCE.rig, "case.csv")
    away_mm = np.linalg.norm(quiet.position_mm, axis=1)[:, None]
    cyclic_mm = 8.0 * np.sin(2.0 * np.pi * away_mm / 5000.0) * quiet.position_mm / away_mm
    gap = find_gap(SOURCE.rig, SOURCE.text, replace(quiet, position_mm=quiet.position_mm + cyclic_mm))
    assert (gap.verdict, gap.effects, gap.indistinguishable) == ("unidentified", (), ())


@pytest.mark.long
@pytest.mark.parametrize(
    ("hidden", "named", "undecided"),
    [
        ("zero_step@theta1:jump_rad=3e-4", [], [("base_shift", "base"), ("zero_step", "theta1")]),
        ("base_shift@base:x_mm=0:y_mm=0:heading_rad=3e-4", [], [("base_shift", "base"), ("zero_step", "theta1")]),
        ("base_shift@base:x_mm=0.3:y_mm=-0.4:heading_rad=2e-4", [("base_shift", "base")], []),
        ("zero_step@theta3:jump_rad=3e-4", [("zero_step", "theta3")], []),
        ("prism_seat_step@tool:x_mm=0.3:y_mm=0.4:z_mm=-0.3", [("prism_seat_step", "tool")], []),
    ],
)
def test_a_robot_that_turned_in_its_foot_is_as_one_whose_first_encoder_slipped_and_as_no_other(
    hidden: str, named: list[tuple[str, str]], undecided: list[tuple[str, str]]
) -> None:
    robot, n = load_rig("ys100"), 120
    moved = RigTruth(robot.rig, 3, effects=parse_effects(f"{hidden}:time_s=3000"))
    columns = {"time_s": np.linspace(0.0, 7200.0, n)}
    data = simulate_observations(moved, n, 3, noise_mm=0.05, columns=columns).csv_text().encode()
    gap = find_gap(robot.rig, robot.text, parse_observations(data, robot.rig, "session.csv"))
    assert [(effect.family, effect.where) for effect in gap.effects] == named
    assert sorted((candidate.family, candidate.where) for candidate in gap.indistinguishable) == undecided


@pytest.mark.long
def test_a_set_beside_a_named_effect_leaves_the_errors_of_every_round_as_they_are_without_it() -> None:
    rng = np.random.default_rng(42)
    scene = draw_scene(SOURCE.rig, 42, SceneSettings())
    scene, where = alias_scene(scene, "base_settlement|base_step", rng)

    fixes = scene.training
    noise_mm2 = np.tile(3.0 * np.eye(3), (len(fixes.prism), 1, 1))
    visible = Visibility(scene.truth, fixes.prism, fixes.joints, noise_mm2)
    (drift,) = hide(scene, ["base_step"], 2.0, visible.size, 42, where=[where])
    (scale,) = hide(scene, ["angle_scale"], 1.0, visible.size, 42, where=["theta3"])
    data = scene.observe([drift.effect, scale.effect]).training.csv_text().encode()
    gap = find_gap(SOURCE.rig, SOURCE.text, parse_observations(data, SOURCE.rig, "case.csv"))
    assert gap.verdict == "indistinguishable"
    assert {candidate.family for candidate in gap.indistinguishable} == {"base_settlement", "base_step"}
    assert [(effect.family, effect.where) for effect in gap.effects] == [("angle_scale", "theta3")]
    assert gap.remaining_significant
    assert any(experiment.poses for experiment in gap.experiments)
    assert [round_.adopted for round_ in gap.rounds] == [("angle_scale@theta3",), ()]
    assert gap.rounds[1].held_out_mm < gap.rounds[0].held_out_mm
    assert "base" in {disagreement.where for disagreement in gap.disagreements}
    assert all(f.visible > 0.1 for f in gap.forecasts if f.family in ("base_settlement", "base_step"))


@pytest.mark.long
def test_an_effect_that_no_library_has_is_described_and_gets_no_name() -> None:
    drawn, gap = answered(Cell("outside", ("thermal_cross",), 1.0, "wide", "fine", 52))
    assert gap.verdict == "unidentified"
    assert not gap.effects
    assert gap.description is not None
    assert any(place in gap.description.partition("=")[0] for place in drawn.label["effects"][0]["places"])
    assert gap.description.endswith("not in the library")


@pytest.mark.long
def test_an_effect_is_named_beside_one_that_no_library_has() -> None:
    drawn, gap = answered(Cell("beside", ("cross_law", "solar_bow"), 1.0, "wide", "fine", 52))
    strange, known = drawn.label["effects"]
    assert gap.verdict == "named"
    assert [(effect.family, effect.where) for effect in gap.effects] == [(known["family"], known["where"])]
    assert gap.remaining_significant
    assert gap.description is not None
    assert gap.description.startswith(f"{strange['where']} angle error = ")
    assert "the remaining errors depend on something that no effect of the library explains" in gap.warnings
    true = known["coefficients"]["rad_per_K"]
    (coefficient,) = gap.effects[0].reported
    assert coefficient.value == pytest.approx(true, abs=4.0 * coefficient.standard_error)


@pytest.mark.long
@pytest.mark.parametrize(
    ("family", "poses", "seed", "lookalike", "formula"),
    [
        ("base_step", "wide", 310064, "base_settlement@base", r"base"),
        ("transducer_index_jump", "face", 330045, "base_step@base", r"L3 length error = .* \(t > "),
        (
            "load_hysteresis",
            "face",
            310021,
            "backlash@theta5",
            r"theta5 angle error = .* dir\(theta5\) torque\(theta5\)",
        ),
        ("boom_droop", "face", 310005, "joint_compliance@theta4", r"theta4 angle error = .* torque\(theta4\) length"),
    ],
)
def test_what_the_library_lacks_is_not_given_the_name_of_something_like_it(
    family: str, poses: Poses, seed: int, lookalike: str, formula: str
) -> None:
    drawn = draw(SOURCE.rig, Cell("left_out", (family,), 1.0, poses, "fine", seed))
    assert drawn is not None
    observations = parse_observations(drawn.train.encode(), SOURCE.rig, "case.csv")
    gap = find_gap(SOURCE.rig, SOURCE.text, observations, families=set(library()) - {family})
    assert gap.verdict == "unidentified"
    assert not gap.effects
    (candidate, *_) = (c for round_ in gap.rounds for c in round_.candidates if f"{c.family}@{c.where}" == lookalike)
    assert re.match(".* explains it better|its size would depend on .*", candidate.reason)
    assert gap.description is not None
    assert re.search(formula, gap.description)


def test_evidence_in_the_projected_space_is_that_of_effect_and_kinematics_together() -> None:
    rng = np.random.default_rng(3)
    kinematics, columns = rng.normal(0.0, 3.0, (40, 5)), rng.normal(0.0, 1.0, (40, 2))
    sigma, target = np.array([0.4, 2.0]), rng.normal(0.0, 2.0, 40)
    without_kinematics = SoftProjection(kinematics)
    nothing = np.eye(40) + kinematics @ kinematics.T
    scaled = columns * sigma
    with_effect = nothing + scaled @ scaled.T
    expected = [multivariate_normal(np.zeros(40), matrix).logpdf(target) for matrix in (with_effect, nothing)]
    left = without_kinematics(columns)
    found = from_products(left.T @ left, left.T @ without_kinematics(target), sigma)
    assert found == pytest.approx(expected[0] - expected[1], abs=1e-8)


@pytest.mark.parametrize("parameters", [5, 60])
def test_products_in_the_projected_space_follow_from_what_is_taken_out(parameters: int) -> None:
    rng = np.random.default_rng(6)
    kinematics = rng.normal(size=(40, parameters)) * 10.0 ** rng.uniform(-3.0, 4.0, parameters)
    a, b = rng.normal(size=(40, 3)), rng.normal(size=(40, 2))
    without_kinematics = SoftProjection(kinematics)
    expected = a.T @ np.linalg.solve(np.eye(40) + kinematics @ kinematics.T, b)
    np.testing.assert_allclose(without_kinematics(a).T @ without_kinematics(b), expected, atol=1e-6)
    np.testing.assert_allclose(
        a.T @ b - without_kinematics.removed(a).T @ without_kinematics.removed(b), expected, atol=1e-6
    )


def test_a_fit_without_a_fold_is_that_of_the_other_rows() -> None:
    rng = np.random.default_rng(4)
    design, target, fold = rng.normal(size=(30, 4)), rng.normal(size=30), np.arange(10) % 3
    for number, x in without_folds(design, target, fold):
        rows = np.repeat(fold != number, 3)
        own = design[rows]
        np.testing.assert_allclose(x, np.linalg.solve(own.T @ own + np.eye(4), own.T @ target[rows]), rtol=1e-9)


def test_the_step_of_an_encoder_is_seen_in_its_readings() -> None:
    angles = np.random.default_rng(5).uniform(-15.0, 60.0, 200)
    assert step_of(np.rint(angles / 0.1) * 0.1) == pytest.approx(0.1, rel=1e-6)
    assert step_of(angles) == 0.0
    assert step_of(np.repeat([1.0, 2.0, 3.0], 10)) == 0.0


@pytest.mark.long
def test_an_encoder_that_reads_in_coarser_steps_than_its_file_says_hides_less_when_its_steps_are_known() -> None:
    """As noise of one size along all axes, 0.1 deg at eight metres would drown an error along the boom."""
    drawn = draw(SOURCE.rig, Cell("single", ("transducer_scale",), 0.5, "wide", "coarse", 370009))
    assert drawn is not None
    gap = find_gap(SOURCE.rig, SOURCE.text, parse_observations(drawn.train.encode(), SOURCE.rig, "case.csv"))
    assert {(effect.family, effect.where) for effect in gap.effects} == hidden(drawn)
    assert gap.model.rig == SOURCE.rig
