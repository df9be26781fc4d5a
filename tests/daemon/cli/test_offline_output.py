from __future__ import annotations

import json
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner

from calibration.errors import CalibrationError, DataError, ModelError, RigError, UnsafeError
from calibration.rig.description import shipped_rig
from daemon.cli.command import Command, json_option, progress_display
from daemon.cli.offline import read_observations
from daemon.host.safe_output import write_file
from daemon.rig_files import load_rig


@click.command(cls=Command)
@click.option("--number", type=int, default=1)
@click.pass_context
@json_option
def probe(ctx: click.Context, number: int, *, as_json: bool) -> dict[str, Any]:
    """A command that prints, then does what the test asks."""
    print("a library talks")
    if ctx.obj is not None:
        raise ctx.obj
    return {"number": number, "nothing": float("nan"), "list": (1.5, float("inf"))}


ENDINGS = [
    (RigError("boom.toml", "joint.1", "no such key"), 2, "boom.toml: joint.1: no such key"),
    (DataError("a.csv", "empty", 3, "x_mm"), 2, "a.csv, line 3, column x_mm: empty"),
    (ModelError("m is truncated"), 2, "m is truncated"),
    (UnsafeError("not identifiable"), 3, "not identifiable"),
    (CalibrationError("no optimum"), 1, "no optimum"),
    (FileNotFoundError(2, "No such file or directory", "x.csv"), 1, "x.csv: No such file or directory"),
    (KeyError("x"), 1, "internal error, KeyError: 'x' (RIGCAL_DEBUG=1 adds a traceback)"),
]


@pytest.mark.parametrize(("error", "status", "sentence"), ENDINGS, ids=lambda value: type(value).__name__)
def test_failure_ends_in_one_sentence_and_its_status(error: Exception, status: int, sentence: str) -> None:
    result = CliRunner().invoke(probe, [], obj=error)
    assert result.exit_code == status
    assert result.stderr == f"Error: {sentence}\n"


@pytest.mark.parametrize(("error", "status", "sentence"), ENDINGS, ids=lambda value: type(value).__name__)
def test_failure_in_json_is_one_object_on_standard_output(error: Exception, status: int, sentence: str) -> None:
    result = CliRunner().invoke(probe, ["--json"], obj=error)
    assert result.exit_code == status
    assert json.loads(result.stdout) == {"error": sentence, "kind": type(error).__name__}
    assert sentence in result.stderr


def test_wrong_use_in_json_is_an_object_as_well() -> None:
    result = CliRunner().invoke(probe, ["--json", "--number", "many"])
    assert result.exit_code == 2
    answer = json.loads(result.stdout)
    assert answer["kind"] == "BadParameter"
    assert "'many' is not a valid integer" in answer["error"]


def test_json_is_alone_on_standard_output_and_knows_no_nan() -> None:
    result = CliRunner().invoke(probe, ["--json", "--number", "7"])
    assert result.exit_code == 0
    assert json.loads(result.stdout) == {"number": 7, "nothing": None, "list": [1.5, None]}
    assert result.stderr == "a library talks\n"


def test_long_work_tells_on_standard_error_what_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    told = threading.Event()

    def echo(text: str, *, err: bool) -> None:
        assert err, "standard output is for the result"
        said.append(text)
        if "fitting" in text:
            told.set()

    monkeypatch.setattr("daemon.cli.command.LINE_S", 0.01)
    monkeypatch.setattr("daemon.cli.terminal.click.echo", echo)
    with progress_display(as_json=True) as progress:
        progress(0.5, "fitting")
        assert told.wait(60.0)
    assert said[-1].endswith("s: fitting (50 %)")


def test_traceback_is_shown_only_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "Traceback" not in CliRunner().invoke(probe, [], obj=KeyError("x")).stderr
    monkeypatch.setenv("RIGCAL_DEBUG", "1")
    assert "Traceback" in CliRunner().invoke(probe, [], obj=KeyError("x")).stderr


def test_a_shipped_rig_is_found_by_name_with_its_files() -> None:
    source = load_rig("swdt82")
    assert source.rig == shipped_rig("swdt82")
    assert (source.directory / "machine.dbc").is_file()
    assert 'name = "swdt82"' in source.text


def test_a_rig_file_is_found_by_path(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(load_rig("ur10").text.replace('name = "ur10"', 'name = "own"'), encoding="utf-8")
    source = load_rig(str(path))
    assert (source.rig.name, source.directory) == ("own", tmp_path)


def test_an_unknown_rig_is_refused_with_what_there_is() -> None:
    with pytest.raises(RigError, match=r"nowhere: neither a shipped rig \(swdt82, ur10, ys100\) nor a rig file"):
        load_rig("nowhere")


def test_a_rig_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RigError, match="not UTF-8 text"):
        load_rig(str(path))


def test_observations_come_with_their_bytes() -> None:
    path = Path(__file__).parents[2] / "data" / "ur10_iso_cubes.csv"
    observations, data = read_observations(path, shipped_rig("ur10"))
    assert data == path.read_bytes()
    assert np.isfinite(observations.position_mm).all()


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    write_file(path, b"first")
    write_file(path, b"second")
    assert path.read_bytes() == b"second"
    (tmp_path / "directory").mkdir()
    with pytest.raises(OSError, match="is not a regular file"):
        write_file(tmp_path / "directory", b"x")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["directory", "out.csv"]


def test_calibrations_start_without_what_they_may_not_need() -> None:
    code = (
        "import sys, calibration.pipeline.calibrate\n"
        "print([m for m in ('matplotlib', 'lightgbm', 'scipy.stats') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["[]"]
