from __future__ import annotations

import base64
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from daemon.report.calibration.inputs import EffectLine, ErrorTable, ParameterLine, spread
from daemon.report.calibration.page import calibration_report, headline
from daemon.report.words import number, signed
from tests.daemon.support.report_inputs import report_input

VOID = {"meta", "img", "br"}


class Outline(HTMLParser):
    """What a browser would see: headings, text, pictures, references; every element closed in order."""

    def __init__(self, document: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.headings: list[str] = []
        self.pictures: list[dict[str, str]] = []
        self.references: list[str] = []
        self.text = ""
        self.feed(document)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        values = {name: value or "" for name, value in attrs}
        if tag == "img":
            self.pictures.append(values)
        self.references += [values[name] for name in ("src", "href") if name in values]
        if tag == "h2":
            self.headings.append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "style":
            return
        if "h2" in self.open:
            self.headings[-1] += data
        self.text += data + " "


@pytest.fixture(scope="module")
def document() -> str:
    return calibration_report(report_input(joints=None))


@pytest.fixture(scope="module")
def outline(document: str) -> Outline:
    return Outline(document)


def test_report_has_every_section(outline: Outline) -> None:
    assert outline.headings == [
        "How accurate the model is",
        "Remaining error, joint by joint",
        "Where it was measured",
        "What was corrected",
        "Fixes set aside",
        "Station set-ups",
        "Where this comes from",
    ]


@pytest.mark.parametrize(
    ("corrections", "words"),
    [
        ([1.0, 0.5], "None of them is larger than 2 build tolerances."),
        ([3.0, 0.5], "1 is larger than 2 build tolerances; by chance, one in 20 is. None is larger than 4."),
        (
            [9.0, 3.0],
            "2 are larger than 2 build tolerances; by chance, one in 20 is. 1 is larger than 4, which building",
        ),
    ],
)
def test_the_number_of_large_corrections_is_a_plain_sentence(corrections: list[float], words: str) -> None:
    lines = [ParameterLine(f"row{n}.a", "mm", size, 0.1, 1.0, True) for n, size in enumerate(corrections, 1)]
    assert words in calibration_report(report_input(n=4, parameters=lines))


def test_named_effects_have_a_section_with_their_sizes() -> None:
    effect = EffectLine(
        "joint_compliance",
        "theta4",
        0.071,
        "deg",
        [("compliance", 0.0052, 0.0004, "mrad/(kN m)"), ("bend1", -0.12, 0.3, "mrad"), ("bend2", 0.0, 0.4, "mrad")],
    )
    outline = Outline(calibration_report(report_input(effects=[effect], effects_reason="the data ask for it")))
    assert "Named effects" in outline.headings
    for words in (
        "the data ask for it.",
        "joint compliance",
        "0.071 degrees",
        "+0.005 milliradians per kilonewton metre",
        "and 1 more",
    ):
        assert words in outline.text


def test_the_features_of_trees_are_shown_by_their_importance() -> None:
    shares = [("prism_x_mm", 0.4), *((f"valve{k}_mA", 0.05) for k in range(12))]
    outline = Outline(calibration_report(report_input(importance=shares)))
    assert "Features of the learned residual" in outline.headings
    assert "The 10 most important of the 13 features of the trees." in outline.text
    assert len(outline.pictures) == 7
    drawing = base64.b64decode(outline.pictures[-2]["src"].partition("base64,")[2], validate=True)
    assert b"<svg" in drawing[:1000]


def test_report_is_one_file_that_loads_nothing(document: str, outline: Outline) -> None:
    assert outline.references
    assert all(reference.startswith("data:image/") for reference in outline.references)
    assert not re.search(r"https?://|@import|url\(|<script|<link", document)


def test_pictures_are_drawings_with_a_description(outline: Outline) -> None:
    assert len(outline.pictures) == 6
    for picture in outline.pictures:
        assert picture["alt"]
        drawing = base64.b64decode(picture["src"].partition("base64,")[2], validate=True)
        assert b"<svg" in drawing[:1000]
        assert drawing.rstrip().endswith(b"</svg>")


def test_headline_gives_error_before_and_after_on_held_out_fixes() -> None:
    report = report_input()
    assert report.held_out is not None
    before = number(report.held_out.stage("nominal").rms_mm)
    after = number(report.held_out.stage("hybrid").rms_mm)
    assert headline(report) == f"On 24 held-out fixes, the position error falls from {before} mm to {after} mm."


def test_headline_says_when_the_error_does_not_fall() -> None:
    report = report_input()
    table = report.training
    worse = {**table.errors_mm, "hybrid": table.errors_mm["nominal"] * 2}
    worse_table = ErrorTable(table.prism, table.joints, table.position_mm, worse)
    assert "does not fall" in headline(report_input(training=worse_table, held_out=False))


def test_stage_table_shows_the_spread_of_the_held_out_errors(outline: Outline) -> None:
    held_out = report_input().held_out
    assert held_out is not None
    s = held_out.stage("geometric")
    row = ["Geometric: true lengths and angles", *(number(v) for v in (s.mean_mm, s.rms_mm, s.max_mm, s.std_mm))]
    assert " ".join(row) in outline.text


def test_spread_is_of_the_norms_of_all_rows() -> None:
    s = spread(np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 1.0]]))
    assert (s.n, s.mean_mm, s.max_mm, s.std_mm) == (2, 3.0, 5.0, 2.0)
    assert s.rms_mm == pytest.approx(np.sqrt(13.0))


