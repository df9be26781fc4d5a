"""What the library lacks is not told under the name of what imitates it: events, drifts, and links that give way."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.effects.library import library
from calibration.gap.result import GapResult
from calibration.observations import parse_observations
from calibration.pipeline.find_gap import find_gap
from calibration.rig.description import parse_rig
from daemon.rig_files import load_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.bench.measured_arms import IIWA, IIWA_MASSES, rig_text
from tests.simulated.observations import simulate_observations

SOURCE = load_rig("swdt82")
TIME_S = 100.0 * np.arange(160.0)


def answer(effects: str, without: str = "") -> GapResult:
    """Return the answer to 160 rows of a machine with effects, by a library that may lack one of them."""
    truth = RigTruth(SOURCE.rig, 21, effects=parse_effects(effects))
    data = simulate_observations(truth, 160, 21, noise_mm=1.0, prisms=["r"], columns={"time_s": TIME_S})
    rows = parse_observations(data.csv_text().encode(), SOURCE.rig, "machine.csv")
    return find_gap(SOURCE.rig, SOURCE.text, rows, families=[name for name in library() if name != without])


@pytest.mark.long
def test_what_happens_at_one_instant_is_not_told_as_steps_of_something_else() -> None:
    gap = answer("prism_seat_step@r:x_mm=12:y_mm=-14:z_mm=30:time_s=8000", without="prism_seat_step")
    assert gap.effects == ()
    assert "time_s = 8" in str(gap.description)


@pytest.mark.long
def test_a_step_is_named_where_nothing_else_happened() -> None:
    gap = answer("zero_step@theta5:jump_rad=6e-3:time_s=8000", without="prism_seat_step")
    assert [(e.family, e.where) for e in gap.effects] == [("zero_step", "theta5")]


@pytest.mark.long
def test_a_link_that_gives_way_otherwise_than_the_library_knows_is_not_told_as_another_one() -> None:
    gap = answer("lateral_compliance@theta7:compliance_rad_per_Nm=8e-7", without="lateral_compliance")
    assert gap.effects == ()
    assert "theta7 error by load" in str(gap.description)


@pytest.mark.long
def test_a_step_keeps_its_name_beside_an_event_at_another_instant() -> None:
    event = "prism_seat_step@r:x_mm=12:y_mm=-14:z_mm=30:time_s=11000"
    gap = answer(f"zero_step@theta5:jump_rad=4e-3:time_s=4000,{event}", without="prism_seat_step")
    assert [(e.family, e.where) for e in gap.effects] == [("zero_step", "theta5")]
    assert "more has changed at time_s = 110" in str(gap.description)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "coefficients"),
    [
        ("joint_compliance@theta5", "compliance_rad_per_Nm=3e-7"),
        ("base_compliance@base", "x_rad_per_Nm=2e-8:y_rad_per_Nm=2e-8"),
    ],
)
def test_what_gives_way_keeps_its_name_beside_a_link_that_gives_way_otherwise(name: str, coefficients: str) -> None:
    link = "lateral_compliance@theta7:compliance_rad_per_Nm=8e-7"
    gap = answer(f"{name}:{coefficients},{link}", without="lateral_compliance")
    assert [f"{e.family}@{e.where}" for e in gap.effects] == [name]
    assert "theta7 error by load" in str(gap.description)


@pytest.mark.long
def test_what_changes_steadily_is_not_told_as_a_step_beside_one_that_is_there() -> None:
    settles = "base_settlement@base:tilt_x_rad_per_h=-3e-4:tilt_y_rad_per_h=4.7e-4:z_mm_per_h=-1.3"
    gap = answer(f"zero_step@theta5:jump_rad=-4e-3:time_s=6000,{settles}", without="base_settlement")
    assert [(e.family, e.where) for e in gap.effects] == [("zero_step", "theta5")]
    assert "time, at all joints and all places" in str(gap.description)


@pytest.mark.long
def test_links_that_give_way_as_the_library_knows_take_no_name_away() -> None:
    # The links of an arm of seven joints can do for one another: others explain what a link that is named does.
    text = rig_text("iiwa7", IIWA, IIWA_MASSES, ["tool"])
    rig = parse_rig(text, "iiwa7.toml")
    effects = (
        "joint_compliance@q4:compliance_rad_per_Nm=1e-5,joint_compliance@q3:compliance_rad_per_Nm=2e-5,"
        "lateral_compliance@q3:compliance_rad_per_Nm=2e-5,base_compliance@base:x_rad_per_Nm=3e-6:y_rad_per_Nm=4e-6"
    )
    data = simulate_observations(RigTruth(rig, 1, effects=parse_effects(effects)), 100, 1, noise_mm=0.2)
    gap = find_gap(rig, text, parse_observations(data.csv_text().encode(), rig, "machine.csv"))
    assert [f"{e.family}@{e.where}" for e in gap.effects] == ["lateral_compliance@q3"]
