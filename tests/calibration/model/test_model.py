"""A model is data: it comes back as it was written, or is refused in a sentence."""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.errors import ModelError
from calibration.model.files import model_from_files, model_to_files
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.pipeline.calibrate import train_residual
from tests.calibration.conftest import Session

RESIDUAL = {"kind": "rbfn", "signals": [], "prisms": [], "excess_variance_mm2": [0, 0, 0], "files": []}


@pytest.fixture(scope="module")
def with_residual(session: Session) -> CalibratedModel:
    """The session's model, with a chain that learned a bias on top."""
    shifted = session.training.position_mm + 30.0 * np.sin(session.training.joints["L3"] / 300.0)[:, None]
    biased = replace(session.training, position_mm=shifted)
    loose = replace(session.model, excess_sigma_mm=50.0)
    model = train_residual(loose, biased, kind="chain")
    assert model.residual is not None
    return model


def resigned(files: dict[str, bytes], name: str, data: bytes) -> dict[str, bytes]:
    """The files with one of them edited and the manifest made to agree."""
    manifest = json.loads(files["manifest.json"])
    manifest["files"][name] = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
    return files | {name: data, "manifest.json": json.dumps(manifest).encode()}


def edited(files: dict[str, bytes], **changes: object) -> dict[str, bytes]:
    document = json.loads(files["model.json"]) | changes
    return resigned(files, "model.json", json.dumps(document).encode())


def test_a_model_comes_back_as_it_was_written(with_residual: CalibratedModel, session: Session) -> None:
    files = model_to_files(with_residual)
    again = model_from_files(files | {"report.html": b"not listed, not read"})
    assert model_to_files(again) == files
    before, after = Predictor.of(with_residual).predict(session.held_out), Predictor.of(again).predict(session.held_out)
    np.testing.assert_array_equal(before.position_mm, after.position_mm)
    np.testing.assert_array_equal(before.sigma_mm, after.sigma_mm)
    assert again.parameters == with_residual.parameters
    assert again.provenance == with_residual.provenance
    assert np.abs(Predictor.of(with_residual).correction(session.held_out)[0]).max() > 5.0


