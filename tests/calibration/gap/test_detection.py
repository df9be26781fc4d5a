"""Detection and the grammar: alarms only beyond chance, and formulas that say where and on what an error depends."""

from __future__ import annotations

import copy
import re
import tracemalloc
from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice
from calibration.effects.library import library
from calibration.gap.candidates import candidate_effects
from calibration.gap.detection import detect
from calibration.gap.formulas.grammar import Grammar, describe
from calibration.gap.formulas.terms import columns_of, modulations
from calibration.gap.formulas.variables import ErrorSource, Variable
from calibration.gap.projected.projection import Projection, cells
from calibration.gap.screening import Screen
from calibration.gap.search_result import closes_gap
from calibration.identification.identifiability import identifiability
from calibration.identification.linear_model import prior_precision
from calibration.identification.refinement import refine
from calibration.identification.solve import Solution, place
from calibration.identification.start import PRIOR_SCALE, approach
from calibration.observations import Floats, Observations, parse_observations
from calibration.rig.description import Rig, shipped_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

FIXES = 250


def measured(
    rig: Rig, effects: str, seed: int, *, columns: Mapping[str, Floats] | None = None, noise_mm: float = 3.0
) -> Observations:
    truth = RigTruth(rig, seed, effects=parse_effects(effects))
    table = simulate_observations(
        truth,
        FIXES,
        seed,
        prisms_per_pose="one",
        noise_mm=noise_mm,
        columns=weather(seed) if columns is None else columns,
    )
    return parse_observations(table.csv_text().encode(), rig, "simulated.csv")


def weather(seed: int) -> dict[str, Floats]:
    """A day that warms up and cools down again."""
    slow = np.linspace(0.3, 2.7, FIXES)
    return {"temperature_degC": 15.0 + 8.0 * np.sin(slow) + np.random.default_rng(seed).normal(0.0, 0.6, FIXES)}


def projected(rig: Rig, observations: Observations) -> Projection:
    return about(solved(rig, observations), observations)


def solved(rig: Rig, observations: Observations) -> Solution:
    chain, samples, start = place(rig, observations)
    nominal = refine(chain, samples, start.x, free=np.isinf(chain.prior_sigma))
    near = approach(chain, samples, nominal.x, precision=prior_precision(chain, PRIOR_SCALE["recalibration"]))
    fit = refine(chain, samples, near)
    seen = identifiability(chain, samples, fit.x, fit.excess_variance)
    return Solution(chain, samples, nominal, fit, seen, "", 0.0)


def about(solution: Solution, observations: Observations) -> Projection:
    return Projection(solution, EffectContext(solution.chain, solution.fit.x, observations))


@cache
def grammar(effects: str, seed: int = 1) -> Grammar:
    rig = shipped_rig("swdt82")
    return Grammar(projected(rig, measured(rig, effects, seed)))


def alarm(words: Grammar, seed: int = 0) -> float:
    return detect(words, np.random.default_rng(seed)).p


# -- by chance ---------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_machine_without_hidden_effects_raises_no_alarm_whatever_its_noise() -> None:
    """Two alarms at p < 0.01 in 8 nulls are chance once in four hundred times."""
    rig = shipped_rig("swdt82")
    alarms = 0
    for seed in range(1000, 1008):
        observations, rng = measured(rig, "", seed), np.random.default_rng(seed)
        wild = rng.random(FIXES) < 0.03
        position = observations.position_mm + np.where(wild[:, None], rng.normal(0.0, 40.0, (FIXES, 3)), 0.0)
        coarse = {name: np.rint(v / 0.1) * 0.1 if name[0] == "t" else v for name, v in observations.joints.items()}
        sigma = np.full((FIXES, 3), 1.5)
        odd = {
            0: observations,
            1: replace(observations, joints=coarse),
            2: replace(observations, position_mm=position),
            3: replace(observations, sigma_mm=sigma),
        }[seed % 4]
        words = Grammar(projected(rig, odd))
        alarms += alarm(words) < 0.01
        assert words.find() == ()
    assert alarms <= 1


def test_scores_are_sums_over_groups_and_standard_normal_by_chance() -> None:
    words = grammar("")
    labels = len(np.unique(words.projection.groups))
    assert words.by_group.shape == (labels, len(words.terms))
    np.testing.assert_allclose(words.by_group.sum(axis=0), words.score)
    assert 0.7 < np.sqrt(np.mean(words.score**2)) < 1.3
    assert np.abs(words.score).max() < 5.0


def test_no_probability_is_smaller_than_that_of_all_signs_alike() -> None:
    words = copy.copy(grammar("creep@theta4:rad_per_Nm=8e-9"))
    assert detect(words, np.random.default_rng(0)).p < 0.5**7
    sums = np.zeros((8, len(words.terms)))
    np.add.at(sums, np.arange(len(words.by_group)) % 8, words.by_group)
    words.by_group, words.score = sums, sums.sum(axis=0)
    assert detect(words, np.random.default_rng(0)).p >= 0.5**7


