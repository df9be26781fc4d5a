"""Effects that move prisms or fixes: units, signs and sizes against the simulator, and what a model makes of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.effects.base import PrismFamily
from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice
from calibration.effects.library import library
from calibration.effects.timing import refined_steps, step_grid
from calibration.kinematics.chain import Chain, Placement
from calibration.model.files import model_from_files, model_to_files
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.model.rebase import with_refitted_base
from calibration.model.warnings import model_warnings
from calibration.observations import Floats, Observations, parse_observations
from calibration.pipeline.calibrate import identify
from calibration.rig.description import Rig, parse_rig, shipped_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth, replace_effects
from tests.calibration.conftest import rig_text, rms
from tests.simulated.observations import simulate_observations

STEP = library()["base_step"]
BOOM = shipped_rig("swdt82")
RIGS = Path(__file__).parents[2] / "rigs"

# What hides in the simulated boom -> the same as the library has it.
ALIKE: Mapping[str, tuple[str, str, tuple[float, ...]]] = {
    "boom_droop@boom:flexibility_per_Nm2=2e-9": ("boom_droop", "boom", (2e-9,)),
    "pad_play@boom:clearance_mm=2": ("pad_play", "boom", (2.0,)),
    "thermal_expansion@boom:per_K=2e-5": ("thermal_expansion", "boom", (2e-5,)),
    "base_settlement@base:tilt_x_rad_per_h=3e-4:tilt_y_rad_per_h=-1e-4:z_mm_per_h=-2": (
        "base_settlement",
        "base",
        (3e-4, -1e-4, -2.0),
    ),
    "base_compliance@base:x_rad_per_Nm=6e-9:y_rad_per_Nm=3e-9": ("base_compliance", "base", (6e-9, 3e-9)),
    "lateral_compliance@theta3:compliance_rad_per_Nm=6e-9": ("lateral_compliance", "theta3", (6e-9,)),
    "lateral_compliance@theta7:compliance_rad_per_Nm=3e-8": ("lateral_compliance", "theta7", (3e-8,)),
    "passive_compliance@row2:compliance_rad_per_Nm=6e-9": ("passive_compliance", "row2", (6e-9,)),
    "latency@clock:seconds=0.02": ("latency", "clock", (0.02,)),
    "clock_drift@clock:ppm=5": ("clock_drift", "clock", (5.0,)),
    "station_scale@station:ppm=50": ("station_scale", "station", (50.0,)),
    "prism_constant@station:mm=30": ("prism_constant", "station", (30.0,)),
    "prism_constant@b:mm=-3": ("prism_constant", "b", (-3.0,)),
    "prism_incidence@r:cos1_mm=2:sin1_mm=-1": ("prism_incidence", "r", (2.0, -1.0)),
    "linkage_coupling@theta1:coupling=-2e-3": ("linkage_coupling", "theta1", (-2e-3,)),
}
MINE = sorted({family for family, _, _ in ALIKE.values()} | {"base_step", "base_shift", "prism_seat_step"})


def shift_columns(rig: Rig, n: int, rng: np.random.Generator) -> dict[str, Floats]:
    """A shift of several hours: every second pose is measured while the boom moves slowly, the day warms and cools."""
    moving = np.arange(n) % 2
    rates = {f"{j.name}_rate": moving * rng.normal(0.0, 0.05 * j.max_rate, n) for j in rig.joints}
    hours = np.linspace(0.0, 6.0, n)
    return rates | {"temperature_degC": 12.0 + 8.0 * np.sin(hours / 2.0) + rng.normal(0.0, 0.5, n)}


def measured(
    truth: RigTruth, n: int, seed: int, *, noise_mm: float = 0.0, setup: str = "", span_h: float = 6.0
) -> Observations:
    columns = shift_columns(truth.rig, n, np.random.default_rng([seed, 77]))
    columns |= {"time_s": 1e6 + np.linspace(0.0, 3600.0 * span_h, n)}
    table = simulate_observations(
        truth,
        n,
        seed,
        prisms_per_pose="one",
        noise_mm=noise_mm,
        joint_noise=noise_mm > 0.0,
        setup=setup,
        columns=columns,
    )
    return parse_observations(table.csv_text().encode(), truth.rig, "simulated.csv")


def placed(truth: RigTruth, observations: Observations) -> EffectContext:
    """The nominal machine where the true one stands."""
    placement = truth.placement()
    chain = Chain(truth.rig, {"": Placement(placement.rotation, placement.position_mm)})
    return EffectContext(chain, np.zeros(len(chain)), observations)


def moving_prisms(name: str) -> PrismFamily:
    family = library()[name]
    assert isinstance(family, PrismFamily)
    return family


@pytest.fixture(scope="module")
def machine() -> RigTruth:
    return RigTruth(BOOM, 5, perturbation=0.0)


@pytest.fixture(scope="module")
def still(machine: RigTruth) -> Observations:
    """The nominal boom without any effect."""
    return measured(machine, 120, 2)


# -- against the simulator ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("simulated", ALIKE)
def test_fixes_are_moved_as_the_simulator_does(simulated: str, machine: RigTruth, still: Observations) -> None:
    """Units, signs and sizes, against effects and kinematics that share no code with these."""
    name, where, values = ALIKE[simulated]
    hidden = measured(replace_effects(machine, parse_effects(simulated)), 120, 2)
    true_shift = hidden.position_mm - still.position_mm
    context = placed(machine, hidden)
    settings = library()[name].variants(context, where)[0]
    additions = Choice(name, where, settings).columns(context)
    assert rms(true_shift) > 0.2
    # What is left: the carrier's tilt, which turns the loads a little, and terms of second order.
    assert rms(additions.shifted_mm(np.array(values)) - true_shift) < 0.005 * rms(true_shift)


def test_a_mounting_that_does_not_grow_is_one_of_no_length(machine: RigTruth, still: Observations) -> None:
    family, context = moving_prisms("thermal_expansion"), placed(machine, still)
    _, links = family.variants(context, "boom")
    bare = BOOM.model_copy(update={"prisms": tuple(p.model_copy(update={"offset_mm": (0, 0, 0)}) for p in BOOM.prisms)})
    at_frames = EffectContext(Chain(bare, context.chain.placements), context.x, still)
    (all_of_it,) = family.variants(at_frames, "boom")
    grown = family.shift_mm(context, "boom", links)
    np.testing.assert_allclose(grown, family.shift_mm(at_frames, "boom", all_of_it), atol=1e-9)
    assert family.names(links) == ("per_K",)


def test_a_coupled_row_follows_every_joint_that_drives_it() -> None:
    """Of a torso: row 3 is -(q1 + q2), and only what is said of one of them changes it."""
    torso = parse_rig((RIGS / "torso.toml").read_text(encoding="utf-8"), "torso.toml")
    truth = RigTruth(torso, 4, perturbation=0.0)
    none = measured(truth, 60, 2)
    for joint in ("q1", "q2"):
        hidden = measured(replace_effects(truth, parse_effects(f"linkage_coupling@{joint}:coupling=2e-3")), 60, 2)
        shift = hidden.position_mm - none.position_mm
        additions = Choice("linkage_coupling", joint, {}).columns(placed(truth, hidden))
        assert rms(shift) > 0.2
        assert rms(additions.shifted_mm(np.array([2e-3])) - shift) < 0.005 * rms(shift)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("base_step@base:tilt_x_rad=1e-3:tilt_y_rad=-2e-3:z_mm=5", (1e-3, -2e-3, 5.0)),
        ("base_shift@base:x_mm=6:y_mm=-9:heading_rad=1e-3", (6.0, -9.0, 1e-3)),
        ("prism_seat_step@r:x_mm=9:y_mm=-12:z_mm=15", (9.0, -12.0, 15.0)),
    ],
)
def test_a_step_acts_after_its_instant(
    text: str, values: tuple[float, ...], machine: RigTruth, still: Observations
) -> None:
    after = float(np.sort(still.extra["time_s"])[70]) - 1.0
    (simulated,) = parse_effects(f"{text}:time_s={after}")
    hidden = measured(replace_effects(machine, [simulated]), 120, 2)
    context = placed(machine, hidden)
    family, where = moving_prisms(simulated.family), simulated.where
    grid = family.variants(context, where)
    near = min(grid, key=lambda settings: abs(settings["time_s"] - after))
    finer = family.refined(context, where, near)  # none where the grid has every instant
    exact = min(finer or grid, key=lambda settings: abs(settings["time_s"] - after))
    assert abs(exact["time_s"] - after) < 2.0 * np.sqrt(3.0) * exact["time_error_s"]
    additions = Choice(simulated.family, where, exact).columns(context)
    shift = hidden.position_mm - still.position_mm
    assert rms(shift) > 5.0
    assert rms(additions.shifted_mm(np.array(values)) - shift) < 0.01 * rms(shift)


def test_a_carrier_that_turns_on_the_spot_has_a_form_with_its_heading_alone(
    machine: RigTruth, still: Observations
) -> None:
    family, context = moving_prisms("base_shift"), placed(machine, still)
    moved, turned = (
        next(s for s in family.variants(context, "base") if bool(family.form(s)) is on_the_spot)
        for on_the_spot in (False, True)
    )
    assert (family.form(turned), family.names(turned)) == ("turned on the spot", ("heading_rad",))
    np.testing.assert_array_equal(
        family.shift_mm(context, "base", turned), family.shift_mm(context, "base", moved)[:, :, 2:]
    )
    assert all(family.form(form) for form in family.refined(context, "base", turned))
    (effect,) = (Choice("base_shift", "base", turned).fitted(context, np.array([1e-3]), np.array([1e-4])),)
    assert [c.name for c in effect.reported] == ["x_mm", "y_mm", "heading_rad", "time_s"]
    assert [c.value for c in effect.reported[:3]] == [0.0, 0.0, 1e-3]


@pytest.mark.parametrize(("name", "where"), [("ur10", "q4"), ("ys100", "theta4")])
def test_a_link_of_any_convention_gives_way_where_its_joint_is(name: str, where: str) -> None:
    rig = shipped_rig(name)
    known = tuple(prism.model_copy(update={"offset_known": True}) for prism in rig.prisms)
    truth = RigTruth(rig.model_copy(update={"prisms": known}), 4, perturbation=0.0)
    still = measured(truth, 40, 2)
    context = placed(truth, still)
    settings = library()["lateral_compliance"].variants(context, where)[0]
    (own,) = library()["lateral_compliance"].coefficients(context, where, settings)
    value = 5.0 * own.sigma
    soft = replace_effects(truth, parse_effects(f"lateral_compliance@{where}:compliance_rad_per_Nm={value}"))
    prism = rig.prism_names[0]
    shift = soft.prism_mm(prism, still.joints) - truth.prism_mm(prism, still.joints)
    found = Choice("lateral_compliance", where, settings).columns(context).shifted_mm(np.array([value]))
    assert rms(shift) > 0.2
    assert rms(found - shift) < 0.01 * rms(shift)


def test_whatever_the_weights_are_a_links_turn_has_few_shapes(machine: RigTruth, still: Observations) -> None:
    context, rng = placed(machine, still), np.random.default_rng(1)
    for name, where in (("lateral_compliance", "theta3"), ("passive_compliance", "row2")):
        family = moving_prisms(name)
        plain, shaped = family.variants(context, where)
        columns = family.shift_mm(context, where, shaped).reshape(-1, len(family.names(shaped)))
        np.testing.assert_allclose(family.shift_mm(context, where, plain).ravel(), columns[:, 0], rtol=1e-12)
        for _ in range(5):
            masses = tuple(m.model_copy(update={"kg": m.kg * (1.0 + rng.uniform(-0.15, 0.15))}) for m in BOOM.masses)
            other = Chain(BOOM.model_copy(update={"masses": masses}), context.chain.placements)
            turned = family.shift_mm(EffectContext(other, context.x, still), where, plain).ravel()
            found, *_ = np.linalg.lstsq(columns, turned)
            assert rms((turned - columns @ found).reshape(-1, 3)) < 3e-3 * rms(turned.reshape(-1, 3))


def test_a_droop_grows_as_a_cantilever_does() -> None:
    """A level boom with a weight at its tip and nothing else: F L^3 / 3 and a slope of F L^2 / 2 per unit of 1 / EI."""
    text = """
