"""What the gap workflow answers, by the truth that is hidden; and the mathematics that its answers rest on."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from calibration.gap.adequacy import step_of
from calibration.gap.projection import Softly, log_bayes_factor, without_folds
from calibration.gap.result import Gap
from calibration.gap.workflow import find_gap
from calibration.observations import parse_observations
from daemon.rigs import load_rig
from simulators.aliases import alias_scene
from simulators.cases import Drawn, draw
from simulators.cells import Cell
from simulators.hidden import hide
from simulators.scene import SceneSettings, draw_scene
from simulators.visible import Visibility

SOURCE = load_rig("swdt82")


def answered(cell: Cell) -> tuple[Drawn, Gap]:
    drawn = draw(SOURCE.rig, cell)
    assert drawn is not None
    return drawn, find_gap(SOURCE.rig, SOURCE.text, parse_observations(drawn.train.encode(), SOURCE.rig, "case.csv"))


def hidden(drawn: Drawn) -> set[tuple[str, str]]:
    return {(effect["family"], effect["where"]) for effect in drawn.label["effects"]}


def test_two_effects_are_both_named_where_they_are_and_the_gap_closes() -> None:
    drawn, gap = answered(Cell("pair", ("angle_scale", "linkage_coupling"), 1.0, "wide", "fine", 43))
    assert gap.verdict == "named"
    assert {(effect.family, effect.where) for effect in gap.effects} == hidden(drawn)
    assert [len(round_.adopted) for round_ in gap.rounds] == [1, 1, 0]
    assert not gap.remaining_significant
    assert gap.rounds[-1].held_out_mm < gap.rounds[0].held_out_mm


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


def test_an_effect_that_no_library_has_is_described_and_gets_no_name() -> None:
    drawn, gap = answered(Cell("outside", ("thermal_cross",), 1.0, "wide", "fine", 52))
    assert gap.verdict == "unidentified"
    assert not gap.effects
    assert gap.description is not None
    assert any(place in gap.description.partition("=")[0] for place in drawn.label["effects"][0]["places"])
    assert gap.description.endswith("not in the library")


def test_evidence_in_the_projected_space_is_that_of_effect_and_kinematics_together() -> None:
    rng = np.random.default_rng(3)
    kinematics, columns = rng.normal(0.0, 3.0, (40, 5)), rng.normal(0.0, 1.0, (40, 2))
    sigma, target = np.array([0.4, 2.0]), rng.normal(0.0, 2.0, 40)
    softly = Softly(kinematics)
    nothing = np.eye(40) + kinematics @ kinematics.T
    scaled = columns * sigma
    with_effect = nothing + scaled @ scaled.T
    expected = [multivariate_normal(np.zeros(40), matrix).logpdf(target) for matrix in (with_effect, nothing)]
    found = log_bayes_factor(softly(columns), softly(target), sigma)
    assert found == pytest.approx(expected[0] - expected[1], abs=1e-8)


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
