from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calibration.gap.result import Disagreement, GapResult, Round
from calibration.model.model import Outlier
from daemon.report.drawing import picture, styled
from daemon.report.gap.figures import apparent, error_maps
from daemon.report.gap.page import bars, gap_report, intervals
from daemon.report.gap.words import before_and_after, closed_share, gap_headline, tolerance_verdict
from daemon.report.words import odds, readable_unit, spoken
from tests.daemon.report.calibration.test_report import Outline
from tests.daemon.support import gap as support

SOURCES = {"data": "session.csv, SHA-256 abc"}


def outline(gap: GapResult) -> Outline:
    return Outline(gap_report(gap, SOURCES))


@pytest.fixture(scope="module")
def document() -> str:
    return gap_report(support.named(), SOURCES)


@pytest.fixture(scope="module")
def named(document: str) -> Outline:
    return Outline(document)


@pytest.fixture(scope="module")
def pending() -> Outline:
    """A set, of data with a temperature, with a held-out file."""
    gap = replace(support.pending(), observations=support.of_time(support.named()), held_out=(11.0, 10.9))
    return outline(gap)


def test_what_leaves_fixes_out_does_not_pass_and_says_so() -> None:
    gap = support.nothing()
    with_outliers = replace(gap, model=replace(gap.model, outliers=(Outlier(3, 120.0), Outlier(9, 4000.0))))
    verdicts = [tolerance_verdict(found, 1e3) for found in (gap, with_outliers)]
    assert [verdict and verdict.outcome for verdict in verdicts] == ["passed", "not judged"]
    assert "except for 2 of 120 fixes that are up to 4,000 sigma off" in gap_headline(with_outliers)
    shared = replace(gap, held_out=(2.0, 2.0), shared=4)
    assert [(v := tolerance_verdict(g, 1e3)) and v.outcome for g in (shared, replace(shared, shared=0))] == [
        "not judged",
        "passed",
    ]


def test_the_report_of_a_named_effect_has_every_section(named: Outline) -> None:
    assert named.headings == [
        "From the simulation down to the noise",
        "What was missing",
        "Where simulation and measurement disagree",
        "Candidates, and why they were rejected",
        "What these data could not have shown",
        "What to measure next",
        "Where this comes from",
    ]


def test_it_is_one_file_that_loads_nothing(document: str, named: Outline) -> None:
    assert not re.search(r"https?://|@import|url\(|<script|<link", document)
    assert all(reference.startswith("data:image/svg+xml") for reference in named.references)
    assert len(named.pictures) == 7
    assert all(picture["alt"] for picture in named.pictures)


@pytest.mark.parametrize(
    ("gap", "headline"),
    [
        (support.named, "The simulation lacked backlash at theta4."),
        (support.nothing, "Simulation and measurement agree within the noise."),
        (
            support.pending,
            "The simulation lacks encoder harmonic at theta4 or backlash at theta5: these data cannot show",
        ),
        (support.unidentified, "The simulation lacks something that no effect of the library explains."),
    ],
)
def test_the_verdict_is_the_headline(gap: Callable[[], GapResult], headline: str) -> None:
    assert gap_headline(gap()).startswith(headline)


def test_the_verdict_says_that_held_out_rows_fit_worse() -> None:
    worse, better = (replace(support.named(), held_out=(0.5, after)) for after in (0.61, 0.4))
    assert gap_headline(worse) == (
        "The simulation lacked backlash at theta4. "
        "But held-out rows fit worse with it, 0.610 mm instead of 0.500 mm: do not use this model there."
    )
    assert gap_headline(better) == "The simulation lacked backlash at theta4."
    assert worse.as_dict()["holdout"] == {"rms_before_mm": 0.5, "rms_after_mm": 0.61, "is_worse": True}


def test_the_coefficient_stands_with_its_interval_between_its_bounds(named: Outline) -> None:
    (line,) = intervals(support.named())
    (coefficient,) = support.named().effects[0].coefficients
    assert (line.value, line.lower, line.upper, line.unit) == (1000.0 * coefficient.value, 0.0, 5.0, "milliradians")
    assert line.error == 1000.0 * coefficient.standard_error
    for words in ("width", "0 .. 5.00", "over 99.9 %", "milliradians"):
        assert words in named.text


def test_the_steps_are_the_held_out_error_before_each_round() -> None:
    gap = support.named()
    assert [(bar.label, bar.rms_mm) for bar in bars(gap)] == [
        ("calibrated kinematics", gap.rounds[0].held_out_mm),
        ("+ backlash at theta4", gap.rounds[1].held_out_mm),
    ]
    assert before_and_after(gap)[:2] == (gap.rounds[0].held_out_mm, gap.rounds[1].held_out_mm)


