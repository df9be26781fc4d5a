"""What no rig file says the data choose: how a prism stands, how far sections overlap, where a cylinder sinks."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.special import softmax

from calibration.effects.context import EffectContext, level_axes
from calibration.effects.fitted import Choice
from calibration.effects.library import library
from calibration.gap.candidates import candidate_at, variants_at
from calibration.gap.detection import neighbour_tests
from calibration.gap.projected.projection import Projection
from calibration.gap.screening import Screen
from calibration.identification.identifiability import identifiability
from calibration.identification.linear_model import prior_precision
from calibration.identification.refinement import refine
from calibration.identification.solve import Solution, place
from calibration.identification.start import PRIOR_SCALE, approach
from calibration.observations import Floats, Observations, parse_observations
from calibration.rig.description import Prism, Rig, shipped_rig
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

RIG = shipped_rig("swdt82")
FIXES = 150


@cache
def measured() -> Observations:
    """The boom without any effect, 3 mm of noise; it stood for up to three minutes before every fix."""
    rng = np.random.default_rng(11)
    columns = {"dwell_s": rng.uniform(5.0, 180.0, FIXES), "time_s": np.linspace(0.0, 2e4, FIXES)}
    table = simulate_observations(RigTruth(RIG, 11), FIXES, 11, prisms_per_pose="one", noise_mm=3.0, columns=columns)
    return parse_observations(table.csv_text().encode(), RIG, "simulated.csv")


def projected(shift: Floats | None = None) -> Projection:
    """The fit of the kinematics, with the fixes shifted by so much (n, 3), mm."""
    observations = measured()
    if shift is not None:
        observations = replace(observations, position_mm=observations.position_mm + shift)
    return fitted(RIG, observations)


def fitted(rig: Rig, observations: Observations) -> Projection:
    """The fit of the kinematics."""
    chain, samples, start = place(rig, observations)
    nominal = refine(chain, samples, start.x, free=np.isinf(chain.prior_sigma))
    near = approach(chain, samples, nominal.x, precision=prior_precision(chain, PRIOR_SCALE["recalibration"]))
    fit = refine(chain, samples, near)
    seen = identifiability(chain, samples, fit.x, fit.excess_variance)
    return Projection(Solution(chain, samples, nominal, fit, seen, "", 0.0), EffectContext(chain, fit.x, observations))


@pytest.fixture(scope="module")
def bare() -> Projection:
    return projected()


def moved(projection: Projection, choice: Choice, values: tuple[float, ...]) -> Floats:
    """(n, 3) what an effect does to the fixes, mm."""
    shift: Floats = projection.moved_mm(choice.columns(projection.context)) @ np.array(values)
    return shift


@pytest.mark.parametrize(
    ("family", "where", "values", "number"),
    [
        ("prism_incidence", "r", (6.0, -5.0), 1),
        ("prism_incidence", "r", (6.0, -5.0), 2),
        ("leak_down", "theta6", (4e-5,), 1),
        ("leak_down", "theta6", (4e-5,), 0),
        ("base_settlement", "base", (9e-4, -9e-4, -3.0), 0),
        ("base_settlement", "base", (9e-4, -9e-4, -3.0), 3),
    ],
)
def test_the_data_tell_the_form_and_the_coefficients_go_with_it(
    bare: Projection, family: str, where: str, values: tuple[float, ...], number: int
) -> None:
    forms = variants_at(bare.context, family, where)
    shown = projected(moved(bare, forms[number], values))
    found = Screen(shown, [candidate_at(shown.context, shown, family, where, forms)]).score()[0]
    assert found.choice.settings == forms[number].settings
    assert (np.abs(found.estimate - values) < 3.5 * found.standard_error).all()


def test_over_less_than_half_a_turn_an_encoder_errs_once_or_twice_a_turn_but_not_both(bare: Projection) -> None:
    forms = variants_at(bare.context, "encoder_harmonic", "theta7")
    assert [form.settings for form in forms] == [{"k": 1.0}, {"k": 2.0}]


def test_the_clearance_of_pads_is_as_open_as_what_they_overlap(bare: Projection) -> None:
    forms = variants_at(bare.context, "pad_play", "boom")
    hidden = next(form for form in forms if form.settings["left"] == pytest.approx(0.2))
    shown = projected(moved(bare, hidden, (5.0,)))
    screen = Screen(shown, [candidate_at(shown.context, shown, "pad_play", "boom", forms)])
    probability = softmax([screen.log_bayes_factor([(0, option)]) for option in range(len(forms))])
    between = library()["pad_play"].posterior_settings([form.settings for form in forms], probability)
    assert abs(np.log(between["left"] / 0.2)) < 3.0 * between["left_spread"] < 1.5
    choice = replace(hidden, settings=between)
    found = Screen(shown, [candidate_at(shown.context, shown, "pad_play", "boom", [choice])]).score()[0]
    told = choice.fitted(shown.context, found.estimate, found.standard_error).reported[0]
    assert told.standard_error > 2.0 * found.standard_error[0]
    assert abs(told.value - 5.0) < 2.5 * told.standard_error


@pytest.mark.parametrize(("sign", "option"), [(1.0, 0), (-1.0, 1)])
def test_of_forms_that_mirror_each_other_the_one_within_its_limits_is_taken(
    bare: Projection, sign: float, option: int
) -> None:
    """Where the load always lifts a joint's value, both forms of a leak explain as much, one of them with -rate."""
    falls = variants_at(bare.context, "leak_down", "theta6")[0]
    shown = projected(sign * moved(bare, falls, (4e-5,)))
    both = candidate_at(shown.context, shown, "leak_down", "theta6", [falls, falls])
    upwards = replace(both.additions[1], column=-both.additions[1].column)
    found = Screen(shown, [replace(both, additions=(both.additions[0], upwards))]).score()[0]
    assert found.option == option
    assert found.estimate[0] == pytest.approx(4e-5, rel=0.2)


