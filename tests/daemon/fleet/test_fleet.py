"""A fleet: every rig assessed, here or on workers that die, resumed, compared, and told as a page and a table."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from click.testing import CliRunner
from distributed import Client

from calibration.errors import DataError
from daemon.cli.main import main
from daemon.fleet.assess import FleetSettings, RigTask, assess
from daemon.fleet.comparison import compare, gains
from daemon.fleet.run import RESULTS, Cluster, Here, assess_all, local_workers
from daemon.fleet.sources import find_rigs
from daemon.store import Store
from daemon.store.queries.observations import ObservationTable
from daemon.store.queries.sessions import SessionTable
from tests.daemon.support.store import at
from tests.simulated.fleet import COMMON, ODD, drawing, simulated_rig, write_rig

RIGS, ODD_EVERY = 12, 12
SETTINGS = FleetSettings(gap=False)


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve rigs of 100 fixes in two sessions; the last is not as the others."""
    path = tmp_path_factory.mktemp("fleet")
    for number in range(RIGS):
        write_rig(path, simulated_rig(number, 100, sessions=2, odd_every=ODD_EVERY))
    return path


@pytest.fixture(scope="module")
def answers(directory: Path, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """The answers of this process."""
    out = tmp_path_factory.mktemp("here")
    return assess_all(find_rigs(sorted(directory.iterdir()), None, None), SETTINGS, out, Here(), lambda *_: None)


@pytest.fixture
def client() -> Iterator[Client]:
    with local_workers(2) as client:
        yield client


@pytest.mark.long
def test_what_rigs_have_in_common_and_who_differs(answers: list[dict[str, Any]]) -> None:
    (group,) = compare(answers).groups
    (shared,) = (quantity for quantity in group.common if quantity.name == COMMON)
    assert abs(shared.fleet.mean - 12.0) < 4 * shared.fleet.mean_sigma
    odd = [number for number in range(RIGS) if any(q.name == ODD for q in group.outlying(number))]
    assert odd == [RIGS - 1]
    assert any(gain.action == "look" and ODD in gain.text for gain in gains(group, RIGS - 1))
    assert gains(group, 0)[0].action == "calibrate"


@pytest.mark.long
def test_rigs_that_stayed_as_they_were_have_not_drifted(answers: list[dict[str, Any]]) -> None:
    drifts = [answer["drift"] for answer in answers]
    assert {drift["session"] for drift in drifts} == {"s2"}
    assert sum(drift["alarm"] == "worse" for drift in drifts) <= 1


def test_a_rig_that_has_changed_is_told(tmp_path: Path) -> None:
    rig = simulated_rig(0, 120, sessions=2, change_mm=15.0)
    found = assess(RigTask("changed", str(tmp_path), rig.rig_text, rig.csv, None, SETTINGS))
    assert "error" not in found, found
    assert found["drift"]["alarm"] == "worse"


@pytest.mark.long
def test_workers_that_die_lose_nothing(
    directory: Path, answers: list[dict[str, Any]], client: Client, tmp_path: Path
) -> None:
    killed: list[int] = []

    def kill(done: int, of: int, name: str) -> None:
        if done % 4 == 0 and done < of:
            pid = min(client.run(os.getpid, on_error="ignore").values())
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)

    found = assess_all(find_rigs(sorted(directory.iterdir()), None, None), SETTINGS, tmp_path, Cluster(client), kill)
    assert found == answers
    assert len(set(killed)) == 2
    assert len(list((tmp_path / RESULTS).iterdir())) == RIGS


@pytest.mark.long
def test_a_run_goes_on_with_what_is_not_done(directory: Path, answers: list[dict[str, Any]], tmp_path: Path) -> None:
    sources = find_rigs(sorted(directory.iterdir()), None, None)[:3]

    class InterruptedRunError(Exception):
        pass

    def stop(done: int, of: int, name: str) -> None:
        if done == 2:
            raise InterruptedRunError

    with pytest.raises(InterruptedRunError):
        assess_all(sources, SETTINGS, tmp_path, Here(), stop)

    class Counted(Here):
        asked: list[str]

        def answers(self, tasks: Iterator[RigTask]) -> Iterator[dict[str, Any]]:
            self.asked = []
            for task in tasks:
                self.asked.append(task.name)
                yield assess(task)

    engine = Counted()
    assert assess_all(sources, SETTINGS, tmp_path, engine, lambda *_: None) == answers[:3]
    assert engine.asked == [sources[2].name]
    assess_all(sources, FleetSettings(gap=False, seed=1), tmp_path, engine, lambda *_: None)
    assert len(engine.asked) == 3  # other settings are other answers


