"""Data that would give a wrong model: each mistake is named, or made good with a warning that names it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from calibration.errors import UnsafeError
from calibration.evaluation.evaluation import evaluate
from calibration.observations import Observations, format_observations, parse_observations
from calibration.pipeline.calibrate import identify
from calibration.rig.description import parse_rig, shipped_rig
from calibration.run_settings import Run
from daemon.cli.main import main as rigcal
from tests.calibration.conftest import Session, rig_text, rms
from tests.calibration.identification.sweeps.test_circles import joined_observations

Change = Callable[[Observations], Observations]


def scaled(**factor: float) -> Change:
    """Readings of joints times a factor."""
    return lambda o: replace(o, joints={k: v * factor.get(k, 1.0) for k, v in o.joints.items()})


def exchanged(one: str, other: str) -> Change:
    """Two columns of readings exchanged."""
    return lambda o: replace(o, joints={**o.joints, one: o.joints[other], other: o.joints[one]})


def in_radians(o: Observations) -> Observations:
    return replace(o, joints={k: v if k.startswith("L") else np.radians(v) for k, v in o.joints.items()})


def in_gon(o: Observations) -> Observations:
    return replace(o, joints={k: v if k.startswith("L") else v / 0.9 for k, v in o.joints.items()})


def a_row_down(o: Observations) -> Observations:
    return replace(o, joints={k: np.roll(v, 1) for k, v in o.joints.items()})


def in_metres(o: Observations) -> Observations:
    return replace(o, position_mm=o.position_mm / 1000.0)


def in_si_units(o: Observations) -> Observations:
    return in_metres(scaled(L2=1e-3, L3=1e-3)(in_radians(o)))


def relabelled(o: Observations) -> Observations:
    return replace(o, prism=np.array([{"r": "s", "s": "r"}.get(p, p) for p in o.prism.tolist()]))


def refused(training: Observations, name: str, change: Change, prior: str = "recalibration") -> str:
    """What the refusal of the changed data says."""
    with pytest.raises(UnsafeError) as raised:
        identify(shipped_rig(name), rig_text(name), change(training), prior=prior)  # type: ignore[arg-type]  # a literal
    return str(raised.value)


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (scaled(theta5=-1.0), ["theta5 runs the other way", "3.6 mm are left in place of", "reverse the sign"]),
        (scaled(L3=-1.0), ["L3 runs the other way", "column L3_mm"]),
        (in_radians, ["all angles are in radians", "convert them to degrees"]),
        (in_gon, ["all angles are in gon", "convert them to degrees"]),
        (a_row_down, ["the readings are a row below the fixes", "move the columns of the joints a row up"]),
        (scaled(L3=1e-3), ["L3_mm is in m", "convert it to mm"]),
        (in_metres, ["the positions are in m", "convert x_mm, y_mm and z_mm to mm"]),
        (in_si_units, ["all angles are in radians and the length transducers in m and the positions in m"]),
        (exchanged("theta6", "theta7"), ["columns theta6_deg and theta7_deg are exchanged"]),
        (relabelled, ["prisms 'r' and 's' are exchanged", "column prism"]),
        (lambda o: replace(o, position_mm=o.position_mm[:, [0, 2, 1]]), ["mirrored", "right-handed"]),
        # The first alone explains most of the misfit.
        (scaled(theta4=-1.0, theta8=-1.0), ["theta4 runs the other way and theta8 runs the other way"]),
        (scaled(theta3=-1.0, theta4=np.pi / 180.0), ["theta3 runs the other way", "theta4_deg is in rad"]),
    ],
)
def test_a_mistake_is_refused_by_its_name(session: Session, change: Change, words: list[str]) -> None:
    message = refused(session.training, "swdt82", change)
    assert message.startswith("data and rig file do not match: ")
    for word in words:
        assert word in message


def test_a_sign_that_parameters_could_stand_for_is_named_all_the_same(session: Session) -> None:
    message = refused(session.training, "swdt82", scaled(theta1=-1.0), prior="as-built")
    assert "theta1 runs the other way" in message
    assert "the corrections are" in message


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (scaled(q2=-1.0), "q2 runs the other way"),
        (scaled(**{f"q{joint}": -1.0 for joint in range(1, 7)}), "all angles run the other way"),
        (scaled(q5=np.pi / 180.0), "q5_deg is in radians"),
        (lambda o: in_metres(in_radians(o)), "all angles are in radians and the positions in m"),
        (exchanged("q4", "q6"), "columns q4_deg and q6_deg are exchanged"),
        # Kinematically the same: either may be the mistake, so both are said.
        (scaled(q1=-1.0), "q1 runs the other way"),
        (scaled(q1=-1.0), "q2 reads 180 deg off"),
    ],
)
def test_mistakes_in_measured_data_are_named(ur10_random_poses: Observations, change: Change, words: str) -> None:
    assert words in refused(ur10_random_poses.select(np.arange(0, 2700, 10)), "ur10", change)


def test_a_unit_that_the_rig_file_converts_once_too_often_is_named(session: Session) -> None:
    text = rig_text("swdt82").replace("{ theta = { theta5 = -1.0 }", "{ theta = { theta5 = -0.0174533 }")
    with pytest.raises(UnsafeError, match=r"theta5 drives 0.0175 to 1 in the rig file and 1 to 1 in the data"):
        identify(parse_rig(text, "swdt82.toml"), text, session.training)


def test_a_turned_joint_is_made_good_as_built_and_named(session: Session) -> None:
    def turned(o: Observations) -> Observations:
        return replace(o, joints={**o.joints, "theta5": o.joints["theta5"] + 180.0})

    model = identify(session.rig, rig_text("swdt82"), turned(session.training), prior="as-built")
    assert any(w.startswith("theta5 reads 180 deg off") for w in model.warnings)
    assert rms(evaluate(model, turned(session.held_out)).errors_mm["geometric"]) < 6.0


@pytest.mark.long
def test_a_fifth_of_gross_outliers_with_a_reversed_joint_is_still_named(session: Session) -> None:
    position = session.training.position_mm.copy()
    bad = np.random.default_rng(3).permutation(250)[:50]
    position[bad] += np.random.default_rng(4).normal(0.0, 2000.0, (50, 3))
    dirty = replace(session.training, position_mm=position)
    assert "theta4 runs the other way" in refused(dirty, "swdt82", scaled(theta4=-1.0))
    model = identify(session.rig, rig_text("swdt82"), dirty)
    assert rms(evaluate(model, session.held_out).errors_mm["geometric"]) < 6.0
    assert any("of 250 training fixes are outliers" in w for w in model.warnings)


@pytest.mark.long
def test_copied_rows_count_once_and_are_named(session: Session) -> None:
    position = session.training.position_mm.copy()
    position[7] += [0.0, 0.0, 3000.0]
    training = replace(session.training, position_mm=position, pose=np.full(250, ""))
    copied = training.select(np.concatenate([np.arange(250), np.arange(100)]))
    copied = parse_observations(format_observations(copied, session.rig).encode(), session.rig, "copied.csv")
    model = identify(session.rig, rig_text("swdt82"), copied)
    once = identify(session.rig, rig_text("swdt82"), training)
    assert any(
        w.startswith("100 of 350 rows are exact copies of earlier rows") and "in line 252; " in w
        for w in model.warnings
    )
    assert any(w.startswith("1 of 250 training fixes are outliers") and w.endswith("in line 9") for w in model.warnings)
    np.testing.assert_array_equal(model.values, once.values)
    np.testing.assert_array_equal(model.covariance, once.covariance)
    assert (model.outliers, model.noise_mm) == (once.outliers, once.noise_mm)
    assert model.provenance["fixes"] == 250
    few, often = training.select(np.arange(40)), training.select(np.arange(120) % 40)
    refitted, again = (evaluate(once, rows, refit_base=True) for rows in (few, often))
    np.testing.assert_array_equal(refitted.model.covariance, again.model.covariance)
    assert any("was fitted on these 40 fixes" in w for w in again.warnings)
    with pytest.raises(UnsafeError, match="18 different poses among 40 fixes "):
        identify(session.rig, rig_text("swdt82"), session.training.select(np.arange(40) % 18))


def test_fewer_fixes_than_parameters_are_named(session: Session) -> None:
    model = identify(session.rig, rig_text("swdt82"), session.training.select(np.arange(30)))
    assert any(
        w.startswith("30 different poses (a pose counts once for each prism) are few for 56 parameters")
        for w in model.warnings
    )


@pytest.mark.long
def test_an_encoder_that_does_not_read_is_named(session: Session) -> None:
    frozen = replace(session.training, joints={**session.training.joints, "theta3": np.full(250, 80.0)})
    assert "theta3 never moved in these data" in refused(frozen, "swdt82", lambda o: o)


def test_the_same_readings_again_count_as_one_fix(session: Session) -> None:
    again = session.training.select(np.arange(120) % 30)
    noise_mm = np.random.default_rng(5).normal(0.0, 3.0, (120, 3))
    again = replace(again, position_mm=again.position_mm + noise_mm, pose=np.arange(120).astype(np.str_))
    model = identify(session.rig, rig_text("swdt82"), again, effects="none")
    assert any(
        w.startswith("30 different poses (a pose counts once for each prism) are few for 56 parameters")
        for w in model.warnings
    )


def test_a_machine_that_stands_still_is_one_pose_whatever_its_encoders_add(session: Session) -> None:
    still = session.training.select(np.zeros(60, dtype=np.intp))
    rng = np.random.default_rng(6)
    joints = {j.name: still.joints[j.name] + j.sigma * rng.normal(size=60) for j in session.rig.joints}
    position_mm = still.position_mm + rng.normal(0.0, 2.0, (60, 3))
    still = replace(still, joints=joints, position_mm=position_mm, pose=np.full(60, ""))
    with pytest.raises(UnsafeError, match=r"1 different pose among 60 fixes .* has 3 coordinates"):
        identify(session.rig, rig_text("swdt82"), still)


@pytest.mark.parametrize("method", ["default", "km"])
def test_a_base_that_only_noise_turns_is_refused(session: Session, method: str) -> None:
    lone = session.training.select(np.zeros(12, dtype=np.intp))
    noise_mm = np.random.default_rng(7).normal(0.0, 2.0, (12, 3))
    lone = replace(
        lone, position_mm=lone.position_mm + noise_mm, setup=np.full(12, "new"), pose=np.arange(12).astype(str)
    )
    turns = "set-up 'new': all fixes lie in one place or on a line, apart from their noise"
    with pytest.raises(UnsafeError, match=turns):
        identify(session.rig, rig_text("swdt82"), joined_observations([session.training, lone]), method=method)
    with pytest.raises(UnsafeError, match=turns):
        evaluate(session.model, lone, refit_base=True)


def test_coordinates_in_another_order_are_named_where_positions_come_out_right(session: Session) -> None:
    cyclic = replace(session.training, position_mm=session.training.position_mm[:, [1, 2, 0]])
    model = identify(session.rig, rig_text("swdt82"), cyclic)
    assert any(
        re.match("the base: the upward direction of the rig file is (89|90|91) deg .* order of x, y, z", w)
        for w in model.warnings
    )


def test_good_data_are_not_accused(session: Session) -> None:
    assert session.model.warnings == ()


def test_the_command_refuses_with_status_3_and_writes_no_model(session: Session, tmp_path: Path) -> None:
    data = tmp_path / "reversed.csv"
    data.write_text(format_observations(scaled(theta7=-1.0)(session.training), session.rig), encoding="utf-8")
    arguments = ["calibrate", "--rig", "swdt82", "--data", str(data), "--out", str(tmp_path / "model"), "--json"]
    result = CliRunner().invoke(rigcal, arguments)
    assert result.exit_code == 3
    assert "theta7 runs the other way" in json.loads(result.stdout)["error"]
    assert not (tmp_path / "model").exists()


@pytest.mark.parametrize("method", ["km", "skcm", "rbf-tcm", "pde-paper"])
def test_no_method_takes_mirrored_coordinates(session: Session, method: str) -> None:
    mirrored = replace(session.training, position_mm=session.training.position_mm * [-1.0, 1.0, 1.0])
    with pytest.raises(UnsafeError, match="mirrored"):
        identify(session.rig, rig_text("swdt82"), mirrored, method=method)


@pytest.mark.parametrize("method", ["km", "skcm"])
def test_least_squares_refuse_what_they_cannot_fit(session: Session, method: str) -> None:
    with pytest.raises(UnsafeError, match=r"still \d+ mm RMS, but this rig's build tolerances explain"):
        identify(session.rig, rig_text("swdt82"), in_radians(session.training), method=method)


def test_the_published_search_says_when_it_has_not_come_to_rest(session: Session) -> None:
    wrong = scaled(theta4=-1.0)(session.training.select(np.arange(60)))
    model = identify(session.rig, rig_text("swdt82"), wrong, method="pde-paper", run=Run(should_stop=lambda: True))
    assert any("the search has not converged, or the data are not of this rig" in warning for warning in model.warnings)


def test_warnings_of_the_training_are_told_apart_from_those_of_other_rows(session: Session) -> None:
    doubled = session.training.select(np.concatenate([np.arange(250), np.arange(5)]))
    model = identify(session.rig, rig_text("swdt82"), doubled)
    assert any(w.startswith("5 of 255 rows are exact copies") for w in evaluate(model, doubled).warnings)
    assert any(w.startswith("in training: 5 of 255 rows") for w in evaluate(model, session.held_out).warnings)
