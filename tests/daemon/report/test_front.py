"""The first lines of every report, its verdict, its words, and its print."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from daemon.cli.main import main
from daemon.report.calibration.page import calibration_report
from daemon.report.front import Facts, judge
from daemon.report.gap.page import gap_report
from daemon.report.pdf import HOW_TO_INSTALL
from daemon.report.plain_names import coefficient_words, constant_words, in_words, unit_words
from tests.daemon.support import gap as gap_support
from tests.daemon.support.report_inputs import report_input

LABELS = ["Rig", "Model", "Sessions", "Operator", "Instrument", "Station set-up", "UTC", "Software"]
FACTS = Facts(
    "swdt82",
    "00002-hybrid",
    ("s001-r", "s002-b"),
    ("Ada", "Ada"),
    ("GTS-905A",),
    ("S1",),
    (1_700_000_000_000_000_000, 1_700_003_600_000_000_000),
    1_700_007_200_000_000_000,
    10.0,
)


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return {
        "calibration": calibration_report(report_input(facts=FACTS)),
        "gap": gap_report(gap_support.named(), {"data": "x.csv"}, FACTS),
    }


@pytest.mark.parametrize("name", ["calibration", "gap"])
def test_the_first_lines_say_what_the_report_is_of(pages: dict[str, str], name: str) -> None:
    page = pages[name]
    head = page[page.index("<h1>") : page.index('class="headline"')]
    assert re.findall(r'<th scope="row">([^<]*)</th>', head) == LABELS
    assert "measured 2023-11-14 22:13 UTC to 2023-11-14 23:13 UTC; report made 2023-11-15 00:13 UTC" in head
    assert head.count("Ada") == 1
    assert 'class="verdict passed"' in head
    assert page.index("Checked by") > page.index("Where this comes from")


def test_reports_of_a_simulated_rig_say_so_in_their_head() -> None:
    facts = replace(FACTS, is_simulated=True)
    for page in (calibration_report(report_input(n=4, facts=facts)), gap_report(gap_support.named(), {}, facts)):
        head = page[page.index("<h1>") : page.index('class="headline"')]
        assert re.findall(r'<th scope="row">([^<]*)</th>', head) == [LABELS[0], "Simulated", *LABELS[1:]]
        assert "measured on a simulated rig, in simulated time" in head


def test_what_nobody_has_said_is_not_given_and_no_tolerance_is_assumed() -> None:
    page = calibration_report(report_input(n=4))
    assert page.count("<td>not given</td>") == 6
    assert "Tolerance: no tolerance stated." in page
    assert not re.search(r'class="verdict (passed|failed)', page)


@pytest.mark.parametrize(
    ("tolerance_mm", "rms_mm", "is_held_out", "outcome"),
    [
        (10.0, 10.0, True, "passed"),
        (10.0, 10.1, True, "failed"),
        (10.0, 3.0, False, "not judged"),
        (10.0, 10.1, False, "failed"),
        (10.0, float("nan"), True, "failed"),
    ],
)
def test_only_fixes_that_the_model_has_not_seen_can_pass(
    tolerance_mm: float, rms_mm: float, is_held_out: bool, outcome: str
) -> None:
    verdict = judge(tolerance_mm, rms_mm, is_held_out=is_held_out, rows="on 9 fixes")
    assert verdict is not None
    assert verdict.outcome == outcome
    assert verdict.as_dict()["verdict"] == outcome
    assert judge(None, rms_mm, is_held_out=is_held_out, rows="") is None


def test_names_of_the_code_are_words_and_names_of_columns_stay() -> None:
    assert constant_words("row4.theta") == "row 4, zero angle"
    assert constant_words("prism.r.x") == "prism r, offset along x"
    assert constant_words("base[S1].rz") == "base at set-up S1, turn about z"
    assert unit_words("mrad/(kN m)") == "milliradians per kilonewton metre"
    assert coefficient_words("width_rad") == "width"
    assert in_words("the data ask for joint_compliance@theta4; rbfn helps; give theta4_dir and dwell_s") == (
        "the data ask for joint compliance at theta4; radial basis function network helps; give theta4_dir and dwell_s"
    )


def test_no_code_name_is_left_in_a_report(pages: dict[str, str]) -> None:
    for name, page in pages.items():
        text = re.sub(r"<style>.*?</style>|<[^>]*>", " ", page, flags=re.DOTALL)
        found = re.findall(r"row\d\.\w+|prism\.\w|\w+@\w+|\brbfn\b|\bmrad\b|\bdeg\b|joint_\w+|width_rad", text)
        assert not found, (name, found)


def test_pages_follow_a_dark_screen_and_stay_light_on_paper(pages: dict[str, str]) -> None:
    page = pages["calibration"]
    assert "@media screen and (prefers-color-scheme: dark)" in page
    assert "break-after: avoid" in page
    assert 'counter(page) " of " counter(pages)' in page


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:HarfBuzz-Subset:DeprecationWarning")  # what the computer has not yet
def test_a_report_is_printed_on_numbered_pages(pages: dict[str, str], tmp_path: Path) -> None:
    try:
        import weasyprint
    except OSError as error:
        pytest.skip(
            f"Pango is not installed, so nothing was printed; run: {HOW_TO_INSTALL.partition(' and ')[2]} ({error})"
        )
    del weasyprint
    (tmp_path / "report.html").write_text(pages["gap"], encoding="utf-8")
    made = CliRunner().invoke(main, ["report", "--model", str(tmp_path), "--pdf", str(tmp_path / "report.pdf")])
    assert made.exit_code == 0, made.output
    document = (tmp_path / "report.pdf").read_bytes()
    assert document.startswith(b"%PDF-")
    assert document.rstrip().endswith(b"%%EOF")


def test_without_weasyprint_one_sentence_says_what_to_install(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("<p>x</p>", encoding="utf-8")
    hidden = "import sys; sys.modules['weasyprint'] = None; from daemon.cli.main import main; main()"
    command = [sys.executable, "-c", hidden, "report", "--model", str(tmp_path), "--pdf", str(tmp_path / "x.pdf")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "pip install 'rigcal[pdf]'" in done.stderr
    assert not (tmp_path / "x.pdf").exists()


def test_a_directory_without_a_report_is_refused(tmp_path: Path) -> None:
    assert CliRunner().invoke(main, ["report", "--model", str(tmp_path)]).exit_code == 2
