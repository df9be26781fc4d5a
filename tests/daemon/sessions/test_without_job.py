"""Sessions that have started no job of their own say why, and reports say who measured what."""

from __future__ import annotations

from typing import Any

from daemon.sessions.session_data import sessions_measured
from daemon.sessions.without_job import why_no_job
from daemon.store.queries.jobs import JobTable
from daemon.store.queries.observations import stations_of
from daemon.store.queries.sessions import SessionTable
from daemon.store.reader import Reader
from drivers.clock import SIMULATED_BOOT, Stamp
from tests.daemon.support.jobs import JobRig


def reasons(rig: JobRig, **options: Any) -> dict[str, str | None]:
    """Session -> why it has no job."""
    jobs = JobTable(rig.store, "swdt82")
    sessions = SessionTable(rig.store, "swdt82").all()
    settings = {"are_jobs_enabled": True, **options}
    return {session["id"]: why_no_job(session, jobs, **settings) for session in sessions}


def test_each_reason_is_named(rig: JobRig) -> None:
    rig.session("open", state="open")
    rig.session("aborted", state="aborted")
    rig.session("check", kind="check")
    rig.session("new")
    rig.store.update("calibration_sessions", {"id": "new"}, {"excluded": "no control point was shot at its end"})
    found = reasons(rig)
    assert "the session is open" in str(found["open"])
    assert "was aborted" in str(found["aborted"])
    assert "no model yet" in str(found["check"])
    assert found["new"] == "calibration does not use the session: no control point was shot at its end"
    rig.store.update("calibration_sessions", {"id": "new"}, {"excluded": None})
    assert "queued within seconds" in str(reasons(rig)["new"])
    assert "[jobs] enabled = true" in str(reasons(rig, are_jobs_enabled=False)["new"])


def test_a_job_that_works_on_several_sessions_is_named_by_all_of_them(rig: JobRig) -> None:
    rig.session("first")
    rig.session("second")
    rig.start()
    rig.wait_for("done", "done", "done", "done")
    assert reasons(rig) == {"first": "job 1 of session second includes this session", "second": None}
    assert rig.runner is not None
    jobs = rig.runner.list_command({})
    assert [job["session_id"] for job in jobs] == ["second"] * 4
    assert all(job["duration_s"] is not None for job in jobs)


def test_a_report_names_who_measured_what_and_when(rig: JobRig) -> None:
    rig.measured("a", 4)
    rig.session("b")
    rig.store.update("calibration_sessions", {"id": "b"}, {"operator": "", "caller_user": "rig7"})
    with Reader(rig.config.store_path) as reader:
        measured = sessions_measured(reader, ("a", "b"))
    assert (measured.sessions, measured.operators) == (("a", "b"), ("Ada", "rig7"))
    assert (measured.instruments, measured.setups) == (("simulated",), ("S1",))
    assert measured.measured_utc_ns is not None
    assert measured.measured_utc_ns[0] < measured.measured_utc_ns[1]
    assert not measured.is_simulated


def test_sessions_of_a_simulated_rig_are_known_by_the_boot_of_their_clock(rig: JobRig) -> None:
    rig.session("a")
    simulated = rig.clock.now()
    simulated = Stamp(simulated.utc_ns, simulated.monotonic_ns, f"{SIMULATED_BOOT}1")
    rig.store.update("calibration_sessions", {"id": "a"}, rig.store.instant(simulated, "started_"))
    with Reader(rig.config.store_path) as reader:
        assert sessions_measured(reader, ("a",)).is_simulated


def test_the_stations_of_a_session_are_those_of_its_fixes(rig: JobRig) -> None:
    rig.measured("a", 4)
    with Reader(rig.config.store_path) as reader:
        assert stations_of(reader, "a") == []
    now = rig.clock.now()
    instants = rig.store.instant(now) | rig.store.instant(now, "last_byte_")
    fix = {"station": "north", "status": "ok", "lock": "locked", "reason": "", "raw": b"", **instants}
    rig.store.insert("fixes", {"id": 1, **fix})
    rig.store.update("observations", {"session_id": "a"}, {"fix_id": 1})
    with Reader(rig.config.store_path) as reader:
        assert stations_of(reader, "a") == ["north"]
