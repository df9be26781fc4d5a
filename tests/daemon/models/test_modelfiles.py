from __future__ import annotations

import hashlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.errors import CalibrationError, ModelError, UnsafeError
from calibration.model.prediction import Predictor
from calibration.observations import parse_observations
from daemon.models import model_files as modelfiles
from daemon.models.model_files import check_target, model_sha256, read_model, read_model_of_rig, write_model
from tests.daemon.support.offline import held_out_csv, small_calibration


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("models") / "boom"
    write_model(directory, small_calibration()[0], {"report.html": b"<p>report</p>"})
    return directory


@pytest.fixture
def model_directory(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "boom"))


def reseal(directory: Path) -> None:
    """Make the manifest true again, as someone who edits a model on purpose would."""
    manifest = json.loads((directory / "manifest.json").read_text())
    for name in manifest["files"]:
        data = (directory / name).read_bytes()
        manifest["files"][name] = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
    (directory / "manifest.json").write_text(json.dumps(manifest))


@pytest.mark.slow
def test_a_written_model_predicts_the_same_when_read(written: Path) -> None:
    model = small_calibration()[0]
    observations = parse_observations(held_out_csv(), model.rig, "test.csv")
    read = read_model(written)
    np.testing.assert_allclose(
        Predictor.of(read).predict(observations).position_mm,
        Predictor.of(model).predict(observations).position_mm,
        atol=1e-9,
    )
    assert read.residual is not None


def test_the_manifest_names_the_model(written: Path, tmp_path: Path) -> None:
    digest = write_model(tmp_path / "again", small_calibration()[0])
    assert digest == model_sha256(written) == model_sha256(tmp_path / "again")


def test_a_model_of_channels_that_a_file_decoded_otherwise_is_refused(written: Path, tmp_path: Path) -> None:
    model = read_model(written)
    before, after = (model.rig.with_decoding({"q1": f"frame 201h, {factor} * integer"}) for factor in (0.1, 0.01))
    path = tmp_path / "model"
    provenance = {**model.provenance, "rig_sha256": hashlib.sha256(before.text.encode()).hexdigest()}
    write_model(path, replace(model, rig=before, rig_text=before.text, provenance=provenance))
    for rig in (before, model.rig):
        assert read_model_of_rig(path, model_sha256(path), rig).rig.decoding == before.decoding
    with pytest.raises(UnsafeError, match="was made for a rig file"):
        read_model_of_rig(path, model_sha256(path), after)
    assert read_model_of_rig(written, model_sha256(written), after).rig.decoding == {}, "an older model goes on"


def test_nothing_is_left_beside_the_model(tmp_path: Path) -> None:
    write_model(tmp_path / "models" / "boom", small_calibration()[0])
    write_model(tmp_path / "models" / "boom", small_calibration()[0], {"report.html": b"new"})
    assert [path.name for path in (tmp_path / "models").iterdir()] == ["boom"]
    assert (tmp_path / "models" / "boom" / "report.html").read_bytes() == b"new"


@pytest.mark.parametrize("name", ["rig.toml", "model.json", "covariance.npz", "lightgbm_x.txt"])
def test_a_truncated_file_is_refused(model_directory: Path, name: str) -> None:
    path = model_directory / name
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ModelError, match=f"{name} is truncated"):
        read_model(model_directory)


def test_an_edited_file_is_refused(model_directory: Path) -> None:
    path = model_directory / "model.json"
    path.write_bytes(path.read_bytes().replace(b"0.1", b"0.2", 1))
    with pytest.raises(ModelError, match=r"model\.json was changed after it was written"):
        read_model(model_directory)


def test_a_missing_file_is_refused(model_directory: Path) -> None:
    (model_directory / "covariance.npz").unlink()
    with pytest.raises(ModelError, match=r"covariance\.npz is missing"):
        read_model(model_directory)


def test_a_damaged_text_under_a_true_manifest_dies_in_the_child_and_not_here(model_directory: Path) -> None:
    path = model_directory / "lightgbm_x.txt"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    reseal(model_directory)
    with pytest.raises(ModelError, match=str(model_directory)) as refusal:
        read_model(model_directory)
    assert "\n" not in str(refusal.value)


def test_a_model_that_predicts_positions_off_the_earth_is_refused_by_the_child(model_directory: Path) -> None:
    path = model_directory / "lightgbm_x.txt"
    leaves = re.compile(r"(?<=^leaf_value=).*", re.MULTILINE)
    path.write_text(leaves.sub(lambda line: re.sub(r"\S+", "1e299", line.group()), path.read_text()))
    reseal(model_directory)
    with pytest.raises(ModelError, match=r"beyond 1e\+09 mm"):
        read_model(model_directory)


@pytest.mark.long
def test_a_model_of_compressed_zeros_is_refused_and_not_unpacked(model_directory: Path) -> None:
    zeros = io.BytesIO()
    np.savez_compressed(zeros, covariance=np.zeros((9000, 9000)))
    (model_directory / "covariance.npz").write_bytes(zeros.getvalue())
    reseal(model_directory)
    with pytest.raises(ModelError, match="an archive of arrays is compressed"):
        read_model(model_directory)