name = "pole"
convention = "mdh_beta_after"
tolerances = { length_mm = 1.0, angle_deg = 0.1, beta_deg = 0.1, prism_mm = 1.0 }
joint = [
    { name = "swing", kind = "revolute", limits = [-90, 90], sigma = 0.01 },
    { name = "out", kind = "prismatic", limits = [0, 3000], sigma = 0.1 },
]
prism = [{ name = "tip", frame = 2, offset_mm = [500, 0, 0] }, { name = "root", frame = 1, offset_mm = [0, 0, 0] }]
row = [{ drive = { theta = { swing = 1.0 } } }, { a_mm = 2000, drive = { a = { out = 1.0 } } }]
mass = [{ name = "load", frame = 2, kg = 100, centre_mm = [0, 0, 0] }]
"""
    rig = parse_rig(text, "pole.toml")
    truth = RigTruth(rig, 1, perturbation=0.0)
    table = simulate_observations(truth, 20, 1, noise_mm=0.0)
    observations = parse_observations(table.csv_text().encode(), rig, "pole.csv")
    chain = Chain(rig, {"": Placement.identity()})
    context = EffectContext(chain, np.zeros(len(chain)), observations)
    family = moving_prisms("boom_droop")
    shift = family.shift_mm(context, "boom", family.variants(context, "boom")[0])[:, :, 0]
    length_m = 2.0 + observations.joints["out"] / 1e3
    newton = 100.0 * 9.80665
    tip = observations.prism == "tip"
    expected = -1e3 * newton * (length_m**3 / 3.0 + 0.5 * length_m**2 / 2.0)
    np.testing.assert_allclose(shift[tip, 2], expected[tip], rtol=1e-9)
    np.testing.assert_allclose(shift[tip, :2], 0.0, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_array_equal(shift[~tip], 0.0)


def test_whatever_the_weights_are_the_droop_has_a_size_and_few_shapes(machine: RigTruth, still: Observations) -> None:
    context = placed(machine, still)
    family = moving_prisms("boom_droop")
    plain, *shaped = family.variants(context, "boom")
    columns = family.shift_mm(context, "boom", shaped[0]).reshape(-1, len(family.names(shaped[0])))
    np.testing.assert_allclose(family.shift_mm(context, "boom", plain).ravel(), columns[:, 0], rtol=1e-12)
    size = np.sqrt((columns[:, 0] ** 2).mean())
    rng = np.random.default_rng(1)
    scales = []
    for _ in range(20):
        masses = tuple(
            m.model_copy(
                update={
                    "kg": m.kg * (1.0 + rng.uniform(-0.15, 0.15)),
                    "centre_mm": tuple(v * (1.0 + rng.uniform(-0.15, 0.15)) for v in m.centre_mm or ()),
                }
            )
            for m in BOOM.masses
        )
        other = Chain(BOOM.model_copy(update={"masses": masses}), context.chain.placements)
        droop = family.shift_mm(EffectContext(other, context.x, still), "boom", plain).ravel()
        found, *_ = np.linalg.lstsq(columns, droop)
        assert np.sqrt(((droop - columns @ found) ** 2).mean()) < 3e-3 * size
        scales.append(found[0])
    # How the boom's own weight is spread is uncertain as well: that is not varied here.
    assert np.std(scales) < plain["load_sigma"] < 4.0 * np.std(scales)
    k = columns.shape[1]
    (reported,) = Choice("boom_droop", "boom", shaped[0]).fitted(context, np.ones(k), np.full(k, 1e-3)).reported
    assert reported.name == "flexibility_per_Nm2"
    assert reported.standard_error == pytest.approx(plain["load_sigma"], rel=1e-3)


@pytest.mark.parametrize("name", MINE)
def test_a_family_that_moves_prisms_has_sane_numbers_wherever_it_may_be(name: str, machine: RigTruth) -> None:
    context = placed(machine, measured(machine, 60, 3, span_h=2.0))
    family = moving_prisms(name)
    assert set(family.confused_with) <= library().keys() - {name}
    assert family.places(BOOM)
    for where in family.places(BOOM):
        variants = family.variants(context, where)
        assert variants
        for settings in (variants[0], variants[-1]):
            coefficients = family.coefficients(context, where, settings)
            assert tuple(c.name for c in coefficients) == family.names(settings)
            assert all(0.0 < c.sigma < c.upper and c.lower in (0.0, -c.upper) for c in coefficients)
            shift = family.shift_mm(context, where, settings)
            assert shift.shape == (60, 3, len(coefficients))
            assert 0.01 < np.abs(shift[:, :, 0]).max() * coefficients[0].sigma < 100.0
        with pytest.raises(ValueError, match="setting"):
            family.names({"surprise": 1.0})


def test_the_boom_and_what_is_fixed_before_it_stay_where_they_are(machine: RigTruth, still: Observations) -> None:
    context = placed(machine, still)
    before = still.prism == "w"
    for name in ("boom_droop", "pad_play"):
        settings = library()[name].variants(context, "boom")[0]
        shift = moving_prisms(name).shift_mm(context, "boom", settings)
        np.testing.assert_array_equal(shift[before], 0.0)
        assert (np.abs(shift[~before]).max(axis=(1, 2)) > 0.0).all()


# -- when a step may have happened -------------------------------------------------------------------------------------


def test_steps_lie_between_rows_with_a_few_of_them_on_either_side() -> None:
    time_s = np.random.default_rng(1).uniform(0.0, 7200.0, 250)
    grid = step_grid(time_s)
    times = np.array([settings["time_s"] for settings in grid])
    assert 30 < len(grid) <= 40
    assert (np.diff(times) > 0.0).all()
    assert not np.isin(times, time_s).any()
    before = (time_s[:, None] < times).sum(axis=0)
    assert before.min() >= 13
    assert before.max() <= 250 - 13
    assert np.ptp(np.diff(before)) <= 2  # evenly by rows, not by time
    seven = step_grid(np.array([0.0, 1.0, 1.0, 2.0, 3.0, 5.0, 5.0, np.nan]))
    assert [settings["time_s"] for settings in seven] == [1.5, 2.5]
    assert step_grid(np.full(50, np.nan)) == step_grid(np.full(50, 3.0)) == ()


def test_a_step_is_as_likely_at_an_instant_of_the_grid_as_the_time_about_it_is_long() -> None:
    """Half of the rows in a minute, the others in another one an hour later: it was nearly surely in between."""
    rng = np.random.default_rng(2)
    time_s = np.concatenate([rng.uniform(0.0, 60.0, 250), rng.uniform(3600.0, 3660.0, 250)])
    odds = np.array([STEP.odds(settings) for settings in step_grid(time_s)])
    assert odds.max() / odds.sum() > 0.95
    rows = np.sort(time_s)
    counted = rows[-25] - rows[24]  # a step has 5 % of the rows on either side at least
    assert odds.sum() * np.sqrt(12.0) == pytest.approx(counted)
    fine = refined_steps(time_s, step_grid(time_s)[int(odds.argmax())])
    times = np.array([settings["time_s"] for settings in fine])
    among_the_rows = (np.abs(times - 1800.0) > 1000.0).astype(float)
    in_between = 0.2 * (1.0 - among_the_rows)
    step = STEP.posterior_settings(fine, (among_the_rows + in_between) / (among_the_rows + in_between).sum())
    assert 60.0 < step["time_s"] < 3600.0


def test_a_step_is_refined_to_every_instant_up_to_its_neighbours_on_the_grid() -> None:
    time_s = np.random.default_rng(1).uniform(0.0, 7200.0, 500)
    grid = step_grid(time_s)
    fine = refined_steps(time_s, grid[10])
    times = [settings["time_s"] for settings in fine]
    middles = np.sort(time_s)[:-1] + np.diff(np.sort(time_s)) / 2.0
    between = (middles > grid[9]["time_s"] + 1e-6) & (middles < grid[11]["time_s"] - 1e-6)
    np.testing.assert_allclose(times, middles[between])
    assert grid[10]["time_s"] in times
    (gap,) = np.diff(np.sort(time_s))[between][[0]]
    assert fine[0]["time_error_s"] == pytest.approx(gap / np.sqrt(12.0))
    assert refined_steps(time_s[:30], step_grid(time_s[:30])[2]) == ()  # the grid has them all
    step = STEP.posterior_settings(fine, np.eye(len(fine))[3])
    assert step["time_s"] == times[3]
    assert step["time_error_s"] == pytest.approx(fine[3]["time_error_s"])
    either = STEP.posterior_settings(fine, 0.5 * (np.eye(len(fine))[3] + np.eye(len(fine))[5]))
    shares = np.array([fine[3]["time_error_s"], fine[5]["time_error_s"]])
    assert either["time_error_s"] > np.sqrt(shares.min() / shares.sum()) * (times[5] - times[3])
    many = np.random.default_rng(2).uniform(0.0, 7200.0, 20_000)
    thinned = refined_steps(many, step_grid(many)[10])
    assert 40 < len(thinned) <= 82
    apart = np.diff([settings["time_s"] for settings in thinned])
    assert thinned[0]["time_error_s"] > 0.5 * apart.mean() / np.sqrt(12.0)


def test_prisms_face_and_move_as_the_reference_kinematics_have_it() -> None:
    rigs = [parse_rig((RIGS / f"{name}.toml").read_text(encoding="utf-8"), name) for name in ("torso", "arm7")]
    for rig in (BOOM, shipped_rig("ys100"), *rigs):
        truth = RigTruth(rig, 3)
        context = placed(truth, measured(truth, 24, 4))
        chain, data, facing = context.chain, context.data, context.facing
        reference = chain.linearise(context.x, data)
        for joint in range(len(rig.joints)):
            own = [number for number, (_, driving) in enumerate(context.machine.drives) if driving == joint]
            moved = context.to_station(facing.by_drive[:, :, own])
            np.testing.assert_allclose(moved.sum(axis=2), reference.joint_jacobian[:, :, joint], atol=1e-9)
        axes = context.to_station(facing.axes.transpose(0, 2, 1))
        for row, prism in enumerate(data.prism):
            offsets = [op.parameter for op in chain.prism_ops[prism]]
            np.testing.assert_allclose(axes[row], reference.jacobian[row][:, offsets], atol=1e-12)


# -- where they can be -------------------------------------------------------------------------------------------------


def test_machines_without_a_telescope_or_a_linkage_have_no_place_for_what_needs_one() -> None:
    robot, torso = shipped_rig("ys100"), parse_rig((RIGS / "torso.toml").read_text(encoding="utf-8"), "torso.toml")
    families = library()
    assert families["boom_droop"].places(robot) == families["pad_play"].places(robot) == ()
    assert families["linkage_coupling"].places(robot) == ()
    assert families["linkage_coupling"].places(BOOM) == ("theta1",)
    assert families["linkage_coupling"].places(torso) == ("q1", "q2")
    assert families["passive_compliance"].places(robot) == ()
    assert families["passive_compliance"].places(BOOM) == ("row2",)
    levers = parse_rig((RIGS / "levers.toml").read_text(encoding="utf-8"), "levers.toml")
    assert families["passive_compliance"].places(levers) == ("row2",)  # a cylinder turns it
    assert families["lateral_compliance"].places(robot) == tuple(f"theta{number}" for number in range(2, 7))
    assert families["lateral_compliance"].places(BOOM) == tuple(f"theta{number}" for number in range(3, 9))
    assert families["zero_step"].places(BOOM) == tuple(n for n in BOOM.joint_names if n.startswith("theta"))
    assert families["prism_seat_step"].places(BOOM) == BOOM.prism_names
    assert families["prism_constant"].places(robot) == ("tool",)
    assert families["prism_constant"].places(BOOM) == ("w", "b", "r", "s", "station")


def test_effects_that_the_rows_cannot_show_take_no_form(machine: RigTruth, still: Observations) -> None:
    families = library()
    bare = placed(machine, replace(still, extra={}))
    for name in ("thermal_expansion", "base_settlement", "base_step", "base_shift", "latency", "clock_drift"):
        (where,) = families[name].places(BOOM)
        assert families[name].needs(where)
        assert not families[name].known(bare, where).any()
        assert families[name].variants(bare, where) == ()
    constant = {name: np.full(len(still), values[0]) for name, values in still.extra.items()}
    constant |= {f"{name}_rate": np.zeros(len(still)) for name in BOOM.joint_names}
    for name in ("thermal_expansion", "base_settlement", "base_step", "base_shift", "latency", "clock_drift"):
        (where,) = families[name].places(BOOM)
        assert families[name].variants(placed(machine, replace(still, extra=constant)), where) == ()
    first = placed(machine, still.select(still.prism == "w"))
    assert families["boom_droop"].variants(first, "boom") == families["pad_play"].variants(first, "boom") == ()
    assert families["prism_constant"].variants(first, "w")
    assert families["prism_constant"].variants(first, "b") == ()
    assert families["prism_constant"].variants(first, "station") == ()
    assert families["prism_incidence"].variants(first, "b") == ()
    weightless = BOOM.model_copy(update={"masses": ()})
    chain = Chain(weightless, bare.chain.placements)
    without = EffectContext(chain, bare.x, still)
    for name in ("boom_droop", "pad_play"):
        assert families[name].variants(without, "boom") == ()
        assert not families[name].known(without, "boom").any()
        settings = families[name].variants(placed(machine, still), "boom")[0]
        np.testing.assert_array_equal(moving_prisms(name).shift_mm(without, "boom", settings), 0.0)


@pytest.mark.parametrize(
    "name", ["thermal_expansion", "base_settlement", "base_step", "base_shift", "latency", "clock_drift"]
)
def test_rows_that_lack_a_column_are_left_alone_and_made_as_uncertain_as_the_effect_was(
    name: str, machine: RigTruth, still: Observations
) -> None:
    family = moving_prisms(name)
    (where,) = family.places(BOOM)
    context = placed(machine, still)
    settings = family.variants(context, where)[0]
    shift = family.shift_mm(context, where, settings)
    np.testing.assert_array_equal(family.shift_mm(placed(machine, replace(still, extra={})), where, settings), 0.0)
    values = np.array([c.sigma for c in family.coefficients(context, where, settings)])
    was = float(np.mean((shift @ values) ** 2))
    assert 0.3 * was < family.unknown_variance(values, values, settings) < 3.0 * was


def test_ground_that_comes_to_rest_has_sunk_as_much_by_then_as_its_mean_rate_says(
    machine: RigTruth, still: Observations
) -> None:
    family, context = moving_prisms("base_settlement"), placed(machine, still)
    steady, *slowing = (family.shift_mm(context, "base", form) for form in family.variants(context, "base"))
    for number, shift in enumerate(slowing):
        np.testing.assert_array_equal(shift[0], 0.0)
        np.testing.assert_allclose(shift[-1], steady[-1])
        # Half the time has more than half of it, the more the sooner it rests.
        before = steady if number == 0 else slowing[number - 1]
        middle = len(still) // 2
        assert np.linalg.norm(shift[middle]) > 1.05 * np.linalg.norm(before[middle])


@pytest.mark.parametrize("name", ["base_settlement", "clock_drift"])
def test_a_drift_rests_long_after_the_training(name: str, machine: RigTruth, still: Observations) -> None:
    family = moving_prisms(name)
    (where,) = family.places(BOOM)
    settings = family.variants(placed(machine, still), where)[0]
    row = still.select(np.array([-1]))  # of a moving boom, the last of six hours

    def after(hours: float) -> Floats:
        extra = dict(row.extra) | {"time_s": still.extra["time_s"][:1] + 3600.0 * hours}
        return family.shift_mm(placed(machine, replace(row, extra=extra)), where, settings)

    np.testing.assert_allclose(after(9.0), 1.5 * after(6.0), rtol=1e-6)
    np.testing.assert_allclose(after(5000.0), 2.0 * after(6.0), rtol=1e-6)


def test_joints_whose_rate_is_left_empty_stand(machine: RigTruth, still: Observations) -> None:
    family = moving_prisms("latency")
    moving = {name: values for name, values in still.extra.items() if name == "theta4_rate"}
    empty = {f"{name}_rate": np.full(len(still), np.nan) for name in BOOM.joint_names} | moving
    one, others = (placed(machine, replace(still, extra=extra)) for extra in (moving, empty))
    assert family.known(others, "clock").all()
    np.testing.assert_array_equal(
        family.shift_mm(one, "clock", {"size1_mm": 1.0}), family.shift_mm(others, "clock", {"size1_mm": 1.0})
    )


# -- in a model --------------------------------------------------------------------------------------------------------

HIDDEN = (
    "boom_droop@boom:flexibility_per_Nm2=4e-9,linkage_coupling@theta1:coupling=3e-3,latency@clock:seconds=0.08,"
    "base_step@base:tilt_x_rad=2e-3:tilt_y_rad=-1e-3:z_mm=5:time_s=1009000"
)
NAMED = "boom_droop@boom,linkage_coupling@theta1,latency@clock,base_step@base"


@pytest.fixture(scope="module")
def bent() -> tuple[RigTruth, Observations, Observations, CalibratedModel]:
    """A boom with four effects, 400 fixes of 2 mm noise, 200 fixes without noise for scoring, and its model."""
    truth = RigTruth(BOOM, 21, effects=parse_effects(HIDDEN))
    training, held_out = measured(truth, 400, 5, noise_mm=2.0), measured(truth, 200, 6)
    return truth, training, held_out, identify(BOOM, rig_text("swdt82"), training, effects=NAMED)


def test_a_model_with_effects_that_move_prisms_predicts_poses_it_never_saw(
    bent: tuple[RigTruth, Observations, Observations, CalibratedModel],
) -> None:
    _, _, held_out, model = bent
    without = rms(held_out.position_mm - Predictor.of(model).geometric_mm(held_out))
    error = held_out.position_mm - Predictor.of(model).effects_mm(held_out)
    assert without > 5.0
    # One row may lie between the true instant of the step and the one that was found.
    assert np.sort(np.linalg.norm(error, axis=1))[-2] < 4.0
    assert rms(error) < 0.2 * without
    prediction = Predictor.of(model).predict(held_out)
    np.testing.assert_array_equal(prediction.position_mm, Predictor.of(model).effects_mm(held_out))
    # Held-out rows have no noise, so that the errors are well within what a fix may be off.
    assert np.median(np.abs(error) / prediction.sigma_mm) < 0.5


def test_the_coefficients_come_out_as_they_were_hidden(
    bent: tuple[RigTruth, Observations, Observations, CalibratedModel],
) -> None:
    model = bent[-1]
    true = {
        "boom_droop": {"flexibility_per_Nm2": 4e-9},
        "linkage_coupling": {"coupling": 3e-3},
        "latency": {"seconds": 0.08},
        "base_step": {"tilt_x_rad": 2e-3, "tilt_y_rad": -1e-3, "z_mm": 5.0, "time_s": 1009000.0},
    }
    found = {e.family: {c.name: c for c in e.reported} for e in model.effects}
    for family, coefficients in true.items():
        for name, value in coefficients.items():
            assert abs(found[family][name].value - value) < 4.0 * found[family][name].standard_error, (family, name)
    # Rows are 54 s apart, and those of the prism near the base hardly show the step.
    assert 15.0 < found["base_step"]["time_s"].standard_error < 120.0
    assert set(found["boom_droop"]) == {"flexibility_per_Nm2"}


def test_such_a_model_comes_back_as_it_was_written(
    bent: tuple[RigTruth, Observations, Observations, CalibratedModel],
) -> None:
    _, _, held_out, model = bent
    files = model_to_files(model)
    again = model_from_files(files)
    assert model_to_files(again) == files
    assert again.effects == model.effects
    np.testing.assert_array_equal(
        Predictor.of(again).predict(held_out).sigma_mm, Predictor.of(model).predict(held_out).sigma_mm
    )


def test_a_refitted_base_keeps_them(bent: tuple[RigTruth, Observations, Observations, CalibratedModel]) -> None:
    truth, _, held_out, model = bent
    elsewhere = measured(truth, 60, 8, noise_mm=2.0, setup="there")
    moved = with_refitted_base(model, elsewhere)
    assert moved.effects == model.effects
    unseen = measured(truth, 100, 9, setup="there")
    here = rms(held_out.position_mm - Predictor.of(model).effects_mm(held_out))
    assert rms(unseen.position_mm - Predictor.of(moved).effects_mm(unseen)) < here + 1.5
    assert rms(unseen.position_mm - Predictor.of(moved).geometric_mm(unseen)) > 5.0


def test_rows_without_a_time_or_rates_are_predicted_with_a_wider_sigma_and_a_doubt(
    bent: tuple[RigTruth, Observations, Observations, CalibratedModel],
) -> None:
    _, _, held_out, model = bent
    bare = replace(held_out, extra={})
    warnings = " ".join(model_warnings(model, bare))
    assert "latency@clock is left out" in warnings
    assert "base_step@base is left out" in warnings
    assert (Predictor.of(model).predict(bare).sigma_mm > Predictor.of(model).predict(held_out).sigma_mm + 0.5).all()
