"""A session as tables for other programs, read again with the libraries that such programs use."""

from __future__ import annotations

import contextlib
import json
import threading
from importlib import resources
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from scipy.io import loadmat

from calibration.observations import Observations
from calibration.rig.description import shipped_rig
from daemon.cli.main import main
from daemon.store import Store
from daemon.store.queries.observations import ObservationTable
from daemon.store.queries.sessions import SessionTable
from drivers.readings import SerialCapture
from tests.daemon.support.store import at, fix, reading

CONFIG = 'rig = "swdt82"\nstate_directory = "."\n[[can]]\nchannel = "can0"\n[[station]]\nserial.path = "/dev/station"\n'
RIG = shipped_rig("swdt82")
JOINTS = {joint.column: 10.0 + n for n, joint in enumerate(RIG.joints)}


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration whose store has a session of two observations, 30 readings of a joint and two fixes."""
    directory = tmp_path_factory.mktemp("state")
    path = directory / "rig.toml"
    path.write_text(CONFIG)
    text = resources.files("calibration").joinpath("rigs", "swdt82.toml").read_text()
    with contextlib.closing(Store(directory / "rigcal.sqlite")) as store:
        store.declare_channels({joint.name: joint.unit for joint in RIG.joints}, {})
        store.insert("links", {"name": "station", "kind": "serial"})
        store.insert_records([reading("theta1", n / 10, float(n)) for n in range(-10, 50)])
        store.insert_records([fix(n, station="station") for n in (-1.0, 1.0, 2.0)])
        table, observations = SessionTable(store, "swdt82"), ObservationTable(store)
        table.start(at(0.0), text, id="s001-r", prism="r", operator="", kind="static_poses")
        for n in (1, 2):
            place = {"x_mm": 100.0 * n, "y_mm": 2.0, "z_mm": 3.0, "moving": 0, "values_json": JOINTS}
            observations.add(n + 1, at(n), session_id="s001-r", prism="r", pose=f"1.{n}", **place)
        table.change("s001-r", state="closed", **store.instant(at(2.95), "ended_"))
    return path


def export(config: Path, out: Path, form: str) -> list[Path]:
    arguments = ["session", "export", "s001-r", "--config", str(config), "--out", str(out), "--format", form, "--json"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    return [Path(file) for file in json.loads(result.stdout)["files"]]


def test_csv(config: Path, tmp_path: Path) -> None:
    observations, joints, fixes = export(config, tmp_path, "csv")
    assert [path.name for path in (observations, joints, fixes)] == [
        "s001-r.csv",
        "s001-r-joints.csv",
        "s001-r-fixes.csv",
    ]
    table = Observations.from_csv(observations, RIG)
    assert table.position_mm[:, 0].tolist() == [100.0, 200.0]
    assert pd.read_csv(joints)["theta1_deg"].tolist() == [float(n) for n in range(30)]
    assert pd.to_datetime(pd.read_csv(fixes)["time"]).dt.second.tolist() == [21, 22]


def test_parquet(config: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    observations, joints, fixes = map(pd.read_parquet, export(config, tmp_path, "parquet"))
    assert observations["L2_mm"].tolist() == [JOINTS["L2_mm"]] * 2
    assert observations["pose"].tolist() == ["1.1", "1.2"]
    assert (joints["theta1_deg"].sum(), str(joints["L2_mm"].dtype)) == (435.0, "float64")
    assert fixes["slope_distance_m"].tolist() == [11.7845, 11.7845]


def test_mat(config: Path, tmp_path: Path) -> None:
    (path,) = export(config, tmp_path, "mat")
    found = loadmat(path, simplify_cells=True)
    assert found["observations"]["x_mm"].tolist() == [100.0, 200.0]
    assert found["joints"]["theta1_deg"].tolist() == [float(n) for n in range(30)]
    assert np.isnan(found["joints"]["L2_mm"]).all()
    assert found["joints"]["time"][0] == "2023-11-14T22:13:20.000000Z"


def test_candump(config: Path, tmp_path: Path) -> None:
    assert "s001-r.json" in {path.name for path in export(config, tmp_path, "candump")}


@pytest.mark.parametrize("form", ["csv", "mat"])
def test_an_unknown_session_is_refused(config: Path, tmp_path: Path, form: str) -> None:
    arguments = ["session", "export", "no", "--config", str(config), "--out", str(tmp_path), "--format", form]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code != 0
    assert "no session 'no'" in result.stderr


def test_a_session_whose_captures_wait_to_be_decoded_is_not_exported_in_part(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daemon.sessions.export.captured_logs.JOINED_WITHIN_S", 0.2)
    with contextlib.closing(Store(config.with_name("rigcal.sqlite"))) as store:
        ids = store.append_captures([SerialCapture("station", at(2.5), b"Q+0")])
        command = ["session", "export", "s001-r", "--config", str(config), "--out", str(tmp_path / "out")]
        for form in ("csv", "log"):
            result = CliRunner().invoke(main, [*command, "--format", form])
            assert (result.exit_code, list(tmp_path.iterdir())) == (2, [])
            assert "captures of session 's001-r' wait to be decoded" in result.stderr
        store.mark_decoded(ids)
    assert len(export(config, tmp_path, "csv")) == 3


def test_a_session_that_was_just_stopped_is_exported_with_the_observations_that_still_come(
    config: Path, tmp_path: Path
) -> None:
    with contextlib.closing(Store(config.with_name("rigcal.sqlite"))) as store:
        store.begin_run(at(-5.0))
        exported: list[Path] = []
        exporting = threading.Thread(target=lambda: exported.extend(export(config, tmp_path, "csv")))
        exporting.start()
        place = {"x_mm": 300.0, "y_mm": 2.0, "z_mm": 3.0, "moving": 0, "values_json": JOINTS}
        ObservationTable(store).add(None, at(2.9), session_id="s001-r", prism="r", pose="1.3", **place)
        store.mark_decoded(store.append_captures([SerialCapture("station", at(5.0), b"Q+0")]))
        exporting.join()
        store.end_run(at(6.0))
    assert Observations.from_csv(exported[0], RIG).position_mm[:, 0].tolist() == [100.0, 200.0, 300.0]


def test_a_session_without_a_row_says_that_there_is_no_table(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(CONFIG)
    text = resources.files("calibration").joinpath("rigs", "swdt82.toml").read_text()
    with contextlib.closing(Store(tmp_path / "rigcal.sqlite")) as store:
        table = SessionTable(store, "swdt82")
        table.start(at(0.0), text, id="s001-r", prism="r", operator="", kind="static_poses")
        table.change("s001-r", state="closed", **store.instant(at(1.0), "ended_"))
    options = ["--config", str(path), "--out", str(tmp_path / "out"), "--format", "csv"]
    result = CliRunner().invoke(main, ["session", "export", "s001-r", *options])
    assert (result.exit_code, result.output) == (0, "session s001-r has no rows, so no table was written\n")
