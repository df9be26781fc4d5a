"""The job runner, on a real store and with real processes."""

import itertools
import json
from pathlib import Path
from typing import Any

import pytest
from sqlite_utils import Database

from daemon.commands import CommandError
from daemon.jobs.job_queue import JobQueue
from daemon.jobs.order import Order, Outcome
from daemon.jobs.process import perform
from daemon.jobs.scheduler import CHAIN, next_job
from daemon.models.model_files import model_sha256, read_model
from daemon.store.errors import NotInStoreError
from daemon.store.migrations import MIGRATIONS
from drivers.clock import NS_PER_S, Stamp
from tests.daemon.support.jobs import JobRig, is_gone
from tests.daemon.support.store import steps_of


def table(rig: JobRig) -> JobQueue:
    """The table, with a chain queued for one session, and nobody to run it."""
    rig.session("a")
    rig.plan(gap="hang")
    rig.start()
    rig.running(1)
    rig.stop()
    rig.store.update("jobs", {"id": 1}, {"state": "queued", "attempts": 0})
    return JobQueue(rig.store, "swdt82", rig.clock)


def insert(db: Database, name: str, *rows: dict[str, Any]) -> None:
    """Rows straight into a table: fast, and into schemas of the past."""
    marks = ", ".join(f":{column}" for column in rows[0])
    db.conn.executemany(f"INSERT INTO {name} ({', '.join(rows[0])}) VALUES ({marks})", rows)


# ---- with the real work ----------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_chain_runs_in_order_and_leaves_its_models_and_report(rig: JobRig) -> None:
    rig.measured("a", 20, prisms=["r", "s"])
    rig.measured("c", 4, kind="check", prisms=["r", "s"])
    rig.start(real=True)
    rig.wait_for("done", "done", "done", "done")
    jobs = rig.jobs()
    assert [job["kind"] for job in jobs] == ["gap", "residual", "report", "comparison"]
    assert all(job["progress"] == 1.0 and job["pid"] is None and job["attempts"] == 1 for job in jobs)
    assert all(a["ended_monotonic_ns"] <= b["started_monotonic_ns"] for a, b in itertools.pairwise(jobs))
    models = rig.store.rows("SELECT * FROM models ORDER BY id")
    assert [(m["job_id"], m["rig"], m["stage"], m["state"]) for m in models] == [
        (1, "swdt82", "geometric", "candidate"),
        (2, "swdt82", "hybrid", "candidate"),
    ]
    assert [m["manifest_sha256"] for m in models] == [model_sha256(Path(m["path"])) for m in models]
    assert json.loads(models[0]["metrics_json"])["noise_mm"] > 0
    assert rig.runner is not None
    report = rig.runner.list_command({})[2]
    assert "result_json" not in report
    assert report["result"]["held_out"]
    assert report["result"]["sessions"] == ["a"]
    assert Path(report["result"]["report"]).stat().st_size > 10_000
    stages = {s["stage"]: s["rms_mm"] for s in report["result"]["evaluation"]["stages"]}
    assert stages["geometric"] < stages["nominal"] / 2
    compared = json.loads(models[1]["metrics_json"])["comparison"]
    assert (compared["live"], compared["sessions"], compared["is_better"]) == (None, ["c"], True)


@pytest.mark.long
def test_a_job_goes_on_from_the_checkpoint_of_its_number_and_leaves_none(rig: JobRig) -> None:
    rig.measured("a", 20, prisms=["r", "s"])
    for row in rig.store.rows("SELECT id, z_mm FROM observations"):  # misfit enough for a global search
        rig.store.update("observations", {"id": row["id"]}, {"z_mm": row["z_mm"] + (15.0 if row["id"] % 3 else -15.0)})
    checkpoint = rig.config.models_directory / "00001.checkpoint"
    checkpoint.parent.mkdir(parents=True)
    checkpoint.write_bytes(b"no state of a search")
    order = Order("gap", 1, str(rig.config.store_path), str(checkpoint.parent), ("a",), 0)
    result = perform(order, lambda share, text: None)
    assert "the checkpoint cannot be read, so the search started again" in read_model(Path(result["model"])).warnings
    assert not checkpoint.exists()


# ---- what becomes of a job -------------------------------------------------------------------------------------------