def test_text_says_what_an_operator_must_know(outline: Outline) -> None:
    for text in (
        "Joint L2 moved over less than a tenth of its range.",
        "Station set-up 'north face' moved",
        "The data determine 54 of 56 parameters",
        "row 9, zero angle with prism s, offset along x",
        "beyond building: check the drawing",  # row1.alpha, 4.5 tolerances
        "1 of 60 fixes (1.7 %) did not agree",
        "operator_note",
        "2026-11-21 14:03 UTC",
        "+0.30, \N{MINUS SIGN}0.40, 0 0.50",  # a misclosure and its size
    ):
        assert text in outline.text


def test_report_without_held_out_fixes_says_it_is_about_the_fitted_ones() -> None:
    outline = Outline(calibration_report(report_input("ur10", held_out=False, learned=False, setups=[])))
    assert "On the 60 fixes it was fitted to" in outline.text
    assert "not the accuracy to expect" in outline.text
    assert "Learned residual: none helps on held-out groups." in outline.text
    assert "Station set-ups" not in outline.headings


@pytest.mark.long
@pytest.mark.parametrize("fixes", [1, 2, 9])
def test_report_is_made_of_very_few_fixes(fixes: int) -> None:
    report = report_input(n=fixes, held_out=False, parameters=[], outliers=[], warnings=[], unidentifiable=[], rank=56)
    outline = Outline(calibration_report(report))
    assert "The data determine all 56 parameters" in outline.text
    assert "None: every fix was used." in outline.text


def test_report_is_made_where_a_model_fits_exactly_and_a_joint_stood_still() -> None:
    table = report_input().training
    exact = ErrorTable(
        table.prism,
        {name: np.full(len(table), 1.0) for name in table.joints},
        table.position_mm,
        {stage: np.zeros((len(table), 3)) for stage in table.errors_mm},
    )
    document = calibration_report(report_input(training=exact, held_out=False, noise_mm=0.0, instrument_mm=0.0))
    assert "from 0&nbsp;mm to 0&nbsp;mm" in document


@pytest.mark.long
def test_report_is_the_same_bytes_for_the_same_input(document: str) -> None:
    assert calibration_report(report_input(joints=None)) == document


def test_names_from_files_cannot_inject_markup() -> None:
    document = calibration_report(
        report_input(n=4, held_out=False, warnings=["<script>alert(1)</script>"], rig='"><b>')
    )
    assert "<script" not in document
    assert "<b>" not in document
    assert "&lt;script&gt;" in document


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (3.14159, "3.14"), (-12.345, "\N{MINUS SIGN}12.3"), (1234.5, "1234"), (0.01234, "0.012"),
     (0.000123, "0.000123"),
     (float("nan"), "\N{EN DASH}"), (float("inf"), "\N{EN DASH}")],
)  # fmt: skip
def test_numbers_have_three_digits_and_no_exponent(value: float, text: str) -> None:
    assert number(value) == text


def test_signed_numbers_show_their_plus() -> None:
    assert (signed(0.5), signed(-0.5), signed(0.0)) == ("+0.500", "\N{MINUS SIGN}0.500", "0")