def test_every_truncated_file_is_refused_before_it_is_parsed(with_residual: CalibratedModel) -> None:
    files = model_to_files(with_residual)
    for name in files:
        with pytest.raises(ModelError, match=name):
            model_from_files(files | {name: files[name][: len(files[name]) // 2]})


def test_every_missing_file_is_named(with_residual: CalibratedModel) -> None:
    files = model_to_files(with_residual)
    for name in files:
        with pytest.raises(ModelError, match=f"{name} is missing"):
            model_from_files({k: v for k, v in files.items() if k != name})


@given(st.data())
def test_no_flipped_byte_gets_through(session: Session, data: st.DataObject) -> None:
    files = model_to_files(session.model)
    name = data.draw(st.sampled_from(sorted(set(files) - {"manifest.json"})))
    place = data.draw(st.integers(0, len(files[name]) - 1))
    flipped = bytearray(files[name])
    flipped[place] ^= data.draw(st.integers(1, 255))
    with pytest.raises(ModelError, match="SHA-256 differs"):
        model_from_files(files | {name: bytes(flipped)})


@given(st.binary(max_size=200))
def test_a_manifest_of_arbitrary_bytes_is_refused(session: Session, data: bytes) -> None:
    with pytest.raises(ModelError, match="manifest"):
        model_from_files(model_to_files(session.model) | {"manifest.json": data})


def test_a_model_of_another_version_says_which(session: Session) -> None:
    files = model_to_files(session.model)
    manifest = json.loads(files["manifest.json"]) | {"version": 2}
    with pytest.raises(ModelError, match="version 2, this program supports version 3"):
        model_from_files(files | {"manifest.json": json.dumps(manifest).encode()})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"prior": "hearsay"}, "prior"),
        ({"excess_sigma_mm": float("nan")}, "excess_sigma_mm"),
        ({"surprise": 1}, "surprise"),
        ({"parameters": []}, "parameters of model.json differ from those of its rig"),
        (
            {"placements": {"": {"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]], "translation_mm": [0, 0, 0]}}},
            "not a rotation",
        ),
        ({"ranges": {"theta99": [0, 1]}}, "theta99"),
        (
            {
                "residual": {
                    "kind": "oracle",
                    "signals": [],
                    "prisms": [],
                    "excess_variance_mm2": [0, 0, 0],
                    "files": [],
                }
            },
            "the model lacks oracle",
        ),
        (
            {
                "residual": {
                    "kind": "rbfn",
                    "signals": [],
                    "prisms": [],
                    "excess_variance_mm2": [0, 0, 0],
                    "files": ["model.json"],
                }
            },
            "the model lacks rbfn.npz",
        ),
    ],
)
def test_a_signed_model_that_contradicts_itself_is_refused(
    session: Session, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(ModelError, match=message):
        model_from_files(edited(model_to_files(session.model), **changes))


@pytest.mark.parametrize("name", ["rig.toml", "model.json", "covariance.npz"])
@pytest.mark.parametrize("data", [b"", b"\xff\xfe", b"[]", b"PK\x03\x04 rest"])
def test_a_signed_file_of_rubbish_is_refused(session: Session, name: str, data: bytes) -> None:
    with pytest.raises(ModelError):
        model_from_files(resigned(model_to_files(session.model), name, data))


def archive(**arrays: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]  # its stub takes the names for allow_pickle
    return buffer.getvalue()


BASE = ("placements", "")


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ((*BASE, "rotation"), [[1, 0, 0], [0, 1, 0], [0, 0, -1]], "not a rotation"),
        ((*BASE, "rotation"), [[1e200, 1e200, 0], [1e200, -1e200, 0], [0, 0, 1]], "rotation"),
        ((*BASE, "translation_mm", 0), 1e9, "translation_mm"),
        (("parameters", 3, "value"), 1e300, "value"),
        (("parameters", 3, "geometric_stage_value"), -1e9, "geometric_stage_value"),
        (("parameters", 0, "standard_error"), -1.0, "standard_error"),
        (("prior_scale",), 0.0, "prior_scale"),
        (("excess_sigma_mm",), -5.0, "excess_sigma_mm"),
        (("excess_sigma_mm",), 1e200, "excess_sigma_mm"),
        (("repeat_sigma_mm",), -1.0, "repeat_sigma_mm"),
        (("effects_noise_mm",), -1.0, "effects_noise_mm"),
        (("joint_error_scale",), 1e308, "joint_error_scale"),
        (("intervals", "radius"), 1e300, "radius"),
        (("residual", "prisms"), ["p99"], "prism 'p99', which its rig lacks"),
        (("residual", "excess_variance_mm2", 0), 1e300, "excess_variance_mm2"),
        (("fixes",), {"p99": 3}, "prism 'p99', which its rig lacks"),
        (("ranges", "theta3"), [9.0, -9.0], "ends before it starts"),
        (("torques",), ["theta99"], "theta99"),
        (("loads",), {"theta99": [0.0, 1.0]}, "theta99"),
        (("loads",), {"theta3": [1.0, 0.0]}, "ends before it starts"),
        (("outliers",), [{"row": -5, "sigma": 6.0}], "row"),
    ],
)
def test_a_signed_model_of_no_machine_is_refused(
    with_residual: CalibratedModel, path: tuple[str | int, ...], value: object, message: str
) -> None:
    files = model_to_files(with_residual)
    document = json.loads(files["model.json"])
    part = document
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    with pytest.raises(ModelError, match=message):
        model_from_files(resigned(files, "model.json", json.dumps(document).encode()))


@pytest.mark.parametrize(
    "damage", ["negative", "one-sided", "beyond its variances", "huge", "complex", "words", "flat"]
)
def test_a_matrix_that_is_no_covariance_is_refused(session: Session, damage: str) -> None:
    covariance = session.model.covariance
    scale = np.sqrt(np.diag(covariance))
    damaged = {
        "negative": -covariance,
        "one-sided": np.triu(covariance),
        "beyond its variances": np.outer(scale, scale) * (2.0 - np.eye(len(scale))),
        "huge": covariance * 1e300,
        "complex": covariance + 1j,
        "words": covariance.astype(str),
        "flat": covariance.ravel(),
    }[damage]
    with pytest.raises(ModelError, match="covariance"):
        model_from_files(resigned(model_to_files(session.model), "covariance.npz", archive(covariance=damaged)))


def test_files_that_break_their_parsers_are_refused(with_residual: CalibratedModel) -> None:
    files = model_to_files(with_residual)
    compressed = io.BytesIO()
    np.savez_compressed(compressed, covariance=with_residual.covariance)
    stream = bytearray(compressed.getvalue())
    stream[100:200] = bytes(100)
    deep = b"[" * 100_000
    encrypted = bytearray(files["covariance.npz"])
    encrypted[encrypted.index(b"PK\x01\x02") + 8] |= 1
    for name, data in (
        ("lightgbm.json", deep),
        ("model.json", deep),
        ("rig.toml", b"a = " + deep),
        ("covariance.npz", bytes(stream)),
        ("covariance.npz", bytes(encrypted)),
        ("rbfn.npz", b"PK\x03\x04"),
    ):
        assert name in files
        with pytest.raises(ModelError) as refused:
            model_from_files(resigned(files, name, data))
        assert "\n" not in str(refused.value)
        assert str(refused.value).endswith("calibrate again")


def test_pickled_arrays_are_not_loaded(session: Session) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, covariance=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ModelError, match="cannot be read"):
        model_from_files(resigned(model_to_files(session.model), "covariance.npz", buffer.getvalue()))


def test_a_residual_of_another_rigs_features_is_refused(with_residual: CalibratedModel) -> None:
    files = model_to_files(with_residual)
    names = json.loads(files["lightgbm.json"])
    names["features"][0] = "q1_deg"
    with pytest.raises(ModelError, match="features of the residual differ"):
        model_from_files(resigned(files, "lightgbm.json", json.dumps(names).encode()))


def test_parameters_carry_corrections_in_build_tolerances(session: Session) -> None:
    estimates = {p.name: p for p in session.model.parameters}
    theta3 = estimates["row3.theta"]
    assert theta3.standard_error < theta3.prior_sigma
    assert theta3.pull == pytest.approx(theta3.value / theta3.prior_sigma)
    assert estimates["base.x"].pull == 0.0
    # What the data cannot see keeps the tolerance it came with.
    assert estimates["row2.d"].standard_error == pytest.approx(estimates["row1.d"].standard_error, rel=0.01)
