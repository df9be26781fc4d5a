"""A machine that leans as its inclinometer says: named, however the sensor is mounted, and true on other ground."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.effects.context import EffectContext
from calibration.effects.library import library
from calibration.evaluation.evaluation import evaluate
from calibration.kinematics.chain import Chain, Placement
from calibration.observations import Floats, Observations, parse_observations
from calibration.pipeline.calibrate import identify
from calibration.pipeline.find_gap import find_gap
from calibration.rig.description import parse_rig, shipped_rig
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import rig_text, rms
from tests.simulated.observations import simulate_observations

FAMILY = library()["measured_tilt"]
TILTS = ("tilt_x_deg", "tilt_y_deg")
TEXT = rig_text("ur10") + "".join(f'\n[[signal]]\nname = "{name[:6]}"\nunit = "deg"\n' for name in TILTS)
RIG = parse_rig(TEXT, "ur10.toml")
MOUNTED = np.deg2rad(40.0)  # how the sensor is turned about the vertical
NOISE_MM = 0.05
LIFT = """
name = "mast"
convention = "dh"
gravity = [0, 0, -1]
[tolerances]
length_mm = 1.0
angle_deg = 0.2
beta_deg = 0.1
prism_mm = 1.0
[station]
angle_sigma_arcsec = 1.0
distance_sigma_mm = 0.3
distance_sigma_ppm = 1.0
target_sigma_mm = 0.1
[[joint]]
name = "lift"
kind = "prismatic"
sigma = 0.1
max_rate = 100
limits = [0, 4000]
[[joint]]
name = "q1"
kind = "revolute"
sigma = 0.01
max_rate = 10
limits = [-180, 180]
[[row]]
drive = { d = { lift = 1.0 } }
[[row]]
a_mm = 500
drive = { theta = { q1 = 1.0 } }
[[prism]]
name = "tool"
frame = 2
offset_mm = [0, 0, 0]
"""


def leaning(lean_deg: Floats, seed: int, setup: str = "") -> Observations:
    """Fixes of a machine that leans by (n, 2) angles about the level axes through its base's origin."""
    truth = RigTruth(shipped_rig("ur10"), 11)
    table = simulate_observations(truth, len(lean_deg), seed, noise_mm=NOISE_MM, setup=setup)
    rows = parse_observations(table.csv_text().encode(), RIG, "machine.csv")
    base, about = (
        truth.placement(setup),
        np.array([[np.cos(MOUNTED), -np.sin(MOUNTED)], [np.sin(MOUNTED), np.cos(MOUNTED)]]),
    )
    turns = Rotation.from_rotvec(np.deg2rad(np.column_stack([lean_deg, np.zeros(len(lean_deg))])))
    in_base = turns.apply((rows.position_mm - base.position_mm) @ base.rotation)
    extra = rows.extra | dict(zip(TILTS, (lean_deg @ about.T).T, strict=True))
    return replace(rows, position_mm=in_base @ base.rotation.T + base.position_mm, extra=extra)


def swaying(n: int, seed: int, mean_deg: tuple[float, float] = (0.0, 0.0)) -> Floats:
    return np.random.default_rng(seed).normal(mean_deg, 0.1, (n, 2))


@cache
def training() -> Observations:
    return leaning(swaying(200, 1), 11)


def test_a_lean_that_an_inclinometer_shows_is_named_and_taken_out() -> None:
    held_out = leaning(swaying(100, 2), 12)
    gap = find_gap(RIG, TEXT, training(), holdout=held_out)
    (effect,) = gap.effects
    assert (effect.family, effect.where, gap.verdict) == ("measured_tilt", "tilt", "named")
    across, along = np.deg2rad(1.0) * np.sin(MOUNTED), np.deg2rad(1.0) * np.cos(MOUNTED)
    found = {c.name.removesuffix("_rad_per_deg"): c for c in effect.reported}
    for name, true in (
        ("about_x_by_x", along),
        ("about_x_by_y", across),
        ("about_y_by_x", -across),
        ("about_y_by_y", along),
    ):
        assert abs(found[name].value - true) < max(4.0 * found[name].standard_error, 2e-2 * np.deg2rad(1.0))
    before, after = gap.held_out or (0.0, np.inf)
    assert after < 1.3 * NOISE_MM * np.sqrt(3.0) < 0.2 * before


@pytest.mark.parametrize("mean_deg", [(0.0, 0.0), (1.5, -1.0)])
def test_on_other_ground_the_lean_is_the_same_function_of_the_readings(mean_deg: tuple[float, float]) -> None:
    model = identify(RIG, TEXT, training(), effects="measured_tilt@tilt")
    there = leaning(swaying(100, 3, mean_deg), 13, setup="there")
    evaluation = evaluate(model, there, refit_base=True)
    assert rms(evaluation.errors_mm["effects"]) < 1.3 * NOISE_MM * np.sqrt(3.0)
    assert rms(evaluation.errors_mm["geometric"]) > 5.0 * NOISE_MM * np.sqrt(3.0)


def test_an_inclinometer_is_a_pair_of_signals_in_degrees_called_tilt() -> None:
    assert FAMILY.places(RIG) == ("tilt",)
    plain = shipped_rig("ur10")
    for columns, places in (
        (("tilt_mast_x_deg", "tilt_mast_y_deg"), ("tilt_mast",)),
        (("tilt_mast_x_deg",), ()),
        (("tilt_mast_x_deg", "tilt_mast_y_mm"), ()),
        (("wind_x_deg", "wind_y_deg"), ()),
        ((), ()),
    ):
        assert FAMILY.places(plain.with_signals(*columns) if columns else plain) == places


@pytest.mark.parametrize("reading_deg", [np.full(200, 0.3), np.linspace(-30.0, 60.0, 200)], ids=["still", "of a boom"])
def test_an_inclinometer_that_never_moves_or_that_a_joint_turns_shows_nothing(reading_deg: Floats) -> None:
    rows = replace(training(), extra=training().extra | dict.fromkeys(TILTS, reading_deg))
    chain = Chain(RIG, {"": Placement.identity()})
    assert FAMILY.variants(EffectContext(chain, np.zeros(len(chain)), rows), "tilt") == ()


def test_a_mast_turns_about_its_foot_or_a_point_of_its_lift() -> None:
    rig = parse_rig(LIFT, "mast.toml").with_signals(*TILTS)
    header = f"prism,lift_mm,q1_deg,x_mm,y_mm,z_mm,{','.join(TILTS)}"
    lines = [f"tool,{lift},20,1,2,3,{tilt},0" for lift in (1000, 3000) for tilt in (0, 1)]
    rows = parse_observations("\n".join([header, *lines]).encode(), rig, "mast.csv")
    chain = Chain(rig, {"": Placement.identity()})
    context = EffectContext(chain, np.zeros(len(chain)), rows)
    forms = FAMILY.variants(context, "tilt")
    assert [form["pivot"] for form in forms] == pytest.approx([0.0, 1 / 3, 0.5, 1.0])
    for form in forms:
        # Of the turn about y by the reading of x: what a mast above the turning point adds along x.
        moved = FAMILY.shift_mm(context, "tilt", form)[:, 0, 1]
        lever_mm = (1.0 - form["pivot"]) * np.array([1000.0, 3000.0])
        np.testing.assert_allclose(moved[1::2] - moved[0::2], lever_mm, rtol=1e-12, atol=1e-9)