def test_the_base_tilts_about_level_axes_wherever_its_own_point(bare: Projection) -> None:
    np.testing.assert_array_equal(level_axes((0.0, 0.0, -1.0)), np.eye(3))
    x, y, up = level_axes((0.0, 9.81, 0.0))  # the frame's y axis points down
    np.testing.assert_allclose((x, y, up), [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)
    leaning = level_axes((0.3, -0.2, -0.9))
    np.testing.assert_allclose(leaning @ leaning.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(leaning) == pytest.approx(1.0)
    assert leaning[2] @ np.array([0.3, -0.2, -0.9]) < 0.0
    # A rise is a rise in the station's frame, which is level, and tilts leave the origin's vertical alone.
    rise = bare.context.base_motion_mm(np.ones(FIXES))[:, :, 2]
    assert (rise[:, 2] > np.cos(np.radians(2.0))).all()


def heard(projection: Projection) -> set[str]:
    """Along which variables neighbours share an error."""
    found = neighbour_tests(projection, np.random.default_rng(3), 999)
    return {along.variable for along in found if along.shared > 3.5 * along.chance.std()}


def test_neighbours_share_an_error_that_no_formula_has_and_no_noise(bare: Projection) -> None:
    time_h = measured().extra["time_s"] / 3600.0
    swings = np.outer(np.sin(2.0 * np.pi * time_h / 0.7), [2.0, -3.0, 2.5])
    range_m = np.linalg.norm(measured().position_mm, axis=1) / 1e3
    ripples = measured().position_mm / range_m[:, None] * 5e-3 * np.sin(2.0 * np.pi * range_m / 2.0)[:, None]

    assert heard(bare) == set()
    assert heard(projected(swings)) == {"time"}
    assert heard(projected(ripples)) == {"range"}


def test_noise_chooses_no_neighbours_of_a_prism_that_stands_still() -> None:
    foot = Prism(name="foot", frame=0, offset_mm=(-800.0, 0.0, 300.0))
    rig = RIG.model_copy(update={"prisms": (*RIG.prisms, foot)})
    table = simulate_observations(RigTruth(rig, 1), 75, 1, noise_mm=3.0, prisms=("s", "foot"))
    assert heard(fitted(rig, parse_observations(table.csv_text().encode(), rig, "simulated.csv"))) == set()


def test_an_effect_beside_others_is_weighed_as_all_together_are(bare: Projection) -> None:
    """The others are factored once; their products with an effect are what is left to do for each of its forms."""
    names = [("leak_down", "theta6"), ("encoder_harmonic", "theta7"), ("base_settlement", "base")]
    places = [candidate_at(bare.context, bare, *name, variants_at(bare.context, *name)) for name in names]
    screen = Screen(bare, places)
    chosen = {0: (0, 1.0), 2: (1, 3.0)}
    given = screen.given(chosen)
    assert given.log_bayes_factor == pytest.approx(screen.log_bayes_factor([(0, 0), (2, 1)], [1.0, 3.0]))
    for option in range(2):
        together = screen.log_bayes_factor([(0, 0), (2, 1), (1, option)], [1.0, 3.0, 10.0])
        assert given.together(1, option, 10.0) == pytest.approx(together)
    assert screen.given({}).log_bayes_factor == 0.0
    assert screen.given({}).together(1, 0, 1.0) == pytest.approx(screen.log_bayes_factor([(1, 0)]))


def test_forms_that_differ_in_their_prior_alone_share_their_columns(bare: Projection) -> None:
    forms = variants_at(bare.context, "joint_error_map", "theta7")
    first, second = candidate_at(bare.context, bare, "joint_error_map", "theta7", forms).additions[:2]
    assert first.has_columns_of(second)
    assert (first.prior_sigma < second.prior_sigma).all()
