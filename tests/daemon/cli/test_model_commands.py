"""`rigcal model export` and `rigcal tip` as a user has them, and when a daemon sends anything at all."""

import contextlib
import csv
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from calibration.model.prediction import Predictor
from calibration.rig.channels import RawSignal
from daemon.cli.main import main
from daemon.composition import decoders, live
from daemon.config.config import Config, ConfigError, parse_config
from daemon.control.server import ControlServer
from daemon.models.model_files import read_model, write_model
from daemon.rig_files import load_rig
from daemon.service import tip_sender
from drivers.can.tip_frames import TipMessage, TipStatus, encode_tip
from drivers.errors import TransmitForbiddenError
from tests.commands import run_apart
from tests.daemon.config.test_config import GOOD, check
from tests.daemon.support.models import SOURCE, ModelRig, written

TIP = """
[tip]
prism = "r"
[tip.can]
link = "boom"
arbitration_id = 0x680
"""
MAY_SEND = GOOD.replace('channel = "can0"', 'channel = "can0"\nallow_transmit = true')


# ---- export ----------------------------------------------------------------------------------------------------------


def test_an_exported_model_gives_the_models_corrections_without_rigcal(tmp_path: Path) -> None:
    model = written(30)
    command = ("model", "export", "--model", str(model), "--out", str(tmp_path / "x"), "--rows", "5000", "--json")
    done = CliRunner().invoke(main, [*command, "--prism", "r", "--prism", "s"])
    assert done.exit_code == 0, done.stderr
    told = json.loads(done.stdout)
    document = json.loads((tmp_path / "x" / "calibration.json").read_text(encoding="utf-8"))
    assert document["leaves_out"]["left_out"] == []
    assert document["rig"] == "swdt82"
    with (tmp_path / "x" / "corrections.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["prism"] == "s"]
    assert 2 * len(rows) == told["rows"]
    joints = [joint.column for joint in SOURCE.rig.joints]
    axes = [np.unique([float(row[name]) for row in rows]) for name in joints]
    table = np.array([[float(row[f"{a}_correction_mm"]) for a in "xyz"] for row in rows])
    table = table.reshape(*map(len, axes), 3)
    rng = np.random.default_rng(3)
    poses = np.array([rng.uniform(axis[0], axis[-1], 40) for axis in axes]).T
    interpolated = np.array([_multilinear(axes, table, pose) for pose in poses])
    off = np.linalg.norm(interpolated - _correction_mm(model, "s", poses), axis=1)
    size = np.linalg.norm(table.reshape(-1, 3), axis=1)
    assert np.sqrt((off**2).mean()) < 0.25 * np.sqrt((size**2).mean())
    assert off.max() < 2.0 * told["max_mm"]
    assert told["rms_mm"] <= 0.1 * told["correction_rms_mm"] or told["warnings"]


def test_a_grid_too_coarse_to_mend_much_is_exported_with_a_warning(tmp_path: Path) -> None:
    """A prism beside its place is the same correction in every pose, turned with the boom: straight lines miss it."""
    model = read_model(written(30))
    values = model.nominal_values.copy()
    values[model.chain.index("prism.r.x")] += 10.0
    write_model(tmp_path / "turned", replace(model, values=values))
    command = ("model", "export", "--model", str(tmp_path / "turned"), "--out", str(tmp_path / "x"), "--prism", "r")
    command = (*command, "--rows", "512")
    done = CliRunner().invoke(main, [*command, "--json"])
    assert done.exit_code == 0, done.stderr
    told = json.loads(done.stdout)
    grid = told["leaves_out"]["corrections.csv"]
    assert grid["rms_mm"] > 0.1 * grid["correction_rms_mm"]
    assert [text.partition(" mm RMS")[0] for text in told["warnings"]] == [
        f"between the nodes of corrections.csv, interpolated corrections have an error of {grid['rms_mm']:.2g}"
    ]
    assert f"Warning: {told['warnings'][0]}" in CliRunner().invoke(main, command).stderr


def test_exported_files_that_were_there_before_are_said_to_be_replaced(tmp_path: Path) -> None:
    out = tmp_path / "x"
    command = ("model", "export", "--model", str(written(30)), "--out", str(out))
    assert "replaced" not in CliRunner().invoke(main, [*command, "--format", "json"]).stdout
    both = CliRunner().invoke(main, [*command, "--format", "json", "--format", "c-header"]).stdout.splitlines()
    assert [line for line in both if line.startswith(str(out))] == [
        str(out / "rigcal_model.h"),
        f"{out / 'calibration.json'} (replaced)",
    ]


def _multilinear(axes: list[np.ndarray], table: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Linear in each joint value in turn, as a controller would do it."""
    for axis, value in zip(axes, pose, strict=True):
        i = min(max(int(np.searchsorted(axis, value)) - 1, 0), len(axis) - 2)
        share = (value - axis[i]) / (axis[i + 1] - axis[i])
        table = (1.0 - share) * table[i] + share * table[i + 1]
    return table


def _correction_mm(directory: Path, prism: str, poses: np.ndarray) -> np.ndarray:
    from calibration.observations import parse_observations

    model = read_model(directory)
    header = ",".join(["prism", "setup", *(joint.column for joint in SOURCE.rig.joints)])
    lines = [",".join([prism, "S1", *map(repr, map(float, pose))]) for pose in poses]
    data = "\n".join([header, *lines]).encode()
    rows = parse_observations(data, model.rig, "poses.csv", positions_required=False)
    true = model.chain.base(model.values, 0)
    drawn = model.chain.base(model.nominal_values, 0)
    corrected = (Predictor.of(model).predict(rows).position_mm - true.translation_mm) @ true.rotation
    return np.asarray(corrected - (Predictor.of(model).nominal_mm(rows) - drawn.translation_mm) @ drawn.rotation)


def test_an_export_that_cannot_be_made_is_refused_in_a_sentence(tmp_path: Path) -> None:
    model, out = str(written(30)), str(tmp_path / "x")
    for arguments, why in (
        (("--model", model, "--out", out, "--rows", "100"), "make 512 poses"),
        (("--model", model, "--out", out, "--prism", "q"), "no prism 'q'"),
        (("--model", str(tmp_path), "--out", out), "is not a model directory"),
        (("3", "--model", model, "--out", out), "either a model's NUMBER or --model DIR"),
    ):
        refused = CliRunner().invoke(main, ["model", "export", *arguments])
        assert refused.exit_code == 2, refused.stderr
        assert why in refused.stderr
    assert not (tmp_path / "x").exists()


# ---- the tip, again and again ----------------------------------------------------------------------------------------


@pytest.fixture
def socket(tmp_path: Path) -> Iterator[Path]:
    def tip(arguments: Any) -> dict[str, Any]:
        return {"status": "stale", "reason": "L2: no reading yet", "prism": arguments.get("prism"), "base_mm": None}

    server = ControlServer(tmp_path / "s", {"tip": tip})
    yield tmp_path / "s"
    server.close()


def test_following_the_tip_prints_a_json_object_a_line_until_it_is_stopped(socket: Path) -> None:
    command = [sys.executable, "-m", "daemon.cli.main", "tip", "--prism", "s", "--follow", "--json"]
    with subprocess.Popen([*command, "--socket", str(socket)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        lines = [json.loads(process.stdout.readline()) for _ in range(3)]
        assert [line["prism"] for line in lines] == ["s"] * 3
        deadline = time.monotonic() + 30.0
        process.send_signal(signal.SIGINT)
        assert process.wait(deadline - time.monotonic()) == 0


def test_a_tip_without_a_position_says_why(socket: Path) -> None:
    shown = run_apart("tip", "--prism", "s", "--socket", str(socket))
    assert (shown.returncode, shown.stdout) == (1, "")
    assert shown.stderr == "Error: prism s: stale: L2: no reading yet\n"


def test_a_tip_that_is_in_no_station_s_frame_says_so(tmp_path: Path) -> None:
    known = {"status": "ok", "prism": "r", "base_mm": [1.0, 2.0, 3.0], "sigma_mm": 1.0, "age_s": 0.1, "model": 2}
    with contextlib.closing(
        ControlServer(tmp_path / "s", {"tip": lambda _: known | {"setup": None, "station_mm": None, "warnings": []}})
    ):
        shown = run_apart("tip", "--prism", "r", "--socket", str(tmp_path / "s"))
    assert shown.returncode == 0
    assert "base 1.0 2.0 3.0 mm" in shown.stdout
    assert "not in a station's frame: the model does not know the station's set-up" in shown.stdout


# ---- who may send ----------------------------------------------------------------------------------------------------


def configured(text: str, tmp_path: Path) -> Config:
    return parse_config(text, tmp_path / "rigcal.toml")


def test_by_default_no_link_has_identifiers_of_its_own(tmp_path: Path) -> None:
    for text in (GOOD, MAY_SEND, MAY_SEND + '\n[tip]\nprism = "r"\n'):
        assert configured(text, tmp_path).own_identifiers("boom") == ()
    config = configured(MAY_SEND + TIP, tmp_path)
    assert config.own_identifiers("boom") == (0x680, 0x681)
    assert config.own_identifiers("another") == ()


@pytest.mark.parametrize("text", [GOOD, MAY_SEND, MAY_SEND + '\n[tip]\nprism = "r"\n'])
def test_a_daemon_that_is_not_told_to_sends_no_tip_and_its_link_would_refuse_one(text: str, tmp_path: Path) -> None:
    config = configured(text, tmp_path)
    parts = live(config, load_rig("swdt82"))
    rig = ModelRig(tmp_path)
    try:
        assert tip_sender(config, parts, rig.tip) is None
    finally:
        rig.close()
    (link,) = parts.can_links
    with pytest.raises(TransmitForbiddenError):
        link.publish(encode_tip(TipMessage(TipStatus.OK, (1.0, 2.0, 3.0), 1.0, 0.1), 0x680, 0))


def test_a_tip_on_a_link_that_may_not_send_is_refused(tmp_path: Path) -> None:
    assert "tip.can needs allow_transmit = true on link 'boom'" in check(GOOD + TIP, tmp_path)
    assert "no [[can]] link has this name" in check(MAY_SEND + TIP.replace('"boom"', '"arm"'), tmp_path)


@pytest.mark.parametrize("identifier", ["0x181", "0x67F", "0x6DF", "0x7E4", "0x800", "-1"])
def test_an_identifier_that_canopen_needs_is_refused(identifier: str, tmp_path: Path) -> None:
    assert "give 0x680 to 0x6DE" in check(MAY_SEND + TIP.replace("0x680", identifier), tmp_path)


def test_an_identifier_that_the_rig_is_read_from_and_a_prism_it_lacks_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"tip\.prism: rig 'swdt82' has no prism 'q'; it has w, b, r, s"):
        decoders(configured(MAY_SEND + TIP.replace('"r"', '"q"'), tmp_path), load_rig("swdt82"))
    source = load_rig("swdt82")
    spare = RawSignal(device="raw", name="spare", unit="bar", arbitration_id=0x681, start_bit=0, length_bits=8)
    channels = (*source.rig.channels, spare)
    doubled = replace(source, rig=source.rig.model_copy(update={"channels": channels}))
    with pytest.raises(ConfigError, match="681h is in use by channel 'spare'"):
        decoders(configured(MAY_SEND + TIP, tmp_path), doubled)
