"""Families of joints against machines that have them: sign, size, unit, what they need and what they keep.

Effects and kinematics of these machines share no code with those that are tested.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from calibration.effects.base import FittedCoefficient
from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice, corrected
from calibration.effects.library import library
from calibration.effects.load_shapes import gravity_shapes
from calibration.errors import ModelError
from calibration.kinematics.chain import Chain, Placement
from calibration.model.files import model_from_files, model_to_files
from calibration.model.prediction import Predictor
from calibration.model.warnings import model_warnings
from calibration.observations import Floats, Observations, parse_observations
from calibration.pipeline.calibrate import identify
from calibration.rig.description import Rig, shipped_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import rig_text, rms
from tests.simulated.observations import simulate_observations

POSES = 60


@dataclass(frozen=True)
class Hidden:
    """A simulated effect, and the coefficients that the family of the same name has for it."""

    text: str
    family: str
    where: str
    values: tuple[float, ...]
    variant: int = 0
    columns: Mapping[str, Floats] = field(default_factory=dict)


_RNG = np.random.default_rng(77)
_WARM = {"temperature_degC": 12.0 + 9.0 * np.sin(np.arange(POSES) / 9.0)}
_RODS = {"payload_kg": np.where(np.arange(POSES) % 3 == 0, 400.0, 0.0)}
_PRESSURE = {"L2_bar": _RNG.uniform(20.0, 180.0, POSES)}

HIDDEN = (
    Hidden("joint_compliance@theta4:compliance_rad_per_Nm=5e-9", "joint_compliance", "theta4", (5e-9,)),
    Hidden("joint_compliance@theta5:compliance_rad_per_Nm=2e-8", "joint_compliance", "theta5", (2e-8,)),
    Hidden("backlash@theta1:width_rad=2e-3", "backlash", "theta1", (2e-3,)),
    Hidden("transducer_scale@L2:scale=2e-3", "transducer_scale", "L2", (2e-3,)),
    Hidden(
        "encoder_harmonic@theta5:cosk_rad=1e-3:sink_rad=-2e-3:k=2",
        "encoder_harmonic",
        "theta5",
        (1e-3, -2e-3),
        variant=1,
    ),
    Hidden("angle_scale@theta4:scale=-2e-3", "angle_scale", "theta4", (-2e-3,)),
    Hidden("angle_scale@theta1:scale=2e-3", "angle_scale", "theta1", (2e-3,)),
    Hidden("transducer_quadratic@L2:mm_per_m2=10", "transducer_quadratic", "L2", (10.0,)),
    Hidden("transducer_quadratic@L3:mm_per_m2=-10", "transducer_quadratic", "L3", (-10.0,)),
    Hidden("gravity_flip_play@theta5:width_rad=4e-3", "gravity_flip_play", "theta5", (4e-3,)),
    Hidden("load_hysteresis@theta4:rad_per_Nm=8e-9", "load_hysteresis", "theta4", (8e-9,)),
    Hidden("load_hysteresis@theta5:rad_per_Nm=4e-8", "load_hysteresis", "theta5", (4e-8,)),
    Hidden("leak_down@theta4:rad_per_s=4e-5", "leak_down", "theta4", (4e-5,)),
    Hidden("solar_bow@theta4:rad_per_K=1e-4", "solar_bow", "theta4", (1e-4,), columns=_WARM),
    Hidden("solar_bow@theta5:rad_per_K=-2e-4", "solar_bow", "theta5", (-2e-4,), columns=_WARM),
    Hidden("solar_bow@theta1:rad_per_K=3e-4", "solar_bow", "theta1", (3e-4,), columns=_WARM),
    Hidden("solar_bow@theta8:rad_per_K=3e-4", "solar_bow", "theta8", (3e-4,), columns=_WARM),
    Hidden("cylinder_compression@L2:mm_per_bar=0.05", "cylinder_compression", "L2", (0.05,), columns=_PRESSURE),
    Hidden(
        "payload_change@theta4:compliance_rad_per_Nm=5e-8",
        "payload_change",
        "theta4",
        (5e-8,),
        columns=_RODS,
    ),
)


def simulated(truth: RigTruth, n: int, columns: Mapping[str, Floats] | None = None) -> Observations:
    table = simulate_observations(
        truth, n, 2, prisms_per_pose="one", noise_mm=0.0, joint_noise=False, columns=dict(columns or {})
    )
    return parse_observations(table.csv_text().encode(), truth.rig, "simulated.csv")


def context_of(truth: RigTruth, observations: Observations) -> EffectContext:
    """As a perfect calibration of the kinematics sees it."""
    placement = truth.placement()
    chain = Chain(truth.rig, {"": Placement(placement.rotation, placement.position_mm)})
    return EffectContext(chain, np.zeros(len(chain)), observations)


def remaining(context: EffectContext, choice: Choice, values: tuple[float, ...]) -> tuple[float, float]:
    """RMS error, mm, without the effect and with it."""
    chain, observations, names = context.chain, context.observations, context.rig.joint_names
    change = choice.columns(context).change(np.array(values), len(names))
    true = corrected(observations, change, names)
    before, after = (
        rms(chain.positions_mm(context.x, chain.bind(rows)) - observations.position_mm) for rows in (observations, true)
    )
    return before, after


@pytest.mark.parametrize("hidden", HIDDEN, ids=lambda hidden: hidden.text)
def test_a_family_moves_the_boom_as_the_simulator_does(hidden: Hidden) -> None:
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, 5, perturbation=0.0, effects=parse_effects(hidden.text))
    context = context_of(truth, simulated(truth, POSES, hidden.columns))
    settings = library()[hidden.family].variants(context, hidden.where)[hidden.variant]
    before, after = remaining(context, Choice(hidden.family, hidden.where, settings), hidden.values)
    assert before > 0.7
    assert after < 0.01 * before  # loads are those of the undeflected posture


# -- loads of weights that nobody has weighed --------------------------------------------------------------------------


def heavier(rig: Rig, factors: Floats) -> Rig:
    """The rig with other masses; the centres stay."""
    masses = tuple(m.model_copy(update={"kg": m.kg * f}) for m, f in zip(rig.masses, factors, strict=True))
    return rig.model_copy(update={"masses": masses})


@pytest.mark.parametrize("where", ["theta1", "theta4", "theta5", "theta6", "theta7", "theta8"])
def test_a_load_of_other_masses_is_the_nominal_one_larger_and_of_another_shape(where: str) -> None:
    rig = shipped_rig("swdt82")
    designed = RigTruth(rig, 5, perturbation=0.0)
    nominal = context_of(designed, simulated(designed, POSES))
    weighed = designed.gravity_load(where, nominal.observations.joints)
    shapes = gravity_shapes(nominal, where)
    load, parts = nominal.torque(where), nominal.torque_parts(where)
    possible = np.column_stack([load, shapes(load, parts)])
    for seed in range(5):
        factors = 1.0 + np.random.default_rng(seed).uniform(-0.15, 0.15, len(rig.masses))
        truth = RigTruth(heavier(rig, factors), 5, perturbation=0.0)
        change = truth.gravity_load(where, nominal.observations.joints) - weighed
        amount = np.linalg.lstsq(possible, change)[0]
        assert np.abs(change - possible @ amount).max() < 2e-3 * np.abs(weighed).max()
        assert abs(amount[0]) < 4.0 * shapes.load_sigma
        assert (np.abs(amount[1:]) < 4.0).all()


def test_what_shapes_an_uncertain_load_is_as_large_as_the_effect_beforehand_and_is_not_reported() -> None:
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, 5)
    context = context_of(truth, simulated(truth, POSES))
    for name, own in (("joint_compliance", "compliance_rad_per_Nm"), ("load_hysteresis", "rad_per_Nm")):
        family = library()[name]
        plain, shaped = (s for s in family.variants(context, "theta4") if "bend_rad" not in s)
        columns, alone = (family.columns(context, "theta4", settings) for settings in (shaped, plain))
        np.testing.assert_array_equal(columns[:, :1], alone)
        assert len({c.sigma for c in family.coefficients(context, "theta4", shaped)}) == 1
        fitted = tuple(FittedCoefficient(n, "rad/(N m)", 1e-8, 1e-10, 1e-9) for n in family.names(shaped))
        (reported,) = family.reported(shaped, fitted)
        assert (reported.name, reported.value) == (own, 1e-8)
        # What the weights leave open of the whole load no pose can tell: 4.6 % of it.
        assert 0.03e-8 < reported.standard_error < 0.06e-8
        # No weights that are within 15 % of the rig file's change the load's course by five times one sigma.
        values, errors = np.full(len(fitted), 1e-8), np.full(len(fitted), 1e-10)
        assert not family.has_implausible_shape(shaped, values, errors)
        values[1] = 5e-8
        assert family.has_implausible_shape(shaped, values, errors)
        assert not family.has_implausible_shape(shaped, values, 300.0 * errors)


def test_measured_torques_leave_nothing_open_about_the_load() -> None:
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, 5, perturbation=0.0)
    observations = simulated(truth, POSES)
    extra = {**observations.extra, "theta4_Nm": truth.gravity_load("theta4", observations.joints)}
    context = context_of(truth, replace(observations, extra=extra))
    family = library()["joint_compliance"]
    assert not any("load_sigma" in settings for settings in family.variants(context, "theta4"))
    assert library()["load_hysteresis"].variants(context, "theta4") == ({},)
    # A model of computed loads, in rows that have measured ones.
    computed = family.variants(context_of(truth, observations), "theta4")
    with_parts = next(settings for settings in computed if "parts" in settings)
    columns = family.columns(context, "theta4", with_parts)
    np.testing.assert_allclose(columns[:, 0], np.degrees(extra["theta4_Nm"]))
    np.testing.assert_array_equal(columns[:, 1:], 0.0)
    curved = {"torque_Nm": 1e5, "knot_power": 1.0, "bend_rad": 1e-3}
    assert family.odds({**curved, "load_sigma": 0.05}) < 0.1 * family.odds(curved) == 0.1


def test_a_model_of_other_shapes_of_the_load_is_refused() -> None:
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, 5)
    context = context_of(truth, simulated(truth, POSES))
    settings = {"about_rad_per_Nm": 1e-8, "parts": 9.0, "load_sigma": 0.05}
    with pytest.raises(ModelError, match="9 shapes of a load, its rig 2; calibrate again"):
        library()["joint_compliance"].columns(context, "theta4", settings)


def test_a_vertical_axis_that_was_built_a_little_askew_still_carries_nothing() -> None:
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, 5)
    context = context_of(truth, simulated(truth, POSES))
    askew = replace(context, x=np.random.default_rng(3).normal(0.0, 3e-3, len(context.x)))
    assert 10.0 < np.abs(askew.torque("theta3")).max() < 0.03 * askew.greatest_torque("theta4")
    for name in ("joint_compliance", "load_hysteresis", "gravity_flip_play", "payload_change", "leak_down"):
        assert library()[name].variants(askew, "theta3") == ()
        assert askew.greatest_torque("theta3") == 0.0


# -- effects with a history --------------------------------------------------------------------------------------------


def test_the_instant_of_a_jump_is_found_on_a_grid_and_then_between_two_rows() -> None:
    rig, n = shipped_rig("swdt82"), 400
    time_s = np.sort(np.random.default_rng(4).uniform(0.0, 8.0 * 3600.0, n))
    at = 0.5 * (time_s[254] + time_s[255])
    truth = RigTruth(
        rig, 5, perturbation=0.0, effects=parse_effects(f"transducer_index_jump@L2:jump_mm=-6:time_s={at}")
    )
    context = context_of(truth, simulated(truth, n, {"time_s": time_s}))
    family = library()["transducer_index_jump"]

    def left(settings: Mapping[str, float]) -> float:
        return remaining(context, Choice("transducer_index_jump", "L2", settings), (-6.0,))[1]

    grid = family.variants(context, "L2")
    assert 20 <= len(grid) <= 41
    best = min(grid, key=left)
    finest = min(family.refined(context, "L2", best), key=left)
    assert left(finest) < 1e-6 < left(best)
    assert abs(finest["time_s"] - at) < 1e-6
    (_, when) = family.reported(finest, (FittedCoefficient("jump_mm", "mm", -6.0, 0.1, 8.0),))
    assert (when.name, when.unit, when.value) == ("time_s", "s", finest["time_s"])
    assert when.standard_error == pytest.approx((time_s[255] - time_s[254]) / np.sqrt(12.0))
    # As long as few rows are on one side, they are outliers rather than a jump.
    assert time_s[int(0.05 * n) - 1] <= min(s["time_s"] for s in grid)


def test_the_path_travelled_holds_for_other_rows_of_the_same_day() -> None:
    rig, n, slip = shipped_rig("swdt82"), 300, 0.1
    truth = RigTruth(rig, 5, perturbation=0.0, effects=parse_effects(f"transducer_cumulative@L2:mm_per_m={slip}"))
    whole = simulated(truth, n)
    family = library()["transducer_cumulative"]
    training = context_of(truth, whole.select(np.arange(n) % 3 > 0))
    other = context_of(truth, whole.select(np.arange(n) % 3 == 0))
    (settings,) = family.variants(training, "L2")
    # Of the training rows alone the path is shorter by the poses between them: learn that from all rows.
    (settings,) = family.variants(context_of(truth, whole), "L2")
    # Its mean belongs to the kinematics.
    joints = {**other.observations.joints, "L2": other.reading("L2") + slip * settings["mean_m"]}
    before, after = remaining(
        replace(other, observations=replace(other.observations, joints=joints)),
        Choice("transducer_cumulative", "L2", settings),
        (slip,),
    )
    assert before > 3.0
    assert after < 0.03 * before


def test_rows_without_any_time_are_one_run_in_their_order() -> None:
    rig, n = shipped_rig("swdt82"), 50
    truth = RigTruth(rig, 5, perturbation=0.0)
    observations = replace(simulated(truth, n), extra={})
    context = context_of(truth, observations)
    family = library()["transducer_cumulative"]
    (settings,) = family.variants(context, "L2")
    assert set(settings) == {"mean_m"}
    path_m = np.concatenate([[0.0], np.abs(np.diff(context.reading("L2"))).cumsum()]) / 1e3
    np.testing.assert_allclose(family.columns(context, "L2", settings)[:, 0], path_m - path_m.mean())
    still = {**observations.joints, "L2": np.full(n, 800.0)}
    assert family.variants(context_of(truth, replace(observations, joints=still)), "L2") == ()


def test_a_payload_that_never_changes_shows_nothing() -> None:
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, 5)
    family = library()["payload_change"]
    for payload_kg, forms in ((np.full(POSES, 300.0), 0), (_RODS["payload_kg"], 2)):
        context = context_of(truth, simulated(truth, POSES, {"payload_kg": payload_kg}))
        assert len(family.variants(context, "theta4")) >= forms
        assert bool(family.variants(context, "theta4")) == (forms > 0)


# -- in a calibration --------------------------------------------------------------------------------------------------


def test_effects_of_joints_are_fitted_together_and_predict_other_rows() -> None:
    """Times that count from 1970, masses that are not those of the rig file, noise: as a user has it."""
    rig, n, noise_mm = shipped_rig("swdt82"), 500, 2.0
    rng = np.random.default_rng(6)
    time_s = 1.76e9 + np.sort(rng.uniform(0.0, 8.0 * 3600.0, n))
    columns = {"time_s": time_s, "temperature_degC": 15.0 + 8.0 * np.sin((time_s - time_s[0]) / 9000.0)}
    hidden = {
        "joint_compliance@theta4": ("compliance_rad_per_Nm=1.2e-8", 1.2e-8),
        "load_hysteresis@theta5": ("rad_per_Nm=5e-8", 5e-8),
        "leak_down@theta4": ("rad_per_s=3e-5", 3e-5),
        "solar_bow@theta5": ("rad_per_K=-2e-4", -2e-4),
        "transducer_index_jump@L2": (f"jump_mm=9:time_s={time_s[n // 2]}", 9.0),
    }
    truth = RigTruth(rig, 12, effects=parse_effects(",".join(f"{k}:{v[0]}" for k, v in hidden.items())))
    table = simulate_observations(truth, n, 12, prisms_per_pose="one", noise_mm=noise_mm, columns=columns)
    whole = parse_observations(table.csv_text().encode(), rig, "simulated.csv")
    half = np.arange(n) // len(rig.prisms) % 2  # every prism in both
    training, others = (whole.select(half == part) for part in (0, 1))
    made = identify(rig, rig_text("swdt82"), training, effects=",".join(hidden))
    model = model_from_files(model_to_files(made))
    for effect in model.effects:
        (size, *_) = effect.reported
        assert abs(size.value - hidden[f"{effect.family}@{effect.where}"][1]) < 4.0 * size.standard_error
        assert size.standard_error < 0.2 * abs(size.value)
    truth_mm = table.oracle_mm[half == 1]
    before, after = (
        rms(Predictor.of(model).geometric_mm(others) - truth_mm),
        rms(Predictor.of(model).effects_mm(others) - truth_mm),
    )
    assert after < 0.3 * before
    assert after < noise_mm
    # A row without the columns is predicted without these effects, and says that it knows less.
    bare = replace(others, extra={})
    assert np.median(Predictor.of(model).predict(bare).sigma_mm / Predictor.of(model).predict(others).sigma_mm) > 1.05
    assert len(model_warnings(model, bare)) >= 4