def test_a_failed_job_cancels_those_that_wait_for_it_and_says_why(rig: JobRig) -> None:
    rig.session("a")
    rig.plan(residual="fail")
    rig.start()
    rig.wait_for("done", "failed", "cancelled", "cancelled")
    assert [job["error"] for job in rig.jobs()] == [
        None,
        "the data are too poor",
        *["it needs job 2, which has failed"] * 2,
    ]
    assert {job["message"] for job in rig.jobs()} == {""}, "what an ended job was doing is no news"


@pytest.mark.parametrize(("kind", "other"), [("report", "comparison"), ("comparison", "report")])
def test_a_report_that_fails_keeps_no_comparison_from_running_nor_the_other_way_round(
    rig: JobRig, kind: str, other: str
) -> None:
    rig.session("a")
    rig.plan(**{kind: "fail"})
    rig.start()
    rig.wait(lambda: len(rig.states()) == 4 and not set(rig.states()) & {"queued", "running"})
    ended = {job["kind"]: job["state"] for job in rig.jobs()}
    assert ended == {"gap": "done", "residual": "done", kind: "failed", other: "done"}
    rig.plan()
    rig.session("c", kind="check")
    rig.clock.advance(3.0)
    rig.wait(lambda: rig.states()[4:] == ["done", "done"], "the checks")


# ---- the operator ----------------------------------------------------------------------------------------------------


def test_a_running_job_is_cancelled_with_its_process_and_those_that_wait(rig: JobRig) -> None:
    rig.session("a")
    rig.plan(gap="hang")
    runner = rig.start()
    job = rig.running(1)
    assert job["progress"] == 0.25
    assert runner.cancel_command({"id": 1}) == "job 1 (gap) is being cancelled"
    rig.wait_for("cancelled", "cancelled", "cancelled", "cancelled")
    assert is_gone(job["pid"])
    assert [j["error"] for j in rig.jobs()] == [
        "cancelled by the operator",
        *["it needs job 1, which was cancelled"] * 3,
    ]


def test_a_queued_job_is_cancelled_and_the_one_before_it_runs_on(rig: JobRig) -> None:
    rig.session("a")
    rig.plan(gap="hang")
    runner = rig.start()
    rig.running(1)
    assert runner.cancel_command({"id": 2}) == "job 2 (residual) is cancelled"
    assert rig.states() == ["running", "cancelled", "cancelled", "cancelled"]
    assert rig.job(3)["error"] == "it needs job 2, which was cancelled"
    runner.cancel_command({"id": 1})
    rig.wait_for("cancelled", "cancelled", "cancelled", "cancelled")
    assert rig.job(2)["error"] == "cancelled by the operator"


def test_a_job_cancelled_between_choice_and_start_does_not_start(rig: JobRig) -> None:
    jobs = table(rig)
    chosen = next_job(jobs.state())
    assert chosen is not None
    jobs.cancel(1)
    assert not jobs.begin(chosen, 60.0)
    assert rig.states() == ["cancelled", "cancelled", "cancelled", "cancelled"]


def test_a_cancellation_goes_before_a_result_that_comes_at_the_same_time(rig: JobRig) -> None:
    jobs = table(rig)
    chosen = next_job(jobs.state())
    assert chosen is not None
    assert jobs.begin(chosen, 60.0)
    jobs.cancel(1)
    assert jobs.end(1, Outcome("done", result={"model": "m"})).state == "cancelled"
    assert rig.states() == ["cancelled", "cancelled", "cancelled", "cancelled"]
    jobs.retry(1)
    again = next_job(jobs.state())
    assert again is not None
    assert jobs.begin(again, 60.0)
    assert not jobs.is_cancelled(1)


def test_a_cancellation_after_the_end_is_refused_and_forgotten(rig: JobRig) -> None:
    jobs = table(rig)
    chosen = next_job(jobs.state())
    assert chosen is not None
    jobs.begin(chosen, 60.0)
    jobs.end(1, Outcome("failed", "the data are too poor"))
    with pytest.raises(CommandError, match="job 1 is failed; only a job that has not ended can be cancelled"):
        jobs.cancel(1)
    assert not jobs.is_cancelled(1)


