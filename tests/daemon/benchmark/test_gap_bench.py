"""The benchmark of the gap workflow: its scores, and that the analysis sees no label."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from calibration.observations import parse_observations
from daemon.benchmark.cases import LABELS, Case, CasesError, draw_cases, measure, read_labels
from daemon.benchmark.score import Score, scores, tallies
from daemon.benchmark.trial import Floats, Trial, trial
from daemon.cli.main import main as rigcal
from daemon.rig_files import load_rig

STRANGE = ("gear_mesh",)  # what no library has
TWIN_MM = np.array([[0.0, 0.0, 0.0], [90.0, 0.0, 0.0]])  # without the effect
TRUTH_MM = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]])


def label(kind: str = "single", *families: str, **more: Any) -> dict[str, Any]:
    effects = [
        {
            "family": family,
            "where": "theta4",
            "has_name": family not in STRANGE,
            "places": ["theta4"],
            "coefficients": {"size": 2.0},
            "scale": {"size": 1.0},
            "separable": True,
        }
        for family in families
    ]
    cell = {"case": "case-1", "kind": kind, "poses": "wide", "noise": "station", "size": 1.0, "seed": 7}
    judged = {
        "separable": True,
        "plain": True,
        "alternative": "",
        "general": [],
        "aliases": [],
        "regime": None,
        "truth_mm": TRUTH_MM.tolist(),
        "twin_mm": TWIN_MM.tolist(),
    }
    return {**cell, **judged, "effects": effects, **more}


def named(*families: str, where: str = "theta4", value: float = 2.0, error: float = 0.1) -> dict[str, Any]:
    coefficients = {"size": {"value": value, "unit": "1", "standard_error": error}}
    effects = [{"family": family, "where": where, "coefficients": coefficients} for family in families]
    return {"case": "case-1", "verdict": "named", "effects": effects, "indistinguishable": [], "seconds": 0.5}


def pending(*families: str) -> dict[str, Any]:
    candidates = [{"family": family, "where": "theta4", "posterior": 0.5} for family in families]
    return {**named(), "verdict": "indistinguishable", "indistinguishable": candidates}


def silent(verdict: str = "none", **more: Any) -> dict[str, Any]:
    return {**named(), "verdict": verdict, **more}


def judged(
    of: Mapping[str, Any], told: Mapping[str, Any], measured: Mapping[str, Any] | None = None, oracle: Any = None
) -> Trial:
    return trial(of, told, measured, oracle)


def score(trials: list[Trial], what: str) -> Score:
    return next(s for s in scores(trials) if s.what == what)


RIGHT = "rightly named at >= 1x, separable"
SET = "truth in a reported set where no name was possible"
UNTOLD = {"separable": False, "plain": False}


def test_a_case_is_right_only_if_all_that_is_hidden_was_named_and_nothing_else() -> None:
    trials = [
        judged(label("single", "backlash"), named("backlash")),
        judged(label("single", "backlash"), named("latency")),
        judged(label("single", "backlash"), named("backlash", "latency")),
        judged(label("single", "backlash"), pending("backlash", "latency")),
        judged(label("single", "backlash"), silent()),
    ]

    found = score(trials, RIGHT)

    assert (found.value, found.n, found.met) == (0.2, 5, False)
    assert [t.outcome for t in trials] == ["right", "wrong", "wrong", "set", "none"]
    assert score(trials, "wrong name among all named").value == pytest.approx(2 / 3)


def test_the_right_family_at_another_joint_is_right_but_out_of_place() -> None:
    trials = [judged(label("single", "backlash"), named("backlash", where="theta3"))]

    assert score(trials, RIGHT).value == 1.0
    assert score(trials, "  also at the right place").value == 0.0


def test_what_nobody_could_tell_apart_does_not_count_as_separable() -> None:
    trials = [judged(label("single", "backlash", **UNTOLD), pending("backlash", "latency"))]

    assert score(trials, RIGHT).n == 0
    assert score(trials, RIGHT).met is None
    assert score(trials, "  of all cases, separable or not").value == 0.0
    assert score(trials, SET).value == 1.0


def test_a_set_is_no_miss_where_a_draw_in_fifty_leaves_nothing_else() -> None:
    trials = [judged(label("single", "backlash", plain=False), pending("backlash", "latency"))]

    assert score(trials, RIGHT).value == 0.0
    assert score(trials, SET).value == 1.0
    assert score(trials, "  truth in a set of an inseparable effect").value == 0.0


@pytest.mark.parametrize(
    ("of", "told"),
    [
        pytest.param({}, ("backlash", "latency"), id="could have been named"),
        pytest.param(UNTOLD, ("leak_down", "latency"), id="truth is not in it"),
        pytest.param(UNTOLD, ("backlash", "latency", "leak_down", "base_step"), id="four families"),
    ],
)
def test_a_set_is_a_miss(of: dict[str, Any], told: tuple[str, ...]) -> None:
    trials = [judged(label("single", "backlash", **of), pending(*told))]

    assert score(trials, SET).value == 0.0


def test_a_set_is_resolved_when_the_proposed_poses_lead_to_the_right_name() -> None:
    of = label("single", "backlash", **UNTOLD)
    trials = [
        judged(of, pending("backlash", "latency"), measured) for measured in (named("backlash"), named("latency"))
    ]

    assert score(trials, "set resolved after 20 proposed poses").value == 0.5


def test_what_poses_promised_is_held_against_what_they_brought() -> None:
    of, trials = label("single", "backlash", **UNTOLD), []
    for sigma, after in ((6.0, "backlash"), (6.0, "latency"), (2.0, "latency")):
        promised = {"kind": "poses", "text": "", "poses": [{}], "stands_out_sigma": {"backlash": 9.0, "latency": sigma}}
        trials.append(judged(of, {**pending("backlash", "latency"), "experiments": [promised]}, named(after)))

    assert score(trials, "  where the poses were expected to resolve it").value == 0.5
    assert score(trials, "  sets that 20 poses were not expected to resolve").value == pytest.approx(1 / 3)


def test_an_exact_alias_must_be_answered_with_both_families() -> None:
    of = label("alias", "backlash", aliases=["backlash", "latency"])
    trials = [judged(of, told) for told in (pending("latency", "backlash"), named("backlash"), pending("backlash"))]

    assert score(trials, "exact aliases: set with the truth and its alias").value == pytest.approx(1 / 3)


def test_any_verdict_but_none_is_an_alarm_where_nothing_is_hidden() -> None:
    trials = [judged(label("null"), told) for told in (silent(), silent("unidentified"), named("backlash"), silent())]

    assert score(trials, "no effect: falsely named").value == 0.25
    assert score(trials, "no effect: any alarm").value == 0.5


def test_shares_come_with_wilsons_interval() -> None:
    trials = [judged(label("null"), silent()) for _ in range(300)]

    found = score(trials, "no effect: any alarm")

    # No event in 300: Wilson's upper end is z^2 / (n + z^2).
    z2 = 1.959964**2
    assert found.interval == pytest.approx((0.0, z2 / (300 + z2)), abs=1e-9)
    assert found.met


def test_the_gap_closed_is_measured_between_the_kinematics_and_their_oracle() -> None:
    def off(place_mm: Floats, error_mm: float) -> list[list[float]]:
        return (place_mm + np.array([error_mm, 0.0, 0.0])).tolist()

    told = {**named("backlash"), "before_mm": off(TRUTH_MM, 5.0), "after_mm": off(TRUTH_MM, 3.0)}
    trials = [judged(label("single", "backlash"), told, oracle={"oracle_mm": off(TWIN_MM, 1.0)})]

    assert score(trials, "held-out gap closed at >= 1x, median").value == pytest.approx((25 - 9) / (25 - 1))


def test_an_effect_that_does_not_show_on_held_out_poses_leaves_no_gap_to_close() -> None:
    told = {**named("backlash"), "before_mm": TRUTH_MM.tolist(), "after_mm": TRUTH_MM.tolist()}
    trials = [judged(label("single", "backlash"), told, oracle={"oracle_mm": TWIN_MM + 1.0})]

    assert score(trials, "held-out gap closed at >= 1x, median").n == 0


def test_coefficients_are_held_against_the_truth_and_their_intervals() -> None:
    trials = [
        judged(label("single", "backlash"), named("backlash", value=2.1, error=0.1)),
        judged(label("single", "backlash"), named("backlash", value=2.1, error=0.01)),
    ]

    assert score(trials, "coefficient error at 1x, median of relative errors").value == pytest.approx(0.05)
    assert score(trials, "90 % intervals of coefficients cover").value == 0.5


def test_an_effect_outside_the_library_is_located_by_what_is_said_of_it() -> None:
    of = label("outside", "gear_mesh")
    trials = [
        judged(of, silent("unidentified", description="theta4 angle error = 1e-4 sin 9 theta4; not in the library")),
        judged(of, silent("unidentified", disagreements=[{"where": "theta4", "variable": "time", "p": 1e-5}])),
        judged(of, silent("unidentified", description="theta5 angle error = 1e-4 sin 9 theta4; not in the library")),
        judged(of, named("encoder_harmonic", where="theta5")),
    ]

    assert score(trials, "outside the library: right location").value == 0.5
    assert score(trials, "outside the library: misnamed").value == 0.25


def test_beside_an_effect_outside_the_library_it_is_right_to_name_the_one_inside_alone() -> None:
    of = label("beside", "gear_mesh", "backlash")
    told = (named("backlash"), named("backlash", "latency"), silent("unidentified"), named("latency"))
    trials = [judged(of, answer) for answer in told]

    assert score(trials, "with an effect outside the library: rightly named").value == 0.25
    assert score(trials, "  misnamed").value == 0.5


def test_a_more_general_family_is_no_misnaming_where_the_particular_one_is_left_out() -> None:
    of = label("left_out", "encoder_harmonic", general=["joint_error_map"])
    trials = [judged(of, told) for told in (named("joint_error_map"), named("angle_scale"), silent("unidentified"))]

    assert score(trials, "a family left out of the library: misnamed").value == pytest.approx(1 / 3)
    assert score(trials, "  misnamed or named as a more general family").value == pytest.approx(2 / 3)


def test_a_case_that_failed_is_a_miss_and_is_counted() -> None:
    failed = {"case": "case-1", "verdict": "failed", "error": "no base", "seconds": 0.1}
    trials = [judged(label("single", "backlash"), failed), judged(label("null"), failed)]

    assert score(trials, RIGHT).value == 0.0
    assert score(trials, "no effect: any alarm").value == 1.0
    assert score(trials, "cases that ended in an error").value == 1.0


def test_families_are_tallied_with_what_they_were_taken_for() -> None:
    trials = [
        judged(label("single", "backlash"), named("backlash")),
        judged(label("single", "backlash"), named("latency")),
        judged(label("single", "leak_down", size=3.0), silent()),
    ]

    first, second = tallies(trials)

    assert (first.family, first.size, dict(first.outcomes)) == ("backlash", 1.0, {"right": 1, "wrong": 1})
    assert dict(first.mistaken) == {"latency": 1}
    assert (second.family, second.size, dict(second.outcomes)) == ("leak_down", 3.0, {"none": 1})


def test_what_analyses_a_case_knows_nothing_of_the_simulators() -> None:
    program = (
        "import sys, daemon.benchmark.analyse, calibration.pipeline.find_gap\n"
        "sys.exit(any(name.partition('.')[0] == 'simulators' for name in sys.modules))"
    )

    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def draw(directory: Path) -> tuple[Case, ...]:
    directory.mkdir()
    return draw_cases("swdt82", ["--short", "--cells", "triple,decoy", "--first", "7", "--workers", "1"], directory)


@pytest.mark.long
def test_labels_are_in_a_file_of_their_own_and_a_seed_makes_all_again(tmp_path: Path) -> None:
    cases = draw(tmp_path / "first")
    labels = read_labels(tmp_path / "first")["labels"]
    again = draw(tmp_path / "again")

    assert [label["case"] for label in labels] == [case.name for case in cases]
    triples = {label["case"] for label in labels if label["kind"] == "triple"}
    assert all(len(label["effects"]) == 3 for label in labels if label["kind"] == "triple")
    others = [path for path in (tmp_path / "first").iterdir() if path.name != LABELS]
    assert not any(b"triple" in path.read_bytes() or b"boom_droop" in path.read_bytes() for path in others)
    for path in (tmp_path / "first").iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()
    assert [case.name for case in again] == [case.name for case in cases]
    rig = load_rig("swdt82").rig
    for case in cases:
        if case.name in triples:
            own, twin = (parse_observations(case.csv(kind), rig, "csv") for kind in ("", "-twin"))
            assert np.array_equal(own.joints["theta4"], twin.joints["theta4"])
            assert not np.allclose(own.position_mm, twin.position_mm, atol=1.0)


@pytest.mark.long
def test_further_poses_are_measured_of_the_same_machine(tmp_path: Path) -> None:
    rig = load_rig("swdt82").rig
    pose = {joint.column: sum(joint.limits) / 2 for joint in rig.joints}
    case = draw(tmp_path / "cases")[0]
    header = case.csv("-held-out").decode().splitlines()[0].split(",")
    before = parse_observations(case.csv(), rig, "train.csv")

    measure("swdt82", {case.name: [pose | {"fixes": 1}, pose | {"fixes": 3}]}, case.directory)

    after = parse_observations(case.csv("-measured"), rig, "measured.csv")
    assert len(after) == len(before) + 4
    one, *three = after.pose[len(before) :]
    assert len({one, *three}) == 2
    assert len({*three}) == 1
    assert np.ptp(after.position_mm[-3:], axis=0).min() > 0.0
    assert np.array_equal(after.position_mm[: len(before)], before.position_mm)
    assert after.joints["theta4"][-1] == pytest.approx(22.5, abs=0.2)
    # The rows to predict come without positions.
    assert "theta4_deg" in header
    assert not {"x_mm", "y_mm", "z_mm", "sigma_x_mm"} & set(header)
    with pytest.raises(CasesError, match="there is no case case-99999"):
        measure("swdt82", {"case-99999": [pose]}, case.directory)


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--effects", "rust", "rust: unknown; known: joint_compliance"),
        ("--first", "999000", "reach the reported seeds"),  # seeds to tune on and seeds to report never meet
    ],
)
def test_cases_that_there_are_not_are_refused(option: str, value: str, said: str) -> None:
    result = CliRunner().invoke(rigcal, ["bench", "gap", "--json", option, value])

    assert result.exit_code == 2
    assert said in json.loads(result.stdout)["error"]


def at(*places: str, regime: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """An answer that names `family@where` of each."""
    effects = [
        {"family": family, "where": where, "coefficients": {}, "regime": regime}
        for family, where in (place.split("@") for place in places)
    ]
    return {**named(), "effects": effects}


def hidden_at(kind: str, *places: str, **more: Any) -> dict[str, Any]:
    effects = [
        {**label(kind, family)["effects"][0], "where": where} for family, where in (p.split("@") for p in places)
    ]
    return {**label(kind), "effects": effects, **more}


def test_effects_of_a_machine_are_counted_one_by_one_with_their_places() -> None:
    of = hidden_at("machine", "backlash@theta4", "backlash@theta5", "latency@clock", general=["base_compliance"])
    trials = [
        judged(of, at("backlash@theta4", "latency@clock", "base_compliance@base")),
        judged(of, at("backlash@theta4", "backlash@theta6")),
        judged(of, silent("unidentified")),
    ]

    assert score(trials, "machine: effects named at their place").value == pytest.approx(3 / 9)
    wrong = score(trials, "machine: wrong name or place among all named")
    assert (wrong.value, wrong.n) == (pytest.approx(1 / 5), 5)


def test_effects_that_raise_the_held_out_error_of_a_machine_are_a_miss() -> None:
    of = hidden_at("machine", "backlash@theta4")
    near, far = (TRUTH_MM + 1.0).tolist(), (TRUTH_MM + 2.0).tolist()
    trials = [
        judged(of, {**at("backlash@theta4"), "before_mm": before, "after_mm": after})
        for before, after in ((near, near), (far, near), (near, far))
    ]

    found = score(trials, "machine: held-out error raised")

    assert found.value == pytest.approx(1 / 3)
    assert not found.met


PART = {"variable": "theta5", "above": True, "border": 10.0, "low": 4.0, "high": 16.0}


@pytest.mark.parametrize(
    ("told", "border", "part", "wrong"),
    [
        pytest.param({"variable": "theta5", "above": True, "border": 15.0}, 1.0, 1.0, 0.0, id="right"),
        pytest.param({"variable": "theta5_deg", "above": True, "border": 15.0}, 1.0, 1.0, 0.0, id="by its column"),
        pytest.param({"variable": "theta5", "above": True, "border": 17.0}, 0.0, 1.0, 0.0, id="border"),
        pytest.param({"variable": "theta5", "above": False, "border": 10.0}, 0.0, 0.0, 1.0, id="side"),
        pytest.param({"variable": "time_s", "above": True, "border": 10.0}, 0.0, 0.0, 1.0, id="variable"),
        pytest.param(None, 0.0, 0.0, 0.0, id="all rows"),
    ],
)
def test_an_effect_in_a_part_of_the_data_is_named_with_the_part_and_its_border(
    told: Mapping[str, Any] | None, border: float, part: float, wrong: float
) -> None:
    trials = [judged(hidden_at("regime", "backlash@theta4", regime=PART), at("backlash@theta4", regime=told))]

    assert score(trials, "regime: effect, part and border named").value == border
    assert score(trials, "  effect and part, any border").value == part
    assert score(trials, "  effect, any part").value == 1.0
    assert trials[0].is_right == (border == 1.0)
    assert score(trials, "regime: wrong name, place or part among all named").value == wrong


def test_no_name_may_come_of_noise_that_wanders_along_a_path() -> None:
    answers = (silent(), silent("unidentified"), named("backlash"), pending("backlash", "latency"))
    trials = [judged(label("path"), told) for told in answers]

    found = score(trials, "no effect, noise wandering along a path: named, also in a set")

    assert (found.value, found.met) == (0.5, False)
    assert score(trials, "  any alarm").value == 0.75
