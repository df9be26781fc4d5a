"""Where an input of an effect is unknown in some rows, the effect keeps its size, and nothing else is named for it."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.effects.columns import NO_JOINT
from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice
from calibration.effects.library import library
from calibration.errors import DataError
from calibration.gap.result import GapResult
from calibration.gap.unknown_inputs import Unknowns, filled_in, unknown_inputs
from calibration.identification.samples import averaged
from calibration.identification.solve import place
from calibration.observations import Observations, parse_observations
from calibration.pipeline.calibrate import identify
from calibration.pipeline.find_gap import find_gap
from daemon.rig_files import load_rig
from tests.daemon.support.gap import session_csv

SOURCE = load_rig("swdt82")
WIDTH_RAD = 4e-3
SLIPPED_DEG = 0.2  # the play moves the joint by at most 0.115 deg
FIRST_LACKING = 100


@functools.cache
def session() -> Observations:
    """80 poses of a boom with play at theta4, two prisms each."""
    data = session_csv(80, 21, hidden=f"backlash@theta4:width_rad={WIDTH_RAD}")
    return parse_observations(data, SOURCE.rig, "session.csv")


def without(rows: Observations, lacking: NDArray[np.bool_], column: str = "theta4_dir") -> Observations:
    values = np.where(lacking, np.nan, rows.extra[column])
    return replace(rows, extra={**rows.extra, column: values})


def with_hidden(hidden: str, seed: int, poses: int = 80) -> Observations:
    return parse_observations(session_csv(poses, seed, hidden=hidden), SOURCE.rig, "session.csv")


def slipped(seed: int, slip_deg: float) -> Observations:
    """Return rows with play, of which the last lack its direction and have another zero of the joint."""
    rows = with_hidden(f"backlash@theta4:width_rad={WIDTH_RAD}", seed)
    late = np.arange(len(rows)) >= FIRST_LACKING
    theta4 = rows.joints["theta4"] + np.where(late, slip_deg, 0.0)
    return without(replace(rows, joints={**rows.joints, "theta4": theta4}), late)


def sizes(found: GapResult) -> dict[str, float]:
    """Return the first coefficient of each effect that was found."""
    return {f"{effect.family}@{effect.where}": effect.coefficients[0].value for effect in found.effects}


def named(rows: Observations, *families: str) -> dict[str, float]:
    """Return the first coefficient of each effect that is found."""
    return sizes(find_gap(SOURCE.rig, SOURCE.text, rows, families=families or None))


def numbers() -> NDArray[np.intp]:
    return np.arange(len(session()))


@pytest.mark.long
@pytest.mark.parametrize(
    "lacking",
    [
        (numbers() >= 30) & (numbers() < 60),
        numbers() >= 100,
        np.random.default_rng(21).random(160) < 0.25,
        numbers() % 4 < 2,
        numbers() % 2 == 0,
    ],
    ids=[
        "fifteen poses",
        "the last thirty poses",
        "a quarter at random",
        "every second pose",
        "one prism of each pose",
    ],
)
def test_play_is_named_alone_and_whole_where_its_direction_is_unknown_in_some_rows(lacking: NDArray[np.bool_]) -> None:
    found = named(without(session(), lacking))
    assert found == {"backlash@theta4": pytest.approx(WIDTH_RAD, rel=0.03)}


@pytest.mark.long
@pytest.mark.parametrize("seed", [5, 11])
def test_a_zero_that_slipped_where_the_direction_is_unknown_is_named_beside_the_play(seed: int) -> None:
    assert named(slipped(seed, 1.5 * SLIPPED_DEG), "backlash", "zero_step") == {
        "backlash@theta4": pytest.approx(WIDTH_RAD, rel=0.05),
        "zero_step@theta4": pytest.approx(-np.radians(1.5 * SLIPPED_DEG), rel=0.15),
    }


@pytest.mark.long
@pytest.mark.parametrize("seed", [5, 11])
def test_a_slip_that_is_hardly_larger_than_the_play_is_named_or_reported(seed: int) -> None:
    found = find_gap(SOURCE.rig, SOURCE.text, slipped(seed, SLIPPED_DEG), families=("backlash", "zero_step"))
    assert sizes(found)["backlash@theta4"] == pytest.approx(WIDTH_RAD, rel=0.05)
    assert "zero_step@theta4" in sizes(found) or found.warnings[0].startswith("60 fixes that lack inputs of backlash")


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "width_rad", "first"),
    [(34, 1.2e-3, 90), (36, 1.6e-3, 90), (52, 3e-3, 84)],
)
def test_the_rows_that_have_the_input_decide_on_the_name(seed: int, width_rad: float, first: int) -> None:
    """Taken as rows without play, the others give the play another name, or hide it."""
    rows = with_hidden(f"backlash@theta4:width_rad={width_rad}", seed)
    found = named(without(rows, numbers() >= first))
    assert found == {"backlash@theta4": pytest.approx(width_rad, rel=0.1)}


def some_poses(share: float, seed: int) -> NDArray[np.bool_]:
    """Return a mask of the rows of a random share of the poses."""
    return np.repeat(np.random.default_rng(seed).random(len(numbers()) // 2) < share, 2)


@pytest.mark.long
@pytest.mark.parametrize(
    ("hidden", "seed", "column"),
    [
        ("base_settlement@base:tilt_x_rad_per_h=0.001:tilt_y_rad_per_h=0.0005:z_mm_per_h=3", 51, "time_s"),
        ("leak_down@theta4:rad_per_s=2e-5", 302, "dwell_s"),
    ],
)
def test_an_effect_of_one_sign_is_named_where_a_third_of_the_poses_lacks_its_input(
    hidden: str, seed: int, column: str
) -> None:
    rows = without(with_hidden(hidden, seed), some_poses(0.35, seed), column)
    assert list(named(rows)) == [hidden.partition(":")[0]]


@pytest.mark.long
def test_the_size_of_an_effect_of_one_sign_is_that_of_the_rows_that_have_its_input() -> None:
    true, hidden = 1e-3, "base_settlement@base:tilt_x_rad_per_h=0.001:tilt_y_rad_per_h=0.0005:z_mm_per_h=3"
    off = []
    for seed in range(300, 310):
        rows = without(with_hidden(hidden, seed), some_poses(0.3, seed), "time_s")
        (effect,) = identify(SOURCE.rig, SOURCE.text, rows, effects="base_settlement@base").effects
        off.append((effect.coefficients[0].value - true) / effect.coefficients[0].standard_error)
    assert np.sqrt(np.mean(np.square(off))) < 1.5  # 1.0 where nothing is lacking


def test_no_slip_with_travel_is_looked_for_where_the_order_of_some_rows_is_unknown() -> None:
    rows = without(session(), numbers() < 2, "time_s")
    told = "needs the column time_s in all rows or in none"
    with pytest.raises(DataError, match=told):
        identify(SOURCE.rig, SOURCE.text, rows, effects="transducer_cumulative@L2")
    found = find_gap(SOURCE.rig, SOURCE.text, rows, families=("backlash", "transducer_cumulative"))
    assert found.warnings[-1].startswith("not looked for: transducer_cumulative@L2")
    assert told in found.warnings[-1]


@pytest.mark.long
@pytest.mark.parametrize("seed", [41, 42])
def test_an_effect_is_named_where_no_row_has_all_inputs(seed: int) -> None:
    rows = with_hidden("backlash@theta4:width_rad=3e-3", seed)
    found = named(without(without(rows, numbers() < 80), numbers() >= 80, "time_s"))
    assert found == {"backlash@theta4": pytest.approx(3e-3, rel=0.05)}


@pytest.mark.long
@pytest.mark.parametrize(
    ("hidden", "lacking"),
    [
        ("zero_step@theta4:jump_rad=0.003:time_s=1800", (numbers() >= 80) & (numbers() < 82)),
        ("zero_step@theta4:jump_rad=0.003:time_s=1800", (numbers() >= 60) & (numbers() < 110)),
        ("base_step@base:tilt_x_rad=0.002:tilt_y_rad=0.001:z_mm=5:time_s=1800", numbers() // 2 % 3 == 0),
    ],
    ids=["zero, one pose", "zero, 25 poses around the step", "base, every third pose"],
)
def test_a_step_is_named_alone_where_some_rows_have_no_time(hidden: str, lacking: NDArray[np.bool_]) -> None:
    found = named(without(with_hidden(hidden, 61), lacking, "time_s"))
    assert list(found) == [hidden.partition(":")[0]]


@pytest.mark.long
def test_an_effect_that_the_rows_with_its_input_do_not_show_is_not_named() -> None:
    """All of these were approached from one side, so the play cannot show there; the others have a different zero."""
    rows, late = with_hidden("", 70), numbers() >= FIRST_LACKING
    theta4 = rows.joints["theta4"] + np.where(late, 0.5 * SLIPPED_DEG, 0.0)
    approached = np.where(late, np.nan, 1.0)
    moved = replace(rows, joints={**rows.joints, "theta4": theta4}, extra={**rows.extra, "theta4_dir": approached})
    found = find_gap(SOURCE.rig, SOURCE.text, moved, families=("backlash",))
    assert found.verdict == "unidentified"
    assert any(warning.startswith("not named: backlash@theta4; the rows that have all") for warning in found.warnings)


def test_a_place_whose_input_no_row_has_is_reported_as_not_looked_for() -> None:
    rows = without(session(), numbers() >= 0)
    found = find_gap(SOURCE.rig, SOURCE.text, rows, families=("backlash",))
    assert found.warnings[-1].startswith(
        "not looked for: backlash@theta4; needs the column theta4_dir, which no row has: these effects may be"
    )


@pytest.mark.long
def test_sizes_and_their_standard_errors_are_right_where_two_effects_lack_inputs() -> None:
    true = {"theta4": 4e-3, "theta5": 3e-3}
    hidden = ",".join(f"backlash@{joint}:width_rad={width_rad}" for joint, width_rad in true.items())
    off = []
    for seed in range(100, 120):
        rows = without(with_hidden(hidden, seed), (numbers() >= 40) & (numbers() < 80))
        rows = without(rows, (numbers() >= 100) & (numbers() < 140), "theta5_dir")
        model = identify(SOURCE.rig, SOURCE.text, rows, effects="backlash@theta4,backlash@theta5")
        fitted = ((true[effect.where], effect.coefficients[0]) for effect in model.effects)
        off += [(one.value - width_rad) / one.standard_error for width_rad, one in fitted]
    assert np.sqrt(np.mean(np.square(off))) < 1.5  # 1.1 where nothing is lacking


@pytest.mark.long
def test_errors_that_lacking_directions_cannot_explain_and_that_get_no_name_are_reported() -> None:
    """The joint is off in just these poses, and not in later ones: the library has no such effect."""
    off = (numbers() >= 30) & (numbers() < 60)
    theta4 = session().joints["theta4"] + np.where(off, 3.0 * SLIPPED_DEG, 0.0)
    rows = without(replace(session(), joints={**session().joints, "theta4": theta4}), off)
    found = find_gap(SOURCE.rig, SOURCE.text, rows, families=("backlash", "zero_step"))
    assert [str(effect.where) for effect in found.effects] == ["theta4"]
    assert found.warnings[0].startswith(
        "30 fixes that lack inputs of backlash@theta4 have larger errors than that can cause"
    )


def test_an_effect_that_is_asked_for_by_name_keeps_its_size_where_its_input_is_unknown() -> None:
    rows = without(session(), numbers() >= 100)
    model = identify(SOURCE.rig, SOURCE.text, rows, effects="backlash@theta4")
    (effect,) = model.effects
    assert effect.coefficients[0].value == pytest.approx(WIDTH_RAD, rel=0.03)
    assert abs(effect.coefficients[0].value - WIDTH_RAD) < 3.0 * effect.coefficients[0].standard_error
    assert len(model.covariance) == len(model.chain) + 1  # the model has no unknowns of its training rows
    assert len(model.fitted_rows) == len(rows)
    assert "backlash@theta4 is left out in 60 of 160 rows: this data lacks the column theta4_dir" in model.warnings


def test_the_size_is_right_where_hundreds_of_samples_in_a_row_lack_the_input() -> None:
    data = session_csv(300, 3, hidden=f"backlash@theta4:width_rad={WIDTH_RAD}")
    rows = parse_observations(data, SOURCE.rig, "session.csv")
    model = identify(SOURCE.rig, SOURCE.text, without(rows, np.arange(600) >= 330), effects="backlash@theta4")
    (effect,) = model.effects
    assert effect.coefficients[0].value == pytest.approx(WIDTH_RAD, rel=0.02)


def unknowns(family: str, where: str, value: float, rows: Observations) -> Unknowns | None:
    """Return the unknowns of rows of which each is a sample, for one effect of a given size."""
    chain, _, start = place(SOURCE.rig, rows)
    context = EffectContext(chain, start.x, rows)
    settings = library()[family].variants(context, where)[0]
    effect = Choice(family, where, settings).fitted(context, np.array([value]), np.array([1e-5]))
    return unknown_inputs([effect], context, averaged(chain, rows))


def test_each_run_of_samples_has_an_unknown_of_the_play_s_size_in_common_and_each_standstill_one_of_its_own() -> None:
    lacking = np.isin(numbers(), (30, 31, 32, 33, 34, 50, 52, 53))
    found = unknowns("backlash", "theta4", WIDTH_RAD, without(session(), lacking))
    assert found is not None
    assert [np.flatnonzero(own).tolist() for own in found.runs.column.T] == [[30, 31, 32, 33, 34]]
    theta4 = SOURCE.rig.joint_names.index("theta4")
    assert found.runs.joint.tolist() == [theta4]
    size_deg = np.degrees(WIDTH_RAD / 2)
    assert found.runs.prior_sigma == pytest.approx(size_deg)
    assert found.variance[:, theta4] == pytest.approx(np.where(lacking, size_deg**2, 0.0))
    assert not np.delete(found.variance, theta4, axis=1).any()
    assert unknowns("backlash", "theta4", WIDTH_RAD, session()) is None


def test_a_run_ends_with_its_session() -> None:
    rows = without(session(), (numbers() >= 30) & (numbers() < 42))
    found = unknowns("backlash", "theta4", WIDTH_RAD, replace(rows, session=np.where(numbers() < 36, "one", "two")))
    assert found is not None
    assert [(own.argmax(), own.sum()) for own in found.runs.column.T] == [(30, 6), (36, 6)]


def test_of_many_runs_the_longest_have_an_unknown_in_common() -> None:
    rows = session().select(np.tile(numbers(), 5))
    moved = rows.position_mm + 1e-3 * np.repeat(np.arange(5), len(session()))[:, None]  # so that none is a copy
    many = replace(rows, position_mm=moved, pose=np.arange(len(rows)).astype(str))
    lacking = (np.arange(len(rows)) % 20 < 4) | (np.arange(len(rows)) < 10)
    found = unknowns("backlash", "theta4", WIDTH_RAD, without(many, lacking))
    assert found is not None
    assert found.runs.column.sum(axis=0).tolist() == [10.0, *[4.0] * 19]
    assert (found.variance.any(axis=1) == lacking).all()


def test_an_effect_on_the_prisms_has_unknowns_along_all_axes() -> None:
    warm = replace(session(), extra={**session().extra, "temperature_degC": 5.0 + numbers() / 10.0})
    lacking = (numbers() >= 40) & (numbers() < 46)
    found = unknowns("thermal_expansion", "boom", 12e-6, without(warm, lacking, "temperature_degC"))
    assert found is not None
    assert found.runs.shift_mm is not None
    assert set(found.runs.joint.tolist()) == {NO_JOINT}
    assert found.runs.shift_mm[40].tolist() == found.runs.shift_mm[45].tolist() == np.eye(3).tolist()
    assert not found.runs.shift_mm[~lacking].any()
    assert ((found.along_axes_mm2 > 0.0) == lacking).all()


def test_rows_of_a_standstill_share_its_inputs_but_not_its_rates() -> None:
    rows = session().select(np.repeat(numbers(), 2))
    again = replace(rows, position_mm=rows.position_mm + 1e-3 * (np.arange(len(rows)) % 2)[:, None])
    odd = np.arange(len(rows)) % 2 == 1
    samples = averaged(place(SOURCE.rig, again)[0], again)
    given = without(again, odd)
    rates = np.where(odd, np.nan, 1.0)
    full = filled_in(replace(given, extra={**given.extra, "theta4_rate": rates}), samples)
    assert full.extra["theta4_dir"].tolist() == again.extra["theta4_dir"].tolist()
    np.testing.assert_array_equal(full.extra["theta4_rate"], rates)
