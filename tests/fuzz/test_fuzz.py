"""Every target on its whole corpus and a few changes of it; the runner on faulty targets. `make fuzz` runs more."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from tests.fuzz.child import an_input
from tests.fuzz.measured import Measured
from tests.fuzz.runner import Report, run_target
from tests.fuzz.target import CORPUS, find_targets

CHANGES = 200
ENOUGH_S = 2.0  # of the processor's time for a target's changes, once there were a few
FEW = 20
SLOW_S = 5.0
TARGETS = find_targets()


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", TARGETS)
def test_whatever_comes_a_target_returns(name: str) -> None:
    target = TARGETS[name]
    corpus = target.corpus()
    assert corpus, f"{name} has no corpus; make it with python -m tests.fuzz.seeds {name}"
    run = target.prepare()
    try:
        run(an_input(target, corpus, 1, 0))  # which may compile kernels, once on this computer
        started_s = time.process_time()
        for number in range(len(corpus) + CHANGES):
            if number >= len(corpus) + FEW and time.process_time() - started_s > ENOUGH_S:
                break
            began_s = time.process_time()
            run(an_input(target, corpus, 1, number))
            assert time.process_time() - began_s < SLOW_S, f"input {number} took too long"
    finally:
        getattr(run, "close", lambda: None)()


def test_every_corpus_has_its_target() -> None:
    assert {path.name for path in CORPUS.iterdir()} == set(TARGETS)


def test_an_input_is_the_same_for_the_same_seed() -> None:
    target = TARGETS["rig"]
    corpus = target.corpus()
    assert [an_input(target, corpus, 7, n) for n in range(50)] == [an_input(target, corpus, 7, n) for n in range(50)]
    assert an_input(target, corpus, 7, 40) != an_input(target, corpus, 8, 40)


@pytest.mark.parametrize(
    ("name", "faults", "deaths"),
    [
        ("raising", {"IndexError at faulty.py": 3}, {}),
        ("dying", {}, {"ended with status -11": 3}),
        ("hungry", {"MemoryError at faulty.py": 3}, {}),
        ("sound", {}, {}),
    ],
)
def test_the_runner_notices_and_keeps_what_finds_a_fault(
    tmp_path: Path, name: str, faults: dict[str, int], deaths: dict[str, int]
) -> None:
    module = "tests.fuzz.faulty"
    target = find_targets(module)[name]
    report = run_target(target, tmp_path, inputs=3, seconds=60, module=module)
    found = {place.rpartition(":")[0]: count for place, count in report.faults.items()}
    assert (report.inputs, found, dict(report.deaths), report.hangs) == (3, faults, deaths, 0)
    assert report.is_clean is (name == "sound")
    kept = [path for path in tmp_path.glob("*") if path.suffix != ".txt"]
    assert bool(kept) is not report.is_clean


def test_the_runner_ends_a_target_that_hangs_and_goes_on(tmp_path: Path) -> None:
    module = "tests.fuzz.faulty"
    report = run_target(find_targets(module)["hanging"], tmp_path, inputs=2, seconds=60, module=module, hang_s=0.3)
    assert (report.inputs, report.crashes, report.hangs) == (2, 0, 2)
    assert "took longer than 0.3 s" in next(tmp_path.glob("*.txt")).read_text()


def test_a_run_goes_on_with_what_was_measured_in_this_state_with_this_seed(tmp_path: Path) -> None:
    module, file = "tests.fuzz.faulty", tmp_path / "measured.json"
    target = find_targets(module)["sound"]
    measured = Measured(1, file)
    assert measured.report(target) == Report("sound")
    first = run_target(
        target, tmp_path, inputs=3, seconds=60, module=module, each=lambda report: measured.note(target, report)
    )
    assert first.inputs == 3
    assert Measured(2, file).report(target).inputs == 0
    kept = Measured(1, file).report(target)
    assert kept.inputs == 3
    assert run_target(target, tmp_path, inputs=5, seconds=60, module=module, report=kept).inputs == 5
    file.write_text(file.read_text().replace(measured.state(target), "of other sources"))
    assert Measured(1, file).report(target).inputs == 0


def test_a_target_in_which_a_fault_was_found_counts_as_not_measured(tmp_path: Path) -> None:
    module, file = "tests.fuzz.faulty", tmp_path / "measured.json"
    target = find_targets(module)["raising"]
    measured = Measured(1, file)
    assert measured.report(target).inputs == 0
    measured.note(target, run_target(target, tmp_path, inputs=3, seconds=60, module=module))
    assert measured.report(target).inputs == 0


def test_the_state_of_a_target_is_that_of_the_sources_that_it_runs() -> None:
    measured = Measured(1)
    assert measured.state(TARGETS["eds"]) == measured.state(TARGETS["dbc"])
    assert measured.state(TARGETS["eds"]) != measured.state(TARGETS["model"])
