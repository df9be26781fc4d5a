"""Jobs and sums of drift of sessions that are rejected, or whose zeros are lost, while jobs are queued or run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from calibration.numerics.statistics import CLIP
from daemon.jobs.job_queue import JobQueue
from daemon.jobs.order import Outcome
from daemon.jobs.scheduler import CHAIN, DueChain
from daemon.models.drift import drift_status
from daemon.sessions.lifecycle import SessionLifecycle
from daemon.store.queries.models import ModelTable
from drivers.readings import DeviceEvent, EventKind
from tests.daemon.jobs.test_gap_job import with_live_model
from tests.daemon.support.jobs import SOURCE, JobRig


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[JobRig]:
    monkeypatch.setattr("daemon.jobs.runner.POLL_S", 0.05)
    monkeypatch.setattr(SessionLifecycle, "_why_moved", lambda *_: None)  # these sessions need no control points
    made = JobRig(tmp_path)
    yield made
    made.close()


def lifecycle(rig: JobRig) -> SessionLifecycle:
    return SessionLifecycle(rig.store, SOURCE.rig, rig.clock, 10.0)


def models(rig: JobRig) -> ModelTable:
    return ModelTable(rig.store, "swdt82", rig.clock)


def lose_a_zero(rig: JobRig) -> None:
    rig.clock.advance(1.0)
    jump = DeviceEvent(SOURCE.rig.joint_names[0], rig.clock.now(), EventKind.PRESET_JUMP, "jumped")
    rig.store.insert_records([jump])
    lifecycle(rig).judge_zeros()


def check_zeros(rig: JobRig) -> None:
    model = models(rig).live() or models(rig).waiting()
    assert model is not None
    models(rig).note_zeros_checked(model, max(models(rig).jumped(model).values(), default=0), operator="Ada")
    lifecycle(rig).judge_readings()


def is_used(rig: JobRig, session: str) -> bool:
    (row,) = rig.store.rows("SELECT excluded FROM calibration_sessions WHERE id = ?", (session,))
    return row["excluded"] is None


def test_a_chain_whose_zeros_are_lost_and_checked_while_it_runs_is_finished(rig: JobRig) -> None:
    rig.session("a")
    queue = JobQueue(rig.store, "swdt82", rig.clock)
    queue.queue(DueChain(CHAIN, "a", "a"))
    gap = queue.state().jobs[0]
    assert queue.begin(gap, 60.0)
    lose_a_zero(rig)
    made = {"model": "/x", "manifest_sha256": "0", "stage": "geometric", "sessions": ["a"], "metrics": {}}
    queue.end(gap.id, Outcome("done", result=made))
    assert not is_used(rig, "a")
    rig.start()
    rig.wait_for(*["done"] * 4)
    check_zeros(rig)
    assert is_used(rig, "a")


def test_training_is_repeated_without_a_session_that_was_rejected_while_its_zeros_were_lost(rig: JobRig) -> None:
    rig.session("a")
    rig.session("b")
    rig.start()
    rig.wait_for(*["done"] * 4)
    lose_a_zero(rig)
    lifecycle(rig).reject("b", "Ada", "measured on w")
    check_zeros(rig)
    assert (is_used(rig, "a"), is_used(rig, "b")) == (True, False)
    rig.clock.advance(3600.0)
    rig.wait_for(*["done"] * 8)
    assert [order["session_ids"] for order in rig.orders() if order["kind"] == "gap"] == [["a", "b"], ["a"]]


def test_scores_of_a_check_that_is_rejected_while_its_zeros_are_lost_and_its_job_runs_do_not_count(rig: JobRig) -> None:
    with_live_model(rig)
    rig.plan(drift="hang")
    rig.session("c1", kind="check")
    rig.clock.advance(3.0)
    rig.wait(lambda: (rig.jobs()[-1]["kind"], rig.states()[-1]) == ("drift", "running"), "the drift job")
    run = models(rig).live_run()
    assert run is not None
    lose_a_zero(rig)
    lifecycle(rig).reject("c1", "Ada", "measured on w")
    found = {"session": "c1", "scores": [CLIP] * 3, "fixes": 3, "ratio": 9.0, "reason": ""}
    result = {"drift": {"live_since": run.since, "checks": [found]}}
    JobQueue(rig.store, "swdt82", rig.clock).end(rig.jobs()[-1]["id"], Outcome("done", result=result))
    drift = drift_status(models(rig))
    assert drift is not None
    assert (drift["checks"], drift["alarm"]) == (0, "none")