def test_a_retried_job_runs_again_with_those_that_waited_and_shows_no_old_error(rig: JobRig) -> None:
    rig.session("a")
    rig.plan(gap="fail")
    runner = rig.start()
    rig.wait_for("failed", "cancelled", "cancelled", "cancelled")
    rig.plan(gap="hang")
    assert runner.retry_command({"id": 1}) == "job 1 (gap) is queued again"
    job = rig.running(1)
    assert (job["error"], job["ended_utc_ns"], job["attempts"]) == (None, None, 1)
    runner.cancel_command({"id": 1})
    rig.wait_for("cancelled", "cancelled", "cancelled", "cancelled")
    rig.plan()
    runner.retry_command({"id": 1})
    rig.wait_for("done", "done", "done", "done")
    assert [job["error"] for job in rig.jobs()] == [None] * 4


def test_what_makes_no_sense_is_refused_in_a_sentence(rig: JobRig) -> None:
    rig.session("a")
    rig.plan(residual="fail")
    runner = rig.start()
    rig.wait_for("done", "failed", "cancelled", "cancelled")
    for command, number, why in (
        (runner.retry_command, 1, "job 1 is done; only a failed, cancelled or interrupted job can be retried"),
        (runner.cancel_command, 1, "job 1 is done"),
        (runner.retry_command, 3, "job 3 depends on job 2, which is failed; retry job 2"),
        (runner.cancel_command, 99, "there is no job 99"),
        (runner.retry_command, "1", "there is no job '1'"),
    ):
        with pytest.raises((CommandError, NotInStoreError), match=why):
            command({"id": number})


def test_a_job_whose_restarts_never_end_is_given_up_and_can_be_retried(rig: JobRig) -> None:
    jobs = table(rig)
    rig.store.update("jobs", {"id": 1}, {"state": "interrupted", "interruptions": 20})
    rig.start()
    rig.wait_for("failed", "cancelled", "cancelled", "cancelled")
    assert rig.job(1)["error"].startswith("interrupted 20 times through no fault of its own")
    rig.stop()
    jobs.retry(1)
    assert rig.job(1)["interruptions"] == 0


def test_nothing_starts_while_a_session_is_open(rig: JobRig) -> None:
    rig.session("a")
    rig.session("b", state="open")
    rig.start()
    rig.look_on()
    assert rig.jobs() == []
    rig.close_session("b")
    rig.clock.advance(3.0)
    rig.wait_for("done", "done", "done", "done")
    assert rig.orders()[0]["session_ids"] == ["a", "b"]


def test_queued_jobs_wait_while_a_session_is_open(rig: JobRig) -> None:
    rig.session("a")
    rig.plan(gap="hang")
    runner = rig.start()
    rig.running(1)
    rig.session("b", state="open")
    rig.plan()
    runner.cancel_command({"id": 1})
    rig.wait_for("cancelled", "cancelled", "cancelled", "cancelled")
    runner.retry_command({"id": 1})
    rig.look_on()
    assert rig.states() == ["queued", "queued", "queued", "queued"]


# ---- which sessions are worked on ------------------------------------------------------------------------------------


@pytest.mark.parametrize("hours", [-1000, 1000])
def test_a_wall_clock_that_is_wrong_after_a_reboot_changes_nothing(rig: JobRig, hours: int) -> None:
    """Neither sessions before nor after it are worked on twice, or not at all."""
    rig.session("a")
    rig.start()
    rig.wait_for("done", "done", "done", "done")
    rig.stop()
    rig.clock.set(Stamp(rig.clock.now().utc_ns + hours * 3600 * NS_PER_S, 5 * NS_PER_S, "boot-b"))
    rig.start()
    rig.look_on()
    assert rig.states() == ["done"] * 4
    rig.session("b")
    rig.clock.advance(3.0)
    rig.wait_for(*["done"] * 8)
    rig.look_on()
    assert rig.states() == ["done"] * 8
    assert rig.orders()[4]["session_ids"] == ["a", "b"]


def test_a_session_closed_while_a_chain_runs_has_a_chain_of_its_own(rig: JobRig) -> None:
    rig.session("a")
    rig.plan(gap="hang")
    runner = rig.start()
    rig.running(1)
    rig.session("c", kind="check")
    rig.session("b")
    rig.clock.advance(3.0)
    rig.plan()
    runner.cancel_command({"id": 1})
    rig.wait_for(*["cancelled"] * 4, *["done"] * 4)
    runner.retry_command({"id": 1})
    rig.wait_for(*["done"] * 8)
    told = [(o["job_id"], o["session_ids"], o["train_ids"]) for o in rig.orders() if o["kind"] == "report"]
    assert told == [(7, ["c"], ["a", "b"]), (3, [], ["a"])], "a job works on the sessions it was queued for"


