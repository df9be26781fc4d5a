"""Columns that were written otherwise than they are read: rounded, in another unit, of another clock or origin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calibration.errors import DataError, UnsafeError
from calibration.evaluation.evaluation import evaluate
from calibration.model.model import CalibratedModel
from calibration.observations import Floats, Observations, format_observations, parse_observations
from calibration.pipeline.calibrate import identify
from calibration.pipeline.find_gap import find_gap
from tests.calibration.conftest import Session, rig_text, rms, simulated
from tests.calibration.identification.sweeps.test_circles import joined_observations
from tests.simulated.observations import simulate_observations

Change = Callable[[Observations], Observations]


def calibrated(session: Session, rows: Observations) -> CalibratedModel:
    return identify(session.rig, rig_text("swdt82"), rows, effects="none")


def rounded(step: float, *names: str) -> Change:
    """Readings of joints in whole steps."""
    return lambda o: replace(o, joints={k: np.rint(v / step) * step if k in names else v for k, v in o.joints.items()})


def with_sigma(sigma_mm: float) -> Change:
    return lambda o: replace(o, sigma_mm=np.full_like(o.position_mm, sigma_mm))


def at_times(time_s: Floats) -> Change:
    return lambda o: replace(o, extra={**o.extra, "time_s": time_s})


def test_rounded_readings_are_named_and_nothing_else_is_blamed(session: Session) -> None:
    coarse = rounded(0.1, "theta1", "theta3", "theta4", "theta5")
    named = "theta1_deg theta3_deg theta4_deg theta5_deg in steps of 0.1 (rig file: 0.0055)"
    (training,) = calibrated(session, coarse(session.training)).warnings
    (held_out,) = evaluate(session.model, coarse(session.held_out)).warnings
    assert named in training
    assert named in held_out


def test_poses_that_were_planned_in_whole_degrees_are_not_taken_for_rounded_readings(session: Session) -> None:
    rng = np.random.default_rng(1)
    poses = {j.name: np.rint(rng.uniform(*j.limits, 100)) for j in session.rig.joints}
    data = simulate_observations(
        session.truth, 100, 7, poses=poses, prisms_per_pose="one", noise_mm=3.0, joint_noise=False
    )
    planned = parse_observations(data.csv_text().encode(), session.rig, "planned.csv")
    assert calibrated(session, planned).warnings == ()


@pytest.mark.parametrize(
    ("sigma_mm", "words"), [(0.3, "whether the sigma columns are too small"), (9.0, "check the sigma columns")]
)
def test_sigma_columns_that_are_far_off_are_named(session: Session, sigma_mm: float, words: str) -> None:
    (warning,) = calibrated(session, with_sigma(sigma_mm)(session.training)).warnings
    assert words in warning


def test_sigmas_that_are_too_large_do_not_make_a_gap(session: Session) -> None:
    gap = find_gap(session.rig, rig_text("swdt82"), with_sigma(9.0)(session.training))
    assert gap.verdict == "none"
    assert [w for w in gap.warnings if "too large ones make a loose fit" in w] == list(gap.warnings)


def test_data_without_noise_leave_nothing_that_lacks_a_name(session: Session) -> None:
    data = simulate_observations(session.truth, 250, 7, prisms_per_pose="one", noise_mm=0.0, joint_noise=False)
    model = identify(
        session.rig, rig_text("swdt82"), parse_observations(data.csv_text().encode(), session.rig, "exact.csv")
    )
    (warning,) = model.warnings
    assert "simulated data without noise have this effect too" in warning


def test_rows_without_a_setup_beside_others_are_told(session: Session) -> None:
    mixed = replace(session.training, setup=np.array(["S1"] * 200 + [""] * 50))
    model = calibrated(session, replace(mixed, setup=np.full(250, "S1")))
    with pytest.raises(UnsafeError, match=r"set-up '' \(no setup in the row\) is unknown to the model"):
        evaluate(model, mixed)
    (warning,) = calibrated(session, mixed).warnings
    assert warning.startswith("50 of 250 rows have no setup, the first in line 202, while others have 'S1'")


def test_a_clock_that_was_set_back_is_told_and_a_sorted_table_is_not(session: Session) -> None:
    rows = session.training
    time_s = rows.extra["time_s"].copy()
    time_s[120:] -= 600.0
    (warning,) = calibrated(session, at_times(time_s)(rows)).warnings
    assert warning.startswith("time_s runs backward, first in line 122")
    assert warning in evaluate(session.model, at_times(time_s)(rows)).warnings
    by_prism = rows.select(np.argsort(rows.prism, kind="stable"))
    shuffled = rows.select(np.random.default_rng(1).permutation(len(rows)))
    for good in (by_prism, shuffled):
        assert evaluate(session.model, good).warnings == ()


def test_a_clock_in_milliseconds_is_told(session: Session) -> None:
    time_s = session.held_out.extra["time_s"]
    (warning,) = evaluate(session.model, at_times(1e3 * time_s)(session.held_out)).warnings
    assert warning.startswith("time_s: half of the fixes are more than ")
    assert warning.endswith("so divide it by 1000 if it is in milliseconds")


def test_a_base_that_few_fixes_place_says_how_well_they_do(session: Session) -> None:
    many = replace(session.training, setup=np.full(250, "S1"))
    few, later = (simulated(session.truth, n, seed, setup="S2") for n, seed in ((3, 9), (250, 10)))
    model = calibrated(session, joined_observations([many, few]))
    told = [w for w in model.warnings if w.startswith("set-up 'S2' has only 3 fixes")]
    (said_mm,) = (float(w.split("are uncertain by ")[1].split(" mm")[0]) for w in told)
    total_mm = rms(evaluate(model, later).errors_mm["effects"])
    assert 0.5 * said_mm < np.sqrt(total_mm**2 - model.effects_noise_mm**2) < 2.0 * said_mm


@pytest.mark.parametrize(("factor", "unit"), [(1e-3, "t"), (1e3, "g")])
def test_a_payload_in_another_unit_is_named(session: Session, factor: float, unit: str) -> None:
    payload_kg = np.linspace(0.0, 300.0, len(session.held_out))
    good, bad = (replace(session.held_out, extra={"payload_kg": f * payload_kg}) for f in (1.0, factor))
    (said,) = evaluate(session.model, bad).warnings
    assert said.endswith(f"is it in {unit}? convert it to kg")
    assert evaluate(session.model, good).warnings == ()


def test_rates_that_no_joint_has_are_named(session: Session) -> None:
    fast = np.where(np.arange(len(session.held_out)) < 20, 600.0, 5.0)
    rows = replace(session.held_out, extra={"theta4_rate": fast, "theta5_rate": fast / 60.0})
    (said,) = evaluate(session.model, rows).warnings
    assert said.startswith("theta4_rate: 20 of 500 are more than 3 times its max_rate, ")


def test_map_coordinates_are_named(session: Session) -> None:
    far = replace(session.training, position_mm=session.training.position_mm + np.array([5e5, 6.7e6, 1e5]))
    assert calibrated(session, far).warnings[0].startswith("the fixes are 6.73 km from the origin")
    farther = replace(far, position_mm=far.position_mm + np.array([0.0, 6.7e9, 0.0]))
    with pytest.raises(DataError, match="subtract the instrument's coordinates from map coordinates"):
        parse_observations(format_observations(farther, session.rig).encode(), session.rig, "map.csv")
