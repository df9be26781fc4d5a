"""Residuals that the page shows are those of the live model's own prediction."""

import json
from pathlib import Path

import numpy as np
import pytest

from calibration.model.prediction import Predictor
from calibration.observations import parse_observations
from daemon.models.model_files import model_sha256, read_model
from daemon.sessions.session_data import sessions_csv
from daemon.store.reader import Reader
from daemon.web.residuals import SessionFixes
from daemon.web.shape import shape
from tests.daemon.support.jobs import SOURCE, JobRig
from tests.daemon.support.models import written


@pytest.fixture
def measured(tmp_path: Path) -> JobRig:
    rig = JobRig(tmp_path)
    rig.measured("a", 6, prisms=["r"])
    rig.close()
    return rig


def test_fixes_have_the_live_models_residuals_and_excluded_ones_have_none(measured: JobRig) -> None:
    directory = written(30)
    sha256 = model_sha256(directory)
    live = {"id": 7, "path": str(directory), "manifest_sha256": sha256}
    store = measured.config.store_path
    found = SessionFixes().read(store, None, "a", live)
    model = read_model(directory, sha256)
    with Reader(store) as reader:
        rows = parse_observations(sessions_csv(reader, model.rig, ["a"]), model.rig, "a")
    expected = rows.position_mm - Predictor.of(model).predict(rows).position_mm
    assert np.allclose([fix["residual_mm"] for fix in found["fixes"]], expected, atol=1e-3)
    assert (found["model"], found["note"]) == (7, "")
    assert len(found["fixes"]) == len(rows)


def test_without_a_live_model_the_fixes_come_alone(measured: JobRig) -> None:
    found = SessionFixes().read(measured.config.store_path, None, "a", None)
    assert [fix["residual_mm"] for fix in found["fixes"]] == [None] * len(found["fixes"])
    assert "No model is live" in found["note"]


def test_a_model_that_cannot_be_read_is_said(measured: JobRig, tmp_path: Path) -> None:
    live = {"id": 7, "path": str(tmp_path / "gone"), "manifest_sha256": "ab"}
    found = SessionFixes().read(measured.config.store_path, None, "a", live)
    assert "No residuals" in found["note"]


def test_the_drawings_transforms_lead_to_the_nominal_prisms(measured: JobRig) -> None:
    drawn = json.loads(json.dumps(shape(SOURCE.text)))
    rig = SOURCE.rig
    from calibration.kinematics.chain import Chain, ChainData, Placement

    chain = Chain(rig, {"": Placement.identity()})
    values = np.array([[0.3 * joint.limits[0] + 0.7 * joint.limits[1] for joint in rig.joints]])
    for index, name in enumerate(rig.prism_names):
        data = ChainData(values, np.array([index]), np.array([0]))
        expected = chain.positions_mm(np.zeros(len(chain)), data)[0]
        assert np.allclose(walked(drawn["chains"][name], values[0]), expected, atol=1e-6)


def walked(chain: list[tuple[bool, int, float, list[tuple[int, float]]]], values: np.ndarray) -> np.ndarray:
    """Where a chain of elementary transforms ends, written as the page's boom.js has it."""
    rotation, place = np.eye(3), np.zeros(3)
    for rotates, axis, constant, drive in chain:
        size = constant + sum(coefficient * values[joint] for joint, coefficient in drive)
        if rotates:
            i, j = [(1, 2), (2, 0), (0, 1)][axis]
            cosine, sine = np.cos(size), np.sin(size)
            turned = rotation.copy()
            turned[:, i] = cosine * rotation[:, i] + sine * rotation[:, j]
            turned[:, j] = -sine * rotation[:, i] + cosine * rotation[:, j]
            rotation = turned
        else:
            place = place + rotation[:, axis] * size
    return place