def test_a_machine_of_a_few_millimetres_has_groups_as_a_large_one_has() -> None:
    rig = shipped_rig("swdt82")
    samples = projected(rig, measured(rig, "", 7)).samples
    tiny = replace(samples, position_mm=samples.position_mm / 1e3)
    assert len(np.unique(cells(samples))) > 200
    assert len(np.unique(cells(tiny))) > 50


def test_thirty_signals_that_have_nothing_to_do_with_it_raise_no_alarm() -> None:
    rig = shipped_rig("swdt82")
    rng = np.random.default_rng(5)
    observations = measured(rig, "", 5)
    signals = {f"valve{i}_mA": np.cumsum(rng.normal(0.0, 1.0, FIXES)) for i in range(30)}
    words = Grammar(projected(rig, replace(observations, extra={**observations.extra, **signals})))
    assert any("valve7" in term.variable.text for term in words.terms)
    assert len(words.terms) < 3000
    assert alarm(words) > 0.01


def test_what_a_size_depends_on_is_asked_beside_the_error_itself() -> None:
    """A fitted size is shrunk: along the error there is always something left, and what hardly varies goes with it."""
    projection = grammar("").projection
    joint = projection.context.chain.joint_index["theta5"]
    place = ErrorSource("theta5", "its error", {}, projection.joint_jacobian[:, :, joint])
    itself = projection.columns(place.moved_mm[:, :, None])[:, 0]
    terms = modulations(projection, place)
    assert len(terms) > 20
    np.testing.assert_allclose(columns_of(projection, terms)[1].T @ itself / np.linalg.norm(itself), 0.0, atol=1e-9)


# -- what is there -----------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    ("effect", "where", "formula"),
    [
        ("creep@theta4:rad_per_Nm=8e-9", "theta4", r"theta4 angle error = .* \(rad/\(N m\)\) torque\(theta4\) log"),
        ("cross_law@theta5:rad=4e-3", "theta5", r"theta5 angle error = .* \(rad/m\) sin\(3 theta4\) \(L2 - 1\.\d+\)"),
        ("twist_by_reach@boom:flexibility_per_Nm2=3e-7", "boom", r"twist of the boom = .* its moment length"),
        ("base_rocking@base:rad_per_Nm=2e-8", "base", r"base tilt = .* \(rad/\(N m\)\) moment of all weights"),
        ("thermal_cross@theta4:rad_at_10K=4e-3", "theta4", r"theta4 angle error = .* \(rad/\(K m\)\) dT L2"),
        ("linkage_coupling@theta1:coupling=5e-3", "theta1", r"row coupled to theta1 = [-.e\d]+ theta1"),
        ("prism_incidence@s:cos1_mm=8", "s", r"range error of prism s = .* \(mm\) cos\(incidence\)"),
    ],
)
def test_a_formula_says_where_and_on_what_a_hidden_effect_depends(effect: str, where: str, formula: str) -> None:
    words = grammar(effect)
    found = detect(words, np.random.default_rng(0))
    assert found.significant
    assert where in [d.where for d in found.disagreements[:3]]
    p = [d.p for d in found.disagreements]
    assert p == sorted(p)
    assert len({(d.where, d.variable) for d in found.disagreements}) == len(p) <= 10
    formulas = words.find()
    assert formulas[0].term.source.where == where
    assert re.search(formula, describe(formulas))
    assert describe(formulas).endswith("; not in the library")


def test_two_effects_are_two_terms_with_their_sizes() -> None:
    words = grammar("backlash@theta4:width_rad=4e-3,transducer_scale@L2:scale=6e-3", 3)
    found = {f.term.source.where: f for f in words.find()}
    assert set(found) == {"theta4", "L2"}
    for where, text, size in (("theta4", "dir(theta4)", 2e-3), ("L2", "L2", 6.0)):
        f = found[where]
        assert f.term.variable.text == text
        assert abs(f.coefficient - size) < 4.0 * f.standard_error < 0.5 * size


def test_an_error_larger_than_physics_allows_is_no_formula() -> None:
    rig = shipped_rig("swdt82")
    observations = measured(rig, "", 1)

    def found(relative: float) -> str:
        enlarged = replace(observations, position_mm=observations.position_mm * (1.0 + relative))
        return describe(Grammar(projected(rig, enlarged)).find())

    assert "relative error of all fixes = 3.1e-03" in found(0.003)
    assert "relative error" not in found(0.03)


def test_a_term_shows_no_more_beside_the_effect_of_the_library_behind_it_but_beside_any_other() -> None:
    words = grammar("backlash@theta4:width_rad=4e-3")
    (first, *_) = words.find()
    projection = words.projection

    def adds_to(family: str, where: str) -> bool:
        additions = Choice(family, where, {}, scale=10.0).columns(projection.context)
        additions = additions.over(projection.samples.average)
        columns = projection.columns(projection.moved_mm(additions)) * additions.prior_sigma
        return first.adds_to(columns, projection.residual)

    assert not adds_to("backlash", "theta4")
    assert adds_to("backlash", "theta5")
    assert adds_to("angle_scale", "theta4")


