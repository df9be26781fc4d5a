"""What rules are told of sessions, set-ups, jobs and models is what the store holds at that moment."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import pytest

from daemon.alarms.evidence import Gatherer
from daemon.jobs.order import Outcome
from daemon.models.drift import note_drift
from daemon.service import is_store_new
from daemon.sessions.lifecycle import SessionLifecycle
from daemon.store.queries.jobs import FailedJob, JobTable
from daemon.store.queries.sessions import SessionTable
from daemon.store.queries.setups import SetupRow, SetupTable
from drivers.readings import DeviceEvent, EventKind
from tests.daemon.support.jobs import SOURCE
from tests.daemon.support.models import ModelRig, wait


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[ModelRig]:
    rig = ModelRig(tmp_path)
    yield rig
    rig.close()


@pytest.fixture
def parts(rig: ModelRig) -> dict[str, Callable[[], object]]:
    """The parts of the evidence that the store and the live model tell, as the daemon composes them."""
    sessions, jobs = SessionTable(rig.store, "swdt82"), JobTable(rig.store, "swdt82")
    return {
        "session": sessions.open_session,
        "setup": SetupTable(rig.store, "swdt82").current,
        "failed_jobs": jobs.failed,
        "model": rig.live.health,
        "untrained_sessions": sessions.untrained,
        "control_faults": lambda: {"control.sock": "the file is gone"},
    }


@pytest.fixture
def gather(rig: ModelRig, parts: dict[str, Callable[[], object]]) -> Gatherer:
    return Gatherer(rig.clock, None, parts)


def job(rig: ModelRig, kind: str, session: str) -> int:
    row = {"kind": kind, "session_id": session, "through_session_id": session, "state": "running"}
    return rig.store.insert("jobs", row | rig.store.instant(rig.clock.now(), "created_"))


def test_a_failed_job_is_told_until_it_is_retried_or_a_newer_one_is_done(rig: ModelRig, gather: Gatherer) -> None:
    rig.jobs.session("a")
    rig.jobs.session("other", rig="ur10")
    first, second, foreign = job(rig, "gap", "a"), job(rig, "report", "a"), job(rig, "gap", "other")
    assert gather().failed_jobs == []
    for number in (first, second, foreign):
        rig.job_table.end(number, Outcome("failed", "too poor"))
    assert gather().failed_jobs == [FailedJob(first, "gap", "too poor"), FailedJob(second, "report", "too poor")]
    rig.job_table.retry(second)
    assert gather().failed_jobs == [FailedJob(first, "gap", "too poor")]
    newer = job(rig, "gap", "a")
    rig.job_table.end(newer, Outcome("failed", "poorer"))
    assert gather().failed_jobs == [FailedJob(newer, "gap", "poorer")]
    done = job(rig, "gap", "a")
    rig.store.update("jobs", {"id": done}, {"state": "done"})
    assert gather().failed_jobs == []


def test_an_open_session_is_told_with_its_age_and_the_joints_that_jumped_in_it(rig: ModelRig, gather: Gatherer) -> None:
    jump = DeviceEvent("theta1", rig.clock.now(), EventKind.PRESET_JUMP, "position jumped")
    rig.store.insert_records([jump])
    assert gather().session is None
    rig.jobs.session("a", state="open")
    rig.clock.advance(99.0)
    rig.store.insert_records([DeviceEvent("theta3", rig.clock.now(), EventKind.PRESET_JUMP, "position jumped")])
    evidence = gather()
    assert evidence.session is not None
    assert (evidence.session.id, evidence.session_age_s, evidence.session.jumped) == ("a", 100.0, ("theta3",))
    rig.jobs.close_session("a")
    assert gather().session is None


def test_the_set_up_is_told_and_whether_it_has_moved(rig: ModelRig, gather: Gatherer) -> None:
    assert gather().setup is None
    created = rig.store.instant(rig.clock.now(), "created_")
    for name, state in (("S1", "ok"), ("S2", "moved")):
        rig.store.insert("station_setups", {"id": name, "instrument": "", "serial": "", "state": state, **created})
    assert gather().setup == SetupRow("S2", "moved")
    rig.store.insert("station_setups", {"id": "S3", "instrument": "", "serial": "", "state": "ok", **created})
    assert gather().setup == SetupRow("S3", "ok")


@pytest.mark.long
def test_the_live_model_is_told_with_jumps_defects_and_drift(rig: ModelRig, gather: Gatherer) -> None:
    assert gather().model is None
    number = rig.accepted()
    rig.settled()
    model = gather().model
    assert model is not None
    assert (model.id, model.jumped, model.defect, model.drifted_with) == (number, (), "", None)
    rig.clock.advance(10.0)
    rig.take([DeviceEvent("theta1", rig.clock.now(), EventKind.PRESET_JUMP, "position jumped")])
    wait(lambda: (found := gather().model) is not None and found.jumped == ("theta1",))
    rig.jobs.session("c", kind="check")
    run = rig.models.live_run()
    assert run is not None
    check = {"session": "c", "fixes": 8, "scores": [9.0] * 9, "ratio": 3.0, "reason": ""}
    note_drift(rig.models, {"live_since": run.since, "checks": [check]})
    found = gather().model
    assert found is not None
    assert found.drifted_with == "c"
    assert found.rejected is None
    sessions = SessionLifecycle(rig.store, SOURCE.rig, rig.clock, 10.0)
    sessions.reject("a", "Ada", "measured on w")
    found = gather().model
    assert found is not None
    assert found.rejected == "a"
    sessions.accept("a", "Ada")
    file = rig.models.get(number).path / "model.json"
    file.write_bytes(file.read_bytes()[:-10])
    rig.live.changed()
    wait(lambda: (found := gather().model) is not None and "truncated" in found.defect)


def test_a_session_that_is_not_used_is_told_until_a_newer_one_is(rig: ModelRig, gather: Gatherer) -> None:
    for name in ("a", "b", "c"):
        rig.jobs.session(name)
    for name in ("a", "c"):
        rig.store.update("calibration_sessions", {"id": name}, {"excluded": "no control point was shot"})
    assert gather().untrained_sessions == {"c": "no control point was shot"}
    rig.jobs.session("d")
    assert gather().untrained_sessions == {}


def test_a_new_store_beside_old_models_is_told_until_it_has_a_job(rig: ModelRig, tmp_path: Path) -> None:
    jobs, models = JobTable(rig.store, "swdt82"), tmp_path / "models of an earlier store"
    assert not is_store_new(jobs, models)
    models.mkdir()
    assert not is_store_new(jobs, models)
    (models / "7").mkdir()
    assert is_store_new(jobs, models)
    rig.jobs.session("a")
    job(rig, "gap", "a")
    assert not is_store_new(jobs, models)


def test_a_control_socket_that_fails_is_told(gather: Gatherer) -> None:
    assert gather().control_faults == {"control.sock": "the file is gone"}


def test_a_part_that_fails_keeps_what_it_was_last_known_to_be(
    rig: ModelRig, gather: Gatherer, parts: dict[str, Callable[[], object]]
) -> None:
    rig.jobs.session("a", state="open")
    assert gather().session is not None

    def fail() -> NoReturn:
        raise OSError("it fails")

    parts["session"] = fail
    evidence = gather()
    assert evidence.session is not None
    assert evidence.session.id == "a"
    assert evidence.unwatched == {"the open session": "OSError: it fails"}
    assert evidence.control_faults
