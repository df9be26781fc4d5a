"""Effects of gravity where loads are hardly known: masses that nobody has scored, machines that lean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.effects.base import Settings
from calibration.effects.context import EffectContext
from calibration.effects.library import library
from calibration.errors import ModelError
from calibration.gap.adoption import adopt
from calibration.gap.search import search
from calibration.kinematics.chain import Chain, Placement
from calibration.model.prediction import Predictor
from calibration.observations import Floats, Observations, parse_observations
from calibration.pipeline.build_model import with_effects
from calibration.pipeline.calibrate import identify
from calibration.rig.description import Rig, parse_rig, shipped_rig
from simulators.blind.cases import draw
from simulators.blind.cells import Cell, Poses
from simulators.effects.library import parse_effects
from simulators.rig.dataset import random_poses
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import rig_text
from tests.calibration.effects.test_effects import solved
from tests.simulated.observations import simulate_observations

POSES = 200


def exact(truth: RigTruth, n: int) -> Observations:
    table = simulate_observations(truth, n, 2, prisms_per_pose="one", noise_mm=0.0, joint_noise=False)
    return parse_observations(table.csv_text().encode(), truth.rig, "simulated.csv")


def perfect(truth: RigTruth, observations: Observations, turn: Floats | None = None) -> EffectContext:
    """The machine with its base where it is, in the station's frame or in one turned from it by `turn` (3, 3)."""
    placement, about = truth.placement(), np.eye(3) if turn is None else turn
    base = Placement(about @ placement.rotation, about @ placement.position_mm)
    chain = Chain(truth.rig, {"": base})
    return EffectContext(chain, np.zeros(len(chain)), observations)


# -- the vertical ------------------------------------------------------------------------------------------------------


def test_loads_are_along_the_vertical_of_the_levelled_station() -> None:
    truth = RigTruth(shipped_rig("swdt82"), 5, perturbation=0.0)
    observations = exact(truth, POSES)
    context = perfect(truth, observations)
    upright = replace(context, levelled=False)
    for joint in ("theta1", "theta4", "theta6", "theta8"):
        true = truth.gravity_load(joint, observations.joints)
        assert np.abs(context.torque(joint) - true).max() < 1e-6 * np.abs(true).max()
        assert np.abs(upright.torque(joint) - true).max() > 1e-3 * np.abs(true).max()


def test_a_frame_that_is_not_levelled_says_nothing_about_gravity() -> None:
    truth = RigTruth(shipped_rig("swdt82"), 5, perturbation=0.0)
    observations = exact(truth, POSES)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    lying, upright = perfect(truth, observations, turn), replace(perfect(truth, observations), levelled=False)
    np.testing.assert_allclose(lying.down, np.tile([0.0, 0.0, -1.0], (POSES, 1)))
    np.testing.assert_allclose(lying.torque("theta6"), upright.torque("theta6"))


# -- play that flips over ----------------------------------------------------------------------------------------------


def unmeasured(rig: Rig, n: int, seed: int) -> Observations:
    blank, empty = np.full((n, 3), np.nan), np.full(n, "")
    poses = random_poses(rig, n, np.random.default_rng(seed))
    return Observations(np.full(n, rig.prism_names[0]), poses, blank, blank, empty, empty, empty)


def left_of_a_sign(context: EffectContext, sign: Floats, settings: Settings) -> float:
    """Share of the squares of a sign that the columns of a form leave."""
    columns = library()["gravity_flip_play"].columns(context, "theta6", settings)
    left = sign - columns @ np.linalg.lstsq(columns, sign)[0]
    return float(left @ left / (sign @ sign))