def store_of(path: Path, csv: bytes, rig_text: str) -> None:
    """A daemon's store with one session of these observations."""
    header, *rows = csv.decode().splitlines()
    names = header.split(",")
    with contextlib.closing(Store(path)) as store:
        table, observations = SessionTable(store, "swdt82"), ObservationTable(store)
        table.start(at(0.0), rig_text, id="s001", prism="r", operator="", kind="static_poses")
        for number, row in enumerate(rows):
            cells = dict(zip(names, row.split(","), strict=True))
            values = {name: float(cells[name]) for name in names if name.endswith(("_deg", "_mm")) and name[1] != "_"}
            place = {name: float(cells[name]) for name in ("x_mm", "y_mm", "z_mm")}
            about = {"session_id": "s001", "prism": cells["prism"], "pose": cells["pose"], "moving": 0}
            observations.add(None, at(float(number)), **about, **place, values_json=values)
        table.change("s001", state="closed", **store.instant(at(1000.0), "ended_"))


@pytest.mark.long
def test_the_command_writes_a_page_and_a_table(directory: Path, tmp_path: Path) -> None:
    rig = simulated_rig(20, 100, odd_every=ODD_EVERY)
    (tmp_path / "rig20").mkdir()
    store_of(tmp_path / "rig20" / "rigcal.sqlite", rig.csv, drawing())
    bad = tmp_path / "bad"
    bad.mkdir()
    (bad / "observations.csv").write_text("prism,x_mm\nr,1\n")
    rigs = [str(path) for path in sorted(directory.iterdir())[:6]]
    out = tmp_path / "out"
    arguments = ["fleet", *rigs, str(bad), "--stores", str(tmp_path / "*" / "rigcal.sqlite"), "--rig", "swdt82"]
    result = CliRunner().invoke(main, [*arguments, "--no-gap", "--out", str(out), "--json"])
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert (told["rigs"], list(told["failed"])) == (7, ["bad"])
    assert "column missing" in told["failed"]["bad"]
    page = (out / "fleet.html").read_text()
    assert "Comparison of 7 rigs" in page
    assert "http" not in page.replace("http://www.w3.org", "")
    table = pd.read_parquet(told["table"])
    assert set(table["rig_name"]) >= {"rig0000", "rig20"}
    noise = table[(table["quantity"] == "noise") & (table["rig_name"] == "rig20")]["value"]
    assert 1.0 < float(noise.iloc[0]) < 4.0


@pytest.mark.slow
def test_a_fleet_with_the_gap_workflow(directory: Path) -> None:
    (source,) = find_rigs([directory / "rig0000"], None, None)
    found = assess(source.task(FleetSettings(gap=True)))
    assert found["verdict"] == "none"
    assert found["effects"] == []


def test_a_rig_without_data_is_listed_and_a_bad_line_has_its_file(tmp_path: Path) -> None:
    rig = simulated_rig(0, 30, sessions=1)
    for name in ("bad", "empty"):
        (tmp_path / name).mkdir()
    (tmp_path / "bad/rig.toml").write_text(rig.rig_text)
    header, *lines = rig.csv.decode().splitlines()
    (tmp_path / "bad/a.csv").write_text("\n".join([header, *lines[:10]]))
    wrong = [line.replace(".", "x", 1) if n == 3 else line for n, line in enumerate(lines[10:])]
    (tmp_path / "bad/b.csv").write_text("\n".join([header, *wrong]) + "\n")
    sources = find_rigs([tmp_path / "bad", tmp_path / "empty"], None, None)
    bad, empty = assess_all(sources, SETTINGS, tmp_path / "out", Here(), lambda *_: None)
    assert bad["error"].startswith("b.csv, line 5, column ")
    assert empty["error"].endswith("contains neither a rigcal.sqlite nor CSV files of observations")


def test_a_fault_of_the_program_at_one_rig_does_not_end_the_others(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails_at_the_first(task: RigTask) -> dict[str, Any]:
        if task.name == "rig0000":
            raise ZeroDivisionError("of the program")
        return {"name": task.name}

    monkeypatch.setattr("daemon.fleet.run.assess", fails_at_the_first)
    sources = find_rigs([directory / "rig0000", directory / "rig0001"], None, None)
    first, second = assess_all(sources, SETTINGS, tmp_path, Here(), lambda *_: None)
    assert (first["kind"], second) == ("ZeroDivisionError", {"name": "rig0001"})


def test_wrong_places_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"neither a rigcal\.sqlite nor CSV files"):
        find_rigs([tmp_path], None, None)
    with pytest.raises(DataError, match="matches no store"):
        find_rigs([], str(tmp_path / "*.sqlite"), None)
    (tmp_path / "a.csv").write_text("prism\n")
    with pytest.raises(DataError, match="the same rig is given twice"):
        find_rigs([tmp_path, tmp_path], None, None)
