"""Curves of a joint's own angle: their shape, when the data may ask for them, and what they make good.

The curves that are hidden here are drawn by the simulator, as sums of cosines, and know nothing of splines.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest

from calibration.effects.base import FittedCoefficient
from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice
from calibration.effects.library import library
from calibration.evaluation.evaluation import evaluate
from calibration.gap.candidates import candidate_at
from calibration.gap.joint_fit import joint_fit
from calibration.gap.projected.projection import Projection
from calibration.gap.screening import Screen
from calibration.identification.solve import Solution
from calibration.kinematics.chain import Chain, Placement
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Floats, Observations
from calibration.pipeline.calibrate import identify
from calibration.rig.description import Rig, shipped_rig
from tests.calibration.conftest import rig_text, rms, split_by_cells
from tests.calibration.effects.test_effects import measured, solved

MAP = library()["joint_error_map"]
RANGE = {"low_deg": -15.0, "high_deg": 60.0, "pieces": 20.0, "sigma_rad": 4e-4}
TURN = {"pieces": 24.0, "sigma_rad": 4e-4}


def at_angles(angle_deg: Floats, rig: Rig | None = None, where: str = "theta4") -> EffectContext:
    """Observations whose joint `where` reads these angles, the others zero."""
    rig = rig or shipped_rig("swdt82")
    n = len(angle_deg)
    joints = {name: np.zeros(n) for name in rig.joint_names} | {where: angle_deg}
    text, blank = np.full(n, ""), np.full((n, 3), np.nan)
    table = Observations(np.full(n, rig.prism_names[0]), joints, blank, blank, text, text, text)
    chain = Chain(rig, {"": Placement.identity()})
    return EffectContext(chain, np.zeros(len(chain)), table)


def columns_rad(angle_deg: Floats, settings: Mapping[str, float]) -> Floats:
    """(n, k) rad per unit of each weight."""
    return np.radians(MAP.columns(at_angles(angle_deg), "theta4", settings))


def fitted(weights: Floats, errors: Floats) -> tuple[FittedCoefficient, ...]:
    pairs = zip(weights.tolist(), errors.tolist(), strict=True)
    return tuple(FittedCoefficient(f"basis{i + 1}_rad", "rad", w, e, 4e-4) for i, (w, e) in enumerate(pairs))


# -- shape -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [RANGE, TURN])
def test_each_angle_touches_four_splines_that_add_up_to_one(settings: Mapping[str, float]) -> None:
    columns = columns_rad(np.linspace(-15.0, 60.0, 200), settings)
    np.testing.assert_allclose(columns.sum(axis=1), 1.0)
    assert ((columns != 0.0).sum(axis=1) <= 4).all()
    assert columns.min() >= 0.0


def test_a_curve_over_a_turn_closes_smoothly() -> None:
    weights = np.random.default_rng(1).standard_normal(24)
    angle = np.linspace(-400.0, 400.0, 160001)
    curve = columns_rad(angle, TURN) @ weights
    np.testing.assert_allclose(columns_rad(angle + 360.0, TURN) @ weights, curve, atol=1e-9)
    bent = np.diff(curve, 2)
    assert np.abs(np.diff(bent)).max() < 1e-2 * np.abs(bent).max()


def test_beyond_the_trained_range_a_curve_stays_at_its_end() -> None:
    columns = columns_rad(np.array([-90.0, -15.0, 60.0, 61.0, 200.0]), RANGE)
    np.testing.assert_array_equal(columns[0], columns[1])
    np.testing.assert_array_equal(columns[3:], columns[[2, 2]])
    assert not np.array_equal(columns[1], columns[2])


@pytest.mark.parametrize("settings", [RANGE, TURN])
def test_an_angle_that_is_no_number_stays_in_sight(settings: Mapping[str, float]) -> None:
    columns = columns_rad(np.array([np.nan, np.inf, 1e300, 20.0]), settings)
    assert np.isnan(columns[:2]).all()
    assert np.isfinite(columns[2:]).all()


# -- what outputs list -------------------------------------------------------------------------------------------------


def test_the_size_that_is_reported_is_the_rms_about_the_mean() -> None:
    angle = np.linspace(-15.0, 60.0, 4000)
    wave = 2e-3 * np.cos(np.radians(24.0 * angle)) + 5e-3
    weights = np.linalg.lstsq(columns_rad(angle, RANGE), wave, rcond=None)[0]
    (found,) = MAP.reported(RANGE, fitted(weights, np.full(23, 1e-5)))
    assert (found.name, found.unit) == ("rms_rad", "rad")
    assert found.value == pytest.approx(np.std(wave), rel=0.02)


def test_its_standard_error_is_the_scatter_that_errors_of_the_weights_make() -> None:
    rng = np.random.default_rng(2)
    weights, errors = 1e-3 * rng.standard_normal(24), rng.uniform(2e-5, 2e-4, 24)
    (found,) = MAP.reported(TURN, fitted(weights, errors))
    drawn = [MAP.reported(TURN, fitted(weights + errors * rng.standard_normal(24), errors))[0] for _ in range(400)]
    assert found.standard_error == pytest.approx(np.std([d.value for d in drawn]), rel=0.15)
    (nothing,) = MAP.reported(TURN, fitted(np.zeros(24), errors))
    assert nothing.value == 0.0
    assert nothing.standard_error > 0.0


# -- where it may be ---------------------------------------------------------------------------------------------------


def test_a_curve_needs_poses_in_each_of_its_waves() -> None:
    rng = np.random.default_rng(3)
    standstills = np.repeat(rng.uniform(-15.0, 60.0, 12), 30) + 0.005 * rng.standard_normal(360)
    assert MAP.variants(at_angles(standstills), "theta4") == ()
    few, many = (MAP.variants(at_angles(rng.uniform(-15.0, 60.0, n)), "theta4") for n in (60, 600))
    assert max(s["pieces"] for s in few) <= 20 < max(s["pieces"] for s in many) <= 60
    context = at_angles(rng.uniform(-200.0, 250.0, 600))
    turn = MAP.variants(context, "theta4")
    assert all("low_deg" not in s for s in turn)
    assert all(len(MAP.names(s)) == len(MAP.coefficients(context, "theta4", s)) for s in (*few, *many, *turn))


@pytest.mark.parametrize(
    "settings",
    [
        {**RANGE, "pieces": 20.5},
        {**RANGE, "pieces": 2.0},
        {**TURN, "pieces": 1e9},
        {**TURN, "sigma_rad": 0.0},
        {**TURN, "sigma_rad": float("nan")},
        {**RANGE, "low_deg": 60.0},
        {"low_deg": 0.0, **TURN},
        {},
    ],
)
def test_settings_that_make_no_curve_are_refused(settings: Mapping[str, float]) -> None:
    with pytest.raises(ValueError, match="settings are pieces"):
        MAP.names(settings)


# -- a boom that has one -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Boom:
    """A simulated boom with a curve at theta4, seen through 3 mm of noise."""

    rig: Rig
    training: Observations
    model: CalibratedModel


@pytest.fixture(scope="module")
def boom() -> Boom:
    rig = shipped_rig("swdt82")
    training = measured(rig, "joint_error_map@theta4:rms_rad=2e-3:seed=4", 250, 11, noise_mm=3.0)
    return Boom(rig, training, identify(rig, rig_text("swdt82"), training, effects="joint_error_map@theta4"))


def test_a_hidden_curve_is_made_good_on_poses_never_seen(boom: Boom) -> None:
    held_out = measured(boom.rig, "joint_error_map@theta4:rms_rad=2e-3:seed=4", 300, 12, noise_mm=0.0)
    before = rms(held_out.position_mm - Predictor.of(boom.model).geometric_mm(held_out))
    after = rms(held_out.position_mm - Predictor.of(boom.model).effects_mm(held_out))
    assert before > 8.0
    assert after < 0.35 * before
    (effect,) = boom.model.effects
    (size,) = effect.reported
    assert abs(size.value - 2e-3) < 4e-4


def test_weights_of_a_curve_are_no_parameters_that_data_must_determine(boom: Boom) -> None:
    assert boom.model.identifiability.parameters == len(boom.model.chain)
    assert not any("joint_error_map" in sentence for sentence in boom.model.identifiability.unidentifiable)


def test_where_no_pose_was_the_prediction_says_that_it_does_not_know_the_curve(boom: Boom) -> None:
    angle = boom.training.joints["theta4"]
    elsewhere = boom.training.select((angle < 20.0) | (angle > 35.0))
    ignorant = identify(boom.rig, rig_text("swdt82"), elsewhere, effects="joint_error_map@theta4")
    poses = boom.training.select(np.arange(2))

    def unsure_mm(model: CalibratedModel) -> float:
        """By how much more the prediction is unsure in the middle of those angles than beside them."""
        beside, within = (
            rms(Predictor.of(model).predict(replace(poses, joints={**poses.joints, "theta4": np.full(2, at)})).sigma_mm)
            for at in (10.0, 27.5)
        )
        return float(np.sqrt(max(within**2 - beside**2, 0.0)))

    assert unsure_mm(ignorant) > 2.0
    assert unsure_mm(boom.model) < 1.0


@pytest.mark.parametrize(
    ("hidden", "family"),
    [
        ("encoder_harmonic@theta4:cosk_rad=2e-3:sink_rad=1e-3:k=2", "encoder_harmonic"),
        ("encoder_harmonic@theta3:cosk_rad=-1e-3:sink_rad=2e-3:k=1", "encoder_harmonic"),
        ("joint_error_map@theta4:rms_rad=1e-3:lines=2:highest=30:seed=7", "joint_error_map"),
        ("joint_error_map@theta3:rms_rad=1e-3:seed=8", "joint_error_map"),
    ],
)
def test_a_curve_does_not_take_the_place_of_a_harmonic_nor_a_harmonic_of_a_curve(hidden: str, family: str) -> None:
    rig = shipped_rig("swdt82")
    where = hidden.partition("@")[2].partition(":")[0]
    observations = measured(rig, hidden, 250, 21, noise_mm=3.0)
    solution = solved(rig, observations)
    evidence = scored(solution, observations, where)
    assert max(evidence, key=lambda name: evidence[name]) == family
    first, second, *_ = sorted(evidence.values(), reverse=True)
    assert first > second + 5.0 > 10.0


def scored(solution: Solution, observations: Observations, where: str) -> dict[str, float]:
    """ln of the Bayes factor of each rival at a joint, at the noise that the best of them leaves."""
    context = EffectContext(solution.chain, solution.fit.x, observations)
    names = ("joint_error_map", "encoder_harmonic", "angle_scale")
    variants = {n: [Choice(n, where, s) for s in library()[n].variants(context, where)] for n in names}
    fits = [
        joint_fit(solution, observations, [choices[len(choices) // 2]], "recalibration")
        for choices in variants.values()
    ]
    fit = replace(solution.fit, excess_variance=min(f.fit.excess_variance for f in fits))
    over = Projection(solution, context, fit)
    places = [candidate_at(context, over, name, where, choices) for name, choices in variants.items()]
    return {w.candidate.family: w.log_bayes_factor for w in Screen(over, places).score()}


# -- measured ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_curves_of_five_joints_explain_what_kinematics_leave_of_a_measured_robot(
    ur10_random_poses: Observations,
) -> None:
    """Of 2,002 training poses every third; all of them reach 0.093 mm."""
    rig = shipped_rig("ur10")
    training, held_out = split_by_cells(ur10_random_poses, 0.7, 0)
    names = ",".join(f"joint_error_map@q{joint}" for joint in range(1, 6))
    model = identify(rig, rig_text("ur10"), training.select(np.arange(0, len(training), 3)), effects=names)
    found = {str(s["stage"]): float(s["rms_mm"]) for s in evaluate(model, held_out).stages()}
    assert found["geometric"] > 0.45
    assert found["effects"] <= 0.12
    assert model.noise_mm == pytest.approx(found["effects"], rel=0.25)