def test_finer_forms_of_play_find_where_the_load_of_other_masses_changes_its_sign() -> None:
    rig, family = shipped_rig("swdt82"), library()["gravity_flip_play"]
    found = []
    for seed in range(6):
        truth = RigTruth(rig, seed, perturbation=0.0)
        context = perfect(truth, unmeasured(rig, 4000, seed))
        load = np.abs(context.torque("theta6"))
        near = context.observations.select(np.flatnonzero(load < 0.02 * load.max()))
        context = replace(context, observations=near)
        factors = 1.0 + np.random.default_rng(seed).uniform(-0.15, 0.15, len(rig.masses))
        masses = tuple(m.model_copy(update={"kg": m.kg * f}) for m, f in zip(rig.masses, factors, strict=True))
        scored = RigTruth(rig.model_copy(update={"masses": masses}), seed, perturbation=0.0)
        sign = np.sign(scored.gravity_load("theta6", near.joints))
        sharp, *forms = family.variants(context, "theta6")
        coarse = min(forms, key=lambda form: left_of_a_sign(context, sign, form))
        chosen, *finer = family.refined(context, "theta6", coarse)
        assert chosen == coarse
        finest = min(finer, key=lambda form: left_of_a_sign(context, sign, form))
        found.append([left_of_a_sign(context, sign, form) for form in (sharp, coarse, finest)])
    as_by_file, coarse_left, finest_left = np.median(found, axis=0)
    assert as_by_file > 0.05
    assert coarse_left < 0.5 * as_by_file
    assert finest_left < 0.25 * as_by_file


def test_a_load_that_is_nowhere_near_zero_leaves_nothing_open_about_its_sign() -> None:
    truth = RigTruth(shipped_rig("swdt82"), 5)
    context = perfect(truth, exact(truth, POSES))
    family = library()["gravity_flip_play"]
    assert family.variants(context, "theta1") == ({},)
    assert family.refined(context, "theta1", {}) == ()
    assert len(family.variants(context, "theta6")) > 5


def test_finer_forms_settle_on_the_mean_of_the_masses_unless_the_first_is_likelier() -> None:
    family = library()["gravity_flip_play"]
    finer = tuple({"spread": 0.15, "other_Nm": 30.0, "shape1": at} for at in (-1.0, 1.0))
    assert family.posterior_settings(({}, *finer), np.array([0.6, 0.4, 0.0])) == {}
    assert family.posterior_settings(({}, *finer), np.array([0.2, 0.2, 0.6]))["shape1"] == pytest.approx(0.5)


def test_a_model_of_play_with_other_shapes_of_the_load_is_refused() -> None:
    truth = RigTruth(shipped_rig("swdt82"), 5)
    context = perfect(truth, exact(truth, POSES))
    shapes = {f"shape{number}": 0.0 for number in range(1, 10)}
    with pytest.raises(ModelError, match="9 shapes of a load, its rig 3; calibrate again"):
        library()["gravity_flip_play"].columns(context, "theta6", {"spread": 1.0, "other_Nm": 30.0, **shapes})


@pytest.mark.long
@pytest.mark.parametrize(("poses", "seed"), [("wide", 10001), ("face", 10006)])
def test_play_is_named_where_masses_and_the_carriers_lean_move_the_flip(poses: Poses, seed: int) -> None:
    """Cases that a compliance with a curve explained better than the sign of the rig file's load."""
    rig = shipped_rig("swdt82")
    drawn = draw(rig, Cell("single", ("gravity_flip_play",), 1.0, poses, "fine", seed))
    assert drawn is not None
    observations = parse_observations(drawn.train.encode(), rig, "drawn.csv")
    (effect,) = search(solved(rig, observations), observations, library()).adopted.effects
    assert (effect.family, effect.where) == ("gravity_flip_play", "theta6")
    (width,) = effect.reported
    assert width.value == pytest.approx(drawn.label["effects"][0]["coefficients"]["width_rad"], rel=0.1)


# -- weights that no machine has ---------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_droop_that_the_library_lacks_is_no_compliance_with_impossible_weights() -> None:
    rig = shipped_rig("swdt82")
    drawn = draw(rig, Cell("left_out", ("boom_droop",), 3.0, "face", "fine", 10403))
    assert drawn is not None
    observations = parse_observations(drawn.train.encode(), rig, "drawn.csv")
    found = search(solved(rig, observations), observations, set(library()) - set(drawn.without))
    assert found.adopted.effects == ()
    assert "torque(theta4)" in str(found.formulas[0].term)


# -- rows that must be given together ----------------------------------------------------------------------------------