def test_one_family_at_several_joints_is_one_step() -> None:
    gap = support.named()
    rounds = (Round(9.0, ("backlash@theta4", "backlash@theta5"), ()), Round(3.0, (), ()))
    assert [bar.label for bar in bars(replace(gap, rounds=rounds))][1] == "+ backlash at theta4 and theta5"
    assert spoken([("backlash", "a"), ("latency", "clock")]) == "backlash at a and latency at clock"


def test_the_held_out_file_goes_before_poses_held_out_in_turn(pending: Outline) -> None:
    gap = replace(support.named(), held_out=(11.0, 3.2))
    assert before_and_after(gap) == (11.0, 3.2, "on the held-out fixes", True)
    assert "Root mean square error on the held-out fixes." in pending.text


@pytest.mark.parametrize(
    ("before", "after", "noise", "share"),
    [(5.0, 3.0, 3.0, 1.0), (5.0, 5.0, 3.0, 0.0), (5.0, 2.9, 3.0, 1.0), (3.0, 3.0, 3.1, None)],
)
def test_the_closed_share_is_of_what_noise_does_not_explain(
    before: float, after: float, noise: float, share: float | None
) -> None:
    assert closed_share(before, after, noise) == share


def test_rivals_stand_with_their_odds_and_why_they_were_rejected(named: Outline) -> None:
    for words in (
        "encoder harmonic at theta4", "less probable", "its width is beyond the bound", "wins in 12 % of half-samples",
        "adopted", "55 : 1", "over 10\u2076 : 1",
    ):  # fmt: skip
        assert words in named.text


def test_what_the_data_could_not_have_shown_is_said_by_effect(named: Outline) -> None:
    text = named.text.partition("What these data could not have shown")[2]
    for words in (
        "Too small to be named", "boom droop", "station scale", "thermal expansion: needs the column temperature_degC",
        "latency: it has no effect in these poses", "What these data could have shown (2 effects)", "260 microradians",
    ):  # fmt: skip
        assert words in text


def test_a_set_has_the_poses_that_separate_it_and_no_effect_table(pending: Outline) -> None:
    assert "What was missing" not in pending.headings
    for words in (
        "cannot show which", "Measure these 3 poses.", "Approach each pose once from below", "theta4_deg", "r s",
    ):  # fmt: skip
        assert words in pending.text


def test_what_depends_on_temperature_is_drawn_against_it(pending: Outline) -> None:
    pictures = [picture["alt"] for picture in pending.pictures]
    assert "Components of the error against temperature" in pictures
    assert len(pictures) == 7


def test_structure_without_a_name_is_described_and_text_is_escaped() -> None:
    odd = (Disagreement("<b>", "<script>", 0.001),)
    gap = replace(support.unidentified(), disagreements=odd, warnings=("<i>",))
    document = gap_report(gap, {"data": "<u>.csv"})
    assert "theta4 angle error = 2.3e-4 (rad/K) dT cos theta4; not in the library" in document
    assert "<script>" not in document
    assert "&lt;script&gt;" in document
    assert "&lt;u&gt;.csv" in document


def test_a_picture_is_the_same_bytes_each_time() -> None:
    with styled():
        first, second = (picture(error_maps(support.named()), "map", "") for _ in range(2))
    assert first == second


def test_a_backlash_shows_as_the_joints_own_error_by_direction_and_is_gone_after() -> None:
    gap = support.named()
    own = apparent(gap)["theta4"]
    direction = gap.observations.extra["theta4_dir"][own.rows]
    jumps = [float(np.mean(e[direction > 0]) - np.mean(e[direction < 0])) for e in own.errors]
    assert jumps[0] > 1.0  # mrad, of a width of 3: other joints share it
    assert abs(jumps[1]) < 0.2


@pytest.mark.parametrize(
    ("unit", "reach", "scale", "readable"),
    [
        ("rad", 5e-3, 1e3, "mrad"),
        ("rad", 5e-5, 1e6, "\N{MICRO SIGN}rad"),
        ("mm", 30.0, 1.0, "mm"),
        ("1", 5e-3, 1e3, "\N{MULTIPLICATION SIGN}\N{THIN SPACE}10\u207b\u00b3"),
        ("1/K", 2.5e-5, 1e6, "\N{MULTIPLICATION SIGN}\N{THIN SPACE}10\u207b\u2076 1/K"),
        ("rad", math.inf, 1.0, "rad"),
    ],
)
def test_small_numbers_are_read_in_small_units(unit: str, reach: float, scale: float, readable: str) -> None:
    assert readable_unit(unit, reach) == (pytest.approx(scale), readable)


@pytest.mark.parametrize(
    ("log_bf", "words"), [(0.0, "1.0 : 1"), (math.log(50.0), "50 : 1"), (-math.log(4.0), "1 : 4.0")]
)
def test_odds_are_whole_numbers_either_way(log_bf: float, words: str) -> None:
    assert odds(log_bf) == words
