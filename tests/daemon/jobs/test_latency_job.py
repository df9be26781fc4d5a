"""A report tells how late the station's fixes are, from what a session measured between its poses."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from calibration.observations import parse_observations
from calibration.pipeline.calibrate import identify
from daemon.cli.lines.clock import latency_sentence
from daemon.jobs.order import Order
from daemon.jobs.process import perform
from daemon.models.model_files import write_model
from daemon.overview import newest_latency
from daemon.sessions.session_data import sessions_csv
from daemon.store.reader import Reader
from simulators.effects.library import parse_effects
from simulators.rig.dataset import SimulatedObservations
from simulators.rig.truth import RigTruth
from tests.daemon.support.jobs import SOURCE, JobRig
from tests.simulated.runs import simulate_runs

LATE_S = 0.1


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[JobRig]:
    rig = JobRig(tmp_path)
    yield rig
    rig.close()


@pytest.mark.long
def test_a_report_tells_the_latency_of_each_session(rig: JobRig, tmp_path: Path) -> None:
    rig.measured("a", 40, prisms=["r", "s"])
    rig.measured("c", 4, kind="check", prisms=["r", "s"])
    truth = RigTruth(SOURCE.rig, 1, effects=parse_effects(f"latency@clock:seconds={LATE_S}"))
    runs = simulate_runs(truth, 1, 120, 30, prisms=["r"], setup="S1")
    is_moving = np.asarray(runs.columns["dwell_s"]) == 0.0
    moving = {name: np.asarray(values)[is_moving] for name, values in runs.columns.items()}
    path = SimulatedObservations(moving, runs.measured_mm[is_moving], runs.oracle_mm[is_moving])
    rig.observed("a", path, moving=True)
    (wrong,) = rig.store.rows(
        "SELECT id, pose FROM observations WHERE session_id = 'a' AND NOT moving LIMIT 1 OFFSET 9"
    )
    rig.store.update("observations", {"id": wrong["id"]}, {"x_mm": 0.0})
    with Reader(rig.store.path) as reader:
        poses = parse_observations(sessions_csv(reader, SOURCE.rig, ("a",)), SOURCE.rig, "poses")
    model = identify(SOURCE.rig, SOURCE.text, poses, effects="none")
    assert len(poses) == 80, "fixes of a moving boom calibrate nothing"
    sha256 = write_model(tmp_path / "model", model)
    order = Order(
        "report",
        3,
        str(rig.store.path),
        str(tmp_path),
        ("c",),
        0,
        model=str(tmp_path / "model"),
        model_sha256=sha256,
        train_ids=("a",),
    )
    result = perform(order, lambda _share, _text: None)
    latency = result["latency"]
    page = Path(result["report"]).read_text(encoding="utf-8")
    assert "Timing of station and bus" in page
    assert f"the station is late: add {latency['a']['seconds'] * 1e3:.0f} ms to link_delay_s" in page
    assert f">pose {wrong['pose']} of session a</td>" in page, "an outlier is named by its pose: there is no file"
    assert f"c: not known, {latency['c']['reason']}." in page
    assert abs(latency["a"]["seconds"] - LATE_S) < 4.0 * latency["a"]["standard_error_s"]
    assert latency["a"]["standard_error_s"] < 0.03
    assert "reason" in latency["c"]
    newest = newest_latency(latency)
    assert newest is not None
    assert newest["session"] == "a"


def test_sentences_for_people() -> None:
    known = {"seconds": 0.0424, "standard_error_s": 0.005, "fixes": 312, "motions": 24}
    assert latency_sentence(known) == ("42 ms +- 5 ms in addition to link_delay_s (from 312 fixes of 24 motions)")
    assert latency_sentence({"reason": "why"}) == "unknown: why"
    assert newest_latency({"c": {"reason": "why"}}) is None