def test_a_process_with_a_limit_of_memory_gets_no_more() -> None:
    program = """
from daemon.models.first_load import limit_memory
limit_memory(100 << 20)
kept = bytearray(50 << 20)
try:
    bytearray(100 << 20)
except MemoryError:
    print("no more")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "no more\n"


def test_a_description_larger_than_that_of_any_model_is_not_parsed(model_directory: Path) -> None:
    path = model_directory / "model.json"
    document = json.loads(path.read_text())
    document["ranges"] = {f"theta{n}": [0.0, 1.0] for n in range(400_000)}
    path.write_text(json.dumps(document))
    reseal(model_directory)
    with pytest.raises(ModelError, match=r"model\.json is larger than 8,388,608 bytes"):
        read_model(model_directory)


def test_a_directory_with_more_than_a_model_is_not_read(model_directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modelfiles, "_MODEL_MAX_BYTES", 100_000)
    with pytest.raises(ModelError, match=r"is larger than a model can be \(100,000 bytes\)"):
        read_model(model_directory)
    manifest = json.loads((model_directory / "manifest.json").read_text())
    manifest["files"] |= {f"file{n}": {"sha256": "", "bytes": 0} for n in range(40)}
    (model_directory / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(ModelError, match="lists 48 files; a model has at most 32"):
        read_model(model_directory)


def test_a_model_that_takes_its_reader_down_is_named(model_directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # What LightGBM does to a process differs between its versions; a reader that is killed stands for all of them.
    killer = model_directory.parent / "python"
    killer.write_text("#!/bin/sh\nkill -SEGV $$\n")
    killer.chmod(0o755)
    reseal(model_directory)  # another manifest, so that it was not checked before
    monkeypatch.setattr("sys.executable", str(killer))
    with pytest.raises(ModelError, match=r"crashes the process that loads it \(SIGSEGV\)"):
        read_model(model_directory)


def test_a_reader_that_cannot_load_any_model_blames_the_machine(
    model_directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader = model_directory.parent / "python"
    reader.write_text("#!/bin/sh\necho 'libgomp.so.1 is missing' >&2\nexit 4\n")
    reader.chmod(0o755)
    reseal(model_directory)
    monkeypatch.setattr("sys.executable", str(reader))
    with pytest.raises(CalibrationError, match=r"libgomp\.so\.1 is missing") as refusal:
        read_model(model_directory)
    assert not isinstance(refusal.value, ModelError)


def test_a_model_is_loaded_by_a_child_once_per_process(written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read_model(written)
    monkeypatch.setattr("sys.executable", "/nowhere")
    read_model(written)


def test_a_model_is_loaded_by_no_other_child_where_its_sum_was_kept(
    written: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(modelfiles, "_checked", set())
    monkeypatch.setattr("sys.executable", "/nowhere")
    read_model(written, model_sha256(written))
    with pytest.raises(FileNotFoundError):
        read_model(written)


@pytest.mark.parametrize(
    "manifest",
    [
        *("", "[]", "{}", '{"files": 3}', '{"files": [3]}', "[" * 100_000),
        *('{"files": {"../../etc/passwd": {}}}', '{"files": {"..": {}}}', '{"files": {"a\\u0000b": {}}}'),
        *('{"files": {"\\ud800": {}}}', '{"files": {"' + "a" * 5000 + '": {}}}'),
    ],
)
def test_a_damaged_manifest_is_refused(model_directory: Path, manifest: str) -> None:
    (model_directory / "manifest.json").write_text(manifest)
    with pytest.raises(ModelError, match=r"manifest\.json"):
        read_model(model_directory)


def test_what_is_no_model_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "nothing"):
        with pytest.raises(ModelError, match="is not a directory"):
            read_model(path)
    with pytest.raises(ModelError, match="is not a model directory"):
        read_model(tmp_path)
    with pytest.raises(ModelError, match="is not a model directory"):
        model_sha256(tmp_path)


def test_only_a_free_place_or_a_model_is_written_over(model_directory: Path, tmp_path: Path) -> None:
    check_target(tmp_path / "new")
    (tmp_path / "empty").mkdir()
    check_target(tmp_path / "empty")
    check_target(model_directory)
    (tmp_path / "file").write_text("")
    with pytest.raises(ModelError, match="is a file"):
        check_target(tmp_path / "file")
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years of work")
    with pytest.raises(ModelError, match="neither empty nor a model directory"):
        write_model(tmp_path / "home", small_calibration()[0])
    (model_directory / "notes.txt").write_text("mine")
    with pytest.raises(ModelError, match=r"contains 'notes\.txt'"):
        check_target(model_directory)


def test_an_empty_directory_and_a_link_to_one_are_filled(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    write_model(tmp_path / "link", small_calibration()[0])
    assert (tmp_path / "link").is_symlink()
    assert model_sha256(tmp_path / "real")


def test_a_damaged_model_can_be_replaced(model_directory: Path) -> None:
    (model_directory / "model.json").write_text("{")
    write_model(model_directory, small_calibration()[0])
    assert read_model(model_directory).rig.name == "ur10"


def test_a_file_system_that_cannot_swap_still_gets_the_new_model(
    model_directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(modelfiles, "_RENAME_EXCHANGE", 1 << 20)  # a flag that no kernel knows: EINVAL
    write_model(model_directory, small_calibration()[0], {"report.html": b"new"})
    assert (model_directory / "report.html").read_bytes() == b"new"
    assert os.listdir(model_directory.parent) == ["boom"]


def test_a_failed_write_leaves_the_old_model(model_directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    before = (model_directory / "report.html").read_bytes()
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_model(model_directory, small_calibration()[0], {"report.html": b"new"})
    assert (model_directory / "report.html").read_bytes() == before
    assert os.listdir(model_directory.parent) == ["boom"]