# -- words -------------------------------------------------------------------------------------------------------------


def test_a_coefficient_has_the_unit_of_the_error_over_that_of_the_variable() -> None:
    angle = ErrorSource("theta4", "theta4 angle error", {"rad": 1}, np.zeros((1, 3)))
    warm, torque = (Variable(t, t, u, np.ones(1)) for t, u in (("dT", {"K": 1}), ("tau", {"N": 1, "m": 1})))
    turn = Variable("theta4", "angle", {"rad": 1}, np.ones(1))
    assert angle.coefficient_unit(warm) == "rad/K"
    assert angle.coefficient_unit(turn) == "1"
    assert angle.coefficient_unit(warm.times(torque)) == "rad/(K N m)"
    assert angle.coefficient_unit(turn.times(turn)) == "1/rad"
    rate = Variable("rate", "velocity", {"rad": 1, "s": -1}, np.ones(1))
    assert angle.coefficient_unit(rate) == "s"


def test_there_are_no_words_for_what_was_not_measured() -> None:
    rig = shipped_rig("swdt82")
    bare = replace(measured(rig, "", 2), extra={})
    topics = {term.variable.topic for term in Grammar(projected(rig, bare)).terms}
    assert not topics & {"temperature", "time", "dwell", "payload", "direction", "velocity"}
    assert {"angle", "torque", "L2 extension"} <= topics
    half = measured(rig, "", 2)
    temperature = np.where(np.arange(FIXES) < 150, np.nan, half.extra["temperature_degC"])
    half = replace(half, extra={**half.extra, "temperature_degC": temperature})
    topics = {term.variable.topic for term in Grammar(projected(rig, half)).terms}
    assert "temperature" not in topics
    assert "time" in topics


def test_no_two_terms_of_a_place_say_the_same() -> None:
    words = grammar("")
    own = [term for term in words.terms if term.source.quantity == "theta8 angle error"]
    values = np.column_stack([term.variable.values for term in own])
    values = (values - values.mean(axis=0)) / values.std(axis=0)
    alike = np.abs(values.T @ values) / len(values)
    np.fill_diagonal(alike, 0.0)
    assert alike.max() < 0.9996
    assert len({str(term) for term in own}) == len(own) > 100


def test_a_joint_that_never_moved_has_no_words_of_its_own() -> None:
    rig = shipped_rig("swdt82")
    observations = measured(rig, "", 6)
    still = {**observations.joints, "theta8": np.full(FIXES, 3.3)}
    words = Grammar(projected(rig, replace(observations, joints=still)))
    assert not [term for term in words.terms if term.variable.text in ("theta8", "cos(theta8)", "sin(theta8)")]


@pytest.mark.parametrize("name", ["ys100", "ur10"])
def test_any_machine_has_words(name: str) -> None:
    rig = shipped_rig(name)
    truth = RigTruth(rig, 1, effects=parse_effects(f"encoder_harmonic@{rig.joint_names[1]}:cosk_rad=3e-3:k=2"))
    table = simulate_observations(truth, 200, 1, prisms_per_pose="one", noise_mm=0.5)
    observations = parse_observations(table.csv_text().encode(), rig, "simulated.csv")
    words = Grammar(projected(rig, observations))
    assert alarm(words) < 0.01
    assert words.find()[0].term.source.where == rig.joint_names[1]
    assert words.find()[0].term.variable.text == f"cos(2 {rig.joint_names[1]})"


def test_the_same_draws_find_the_same() -> None:
    words = grammar("creep@theta4:rad_per_Nm=8e-9")
    assert detect(words, np.random.default_rng(4)) == detect(words, np.random.default_rng(4))


def test_a_screen_keeps_products_of_columns_and_not_the_columns() -> None:
    over = projected(shipped_rig("swdt82"), measured(shipped_rig("swdt82"), "", 2))
    places = candidate_effects(over.context, over, library()).candidates
    tracemalloc.start()
    try:
        screen = Screen(over, places)
        kept = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    columns = sum(len(p.additions[option]) for p in screen.candidates for option in set(p.first_equal))
    assert kept < 0.3 * columns * over.residual.nbytes


def test_what_becomes_an_outlier_of_a_fit_is_not_explained_by_it() -> None:
    """Kinematics leave a clear gap; then a fit leaves nothing of them all, or of nine in ten."""
    rig = shipped_rig("swdt82")
    observations = measured(rig, "joint_compliance@theta3:compliance_rad_per_Nm=3e-6", 3)
    solution = solved(rig, observations)
    first = about(solution, observations)
    size = np.linalg.norm(first.error_mm, axis=1)
    counts = {"all": first.fit.weight, "most": np.where(size > np.quantile(size, 0.9), 0.0, first.fit.weight)}
    for said, weight in counts.items():
        last = about(replace(solution, fit=replace(solution.fit, excess_variance=0.0, weight=weight)), observations)
        assert closes_gap(first, last, first.fit.weight, is_structured=True) == (said == "all")