def test_a_check_is_held_against_the_newest_model(rig: JobRig) -> None:
    rig.session("c1", kind="check")
    rig.start()
    rig.look_on()
    assert rig.jobs() == [], "there is no model yet"
    rig.session("a")
    rig.clock.advance(3.0)
    rig.wait_for("done", "done", "done", "done")
    rig.session("c2", kind="check")
    rig.clock.advance(3.0)
    rig.wait_for(*["done"] * 6)
    for order, kind in zip(rig.orders()[-2:], ("report", "comparison"), strict=True):
        assert (order["kind"], order["session_ids"], order["train_ids"]) == (kind, ["c1", "c2"], ["a"])
        assert order["model"] == str(rig.directory / "2")


def test_rigs_that_share_a_store_do_not_share_jobs_or_models(rig: JobRig) -> None:
    rig.session("a")
    rig.start()
    rig.wait_for("done", "done", "done", "done")
    rig.stop()
    rig.session("x", kind="check", rig="ur10")
    rig.start(rig="ur10")
    rig.look_on()
    assert len(rig.jobs()) == 4, "the model is another rig's"
    rig.session("y", rig="ur10")
    rig.clock.advance(3.0)
    rig.wait_for(*["done"] * 8)
    assert rig.orders()[4]["session_ids"] == ["y"]


def test_jobs_of_an_older_store_keep_what_they_covered(tmp_path: Path) -> None:
    """Before m005 a job's own session was all that told what it worked on."""
    old = Database(tmp_path / "rigcal.sqlite")
    MIGRATIONS.apply(old, stop_before="m005_jobs_cover_sessions")
    instants = {
        f"{prefix}_{name}": 1 for prefix in ("started", "ended") for name in ("utc_ns", "monotonic_ns", "boot_id")
    }
    with old.atomic():
        insert(old, "boots", {"id": 1, "kernel_boot_id": "boot-0", "booted_utc_ns": 0})
        session = {"id": "a", "rig": "swdt82", "rig_sha256": "", "rig_text": "", "prism": "r", "operator": ""}
        insert(old, "calibration_sessions", {**session, "kind": "static_poses", "state": "closed", **instants})
        job = {"kind": "identification", "session_id": "a", "state": "failed"}
        insert(old, "jobs", {**job, "created_utc_ns": 1, "created_monotonic_ns": 1, "created_boot_id": 1})
    old.close()
    rig = JobRig(tmp_path)
    try:
        rig.start()
        rig.look_on()
        assert rig.states() == ["failed"]
        assert rig.job(1)["kind"] == "gap", "what identification did is part of that job now"
    finally:
        rig.close()


# ---- what it costs ---------------------------------------------------------------------------------------------------


def test_looking_for_work_stays_cheap_after_years(rig: JobRig) -> None:
    rig.session("s0")
    (session,) = rig.store.rows("SELECT * FROM calibration_sessions")
    job: dict[str, Any] = {
        "kind": "",
        "session_id": "",
        "through_session_id": "",
        "state": "done",
        "result_json": json.dumps(["s"] * 500),
    }
    job.update(rig.store.instant(rig.clock.now(), "created_"))
    sessions = [session | {"id": f"s{i}"} for i in range(1, 1000)]
    jobs_done = [
        job | {"kind": kind, "session_id": f"s{i}", "through_session_id": f"s{i}"}
        for i in range(1000)
        for kind in CHAIN
    ]
    with rig.store.transaction() as db:
        for name, rows in (("calibration_sessions", sessions), ("jobs", jobs_done)):
            insert(db, name, *rows)
    jobs = JobQueue(rig.store, "swdt82", rig.clock)
    jobs.state()
    statements: list[str] = []

    def look() -> None:
        jobs.state()
        jobs.table.unfinished()

    with rig.store.transaction() as db:
        db.conn.set_trace_callback(statements.append)
        look()
        db.conn.set_trace_callback(None)
    assert len(statements) <= 9
    assert not any("FROM boots" in statement for statement in statements)
    assert steps_of(rig.store, look) < 15_000