def test_a_long_run_without_times_is_predicted_as_one_run() -> None:
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, 5, effects=parse_effects("transducer_cumulative@L2:mm_per_m=0.1"))
    table = simulate_observations(truth, 2000, 2, prisms_per_pose="one")
    whole = parse_observations(table.csv_text().encode(), rig, "simulated.csv")
    whole = replace(whole, extra={name: values for name, values in whole.extra.items() if name != "time_s"})
    training = whole.select(np.arange(150))
    kinematics = identify(rig, rig_text("swdt82"), training, effects="none")
    model = with_effects(kinematics, adopt(solved(rig, training), training, "transducer_cumulative@L2"))
    (effect,) = model.effects
    assert set(effect.settings) == {"mean_m"}
    idle = replace(effect, coefficients=tuple(replace(c, value=0.0) for c in effect.coefficients))
    with_it, without = (Predictor.of(m).predict(whole).position_mm for m in (model, replace(model, effects=(idle,))))
    travelled_m = np.abs(np.diff(whole.joints["L2"])).sum() / 1e3
    slipped_mm = effect.coefficients[0].value * (travelled_m - effect.settings["mean_m"])
    assert np.linalg.norm(with_it[-1] - without[-1]) == pytest.approx(slipped_mm, rel=0.02)


def test_a_run_without_times_in_training_goes_by_time_where_later_rows_have_it() -> None:
    truth = RigTruth(shipped_rig("swdt82"), 5)
    observations = exact(truth, POSES)
    family = library()["transducer_cumulative"]
    backwards = replace(observations, extra={**observations.extra, "time_s": -np.arange(POSES, dtype=float)})
    change = family.columns(perfect(truth, backwards), "L2", {"mean_m": 0.0})[:, 0]
    assert change[-1] == 0.0
    assert change[0] == pytest.approx(np.abs(np.diff(observations.joints["L2"])).sum() / 1e3)
    assert family.depends_on_order({"mean_m": 0.0})
    assert not family.depends_on_order({"mean_m": 0.0, "time_0_s": 0.0, "path_0_m": 1.0})


# -- the boom ----------------------------------------------------------------------------------------------------------

CRANE = """
name = "crane"
convention = "dh"
tolerances = { length_mm = 5.0, angle_deg = 0.2, beta_deg = 0.1, prism_mm = 3.0 }
joint = [
    { name = "slew", kind = "revolute", limits = [-170, 170], sigma = 0.005 },
    { name = "mast", kind = "prismatic", limits = [0, 1500], sigma = 0.2 },
    { name = "luff", kind = "revolute", limits = [5, 75], sigma = 0.005 },
    { name = "tele", kind = "prismatic", limits = [0, 6000], sigma = 0.5 },
]
row = [
    { d_mm = 2000, drive = { theta = { slew = 1.0 } } },
    { alpha_deg = 90, drive = { d = { mast = 1.0 } } },
TELESCOPE
]
prism = [{ name = "head", frame = 4, offset_mm = [300, 200, 100] }]
mass = [{ name = "hook", kg = 800, frame = 4, centre_mm = [200, -300, 150] }]
"""
ALONG_X = """
    { drive = { theta = { luff = 1.0 } } },
    { a_mm = 7000, drive = { a = { tele = 1.0 } } },
"""
ALONG_Z = """
    { theta_deg = 90, alpha_deg = 90, drive = { theta = { luff = 1.0 } } },
    { theta_deg = 90, alpha_deg = 90, d_mm = 7000, drive = { d = { tele = 1.0 } } },
"""


@pytest.mark.parametrize("family", ["boom_droop", "pad_play"])
def test_a_telescope_is_a_boom_along_whichever_axis_it_is_written(family: str) -> None:
    """The mast slides before it, but nothing swings that."""
    x, z = (parse_rig(CRANE.replace("TELESCOPE", rows), "crane.toml") for rows in (ALONG_X, ALONG_Z))
    turned = z.prisms[0].model_copy(update={"offset_mm": (100.0, 300.0, 200.0)})
    weight = z.masses[0].model_copy(update={"centre_mm": (150.0, 200.0, -300.0)})
    z = z.model_copy(update={"prisms": (turned,), "masses": (weight,)})
    observations = exact(RigTruth(x, 1, perturbation=0.0), 40)
    moved = []
    for rig in (x, z):
        context = perfect(RigTruth(rig, 1, perturbation=0.0), observations)
        settings = library()[family].variants(context, "boom")[0]
        moved.append(library()[family].shift_mm(context, "boom", settings))
    assert library()[family].places(x) == library()[family].places(z) == ("boom",)
    assert np.abs(moved[0]).max() > 0.0
    np.testing.assert_allclose(moved[1], moved[0], rtol=1e-9, atol=1e-9 * np.abs(moved[0]).max())
