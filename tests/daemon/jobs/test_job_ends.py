"""How the process of a job ends, and what is known of it then: by itself, by its limits, by a power cut."""

import json
import os
import resource
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.jobs.child import JobChild
from daemon.jobs.job_queue import JobQueue
from daemon.jobs.order import Order, Outcome, ProgressMessage, Started, parse_message
from drivers.clock import NS_PER_S
from tests.daemon.support.jobs import JobRig, is_gone


def test_data_that_determine_nothing_fail_in_a_sentence_whatever_lies_in_the_current_directory(
    rig: JobRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "numpy.py").write_text("raise SystemExit('code that is not ours')", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    rig.session("a")
    rig.start(real=True)
    rig.wait_for("failed", "cancelled", "cancelled", "cancelled")
    first, *waiting = rig.jobs()
    assert "sessions a" in first["error"]
    assert [job["error"] for job in waiting] == ["it needs job 1, which has failed"] * 3
    assert first["result_json"] is None
    assert rig.store.rows("SELECT * FROM models") == []


def test_a_fault_inside_a_job_is_its_error(rig: JobRig) -> None:
    order = Order("no such kind", 1, str(rig.config.store_path), "models", (), 0)
    with JobChild(order) as child:
        assert child.next_message(60.0) == Started(child.pid)
        message = child.next_message(60.0)
    assert message == Outcome("failed", "KeyError: 'no such kind'; see the daemon's log for details")
    assert is_gone(child.pid)


@pytest.mark.parametrize(
    ("what", "error"),
    [
        ("garbage", "its process sent 'Segmentation fault', which is not a message of a job"),
        ("mute", "its process ended with status 7 and no result"),
        ("killed", "its process was killed by signal 9 (Killed)"),
    ],
)
def test_a_process_that_breaks_the_protocol_is_a_failed_job(rig: JobRig, what: str, error: str) -> None:
    rig.session("a")
    rig.plan(gap=what)
    rig.start()
    rig.wait_for("failed", "cancelled", "cancelled", "cancelled")
    assert rig.job(1)["error"].startswith(error)
    assert rig.job(1)["pid"] is None


@pytest.mark.long
def test_a_process_that_closes_its_output_and_lives_on_is_ended(rig: JobRig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("daemon.jobs.child.END_TIMEOUT_S", 0.3)
    rig.session("a")
    rig.plan(gap="closed")
    rig.start()
    pid = rig.running(1)["pid"]
    rig.wait_for("failed", "cancelled", "cancelled", "cancelled")
    assert rig.job(1)["error"] == "its process closed its output without a result"
    assert is_gone(pid)


def test_a_job_that_takes_too_long_is_ended_with_all_that_it_started(tmp_path: Path) -> None:
    rig = JobRig(tmp_path, time_limit_s=1.5)
    try:
        rig.session("a")
        rig.plan(gap="deaf")
        rig.start()
        rig.wait_for("failed", "cancelled", "cancelled", "cancelled")
        job = rig.job(1)
        assert job["error"] == "took longer than its limit of 1.5 s ([jobs] time_limit_s)"
        assert job["time_limit_s"] == 1.5
        child = int((tmp_path / "child").read_text(encoding="utf-8"))
        rig.wait(lambda: is_gone(child), "the job's own child to end")
    finally:
        rig.close()


def test_a_job_gives_way_to_acquisition(rig: JobRig) -> None:
    rig.session("a")
    rig.plan(gap="hang")
    rig.start()
    pid = rig.running(1)["pid"]
    assert os.getpriority(os.PRIO_PROCESS, pid) == max(10, os.getpriority(os.PRIO_PROCESS, 0))


def test_a_command_that_cannot_be_started_is_tried_as_often_as_allowed(tmp_path: Path) -> None:
    rig = JobRig(tmp_path, max_attempts=2)
    try:
        rig.session("a")
        runner = rig.start(command=["/nowhere/python"])
        rig.wait_for("interrupted", "queued", "queued", "queued")
        assert [job["state"] for job in runner.list_command({})] == ["interrupted", "queued", "queued", "queued"]
        rig.clock.advance(6.0)
        rig.wait(lambda: rig.job(1)["attempts"] == 2, "a second attempt")
        rig.wait_for("failed", "cancelled", "cancelled", "cancelled")
        assert rig.job(1)["error"].startswith("interrupted 2 times, the most that [jobs] max_attempts allows")
        assert "queued" not in rig.states()
    finally:
        rig.close()


# ---- stops and starts ------------------------------------------------------------------------------------------------


def test_a_job_that_stops_interrupt_is_offered_again_however_often_that_was(tmp_path: Path) -> None:
    rig = JobRig(tmp_path, max_attempts=2)
    try:
        rig.session("a")
        rig.plan(gap="hang")
        for _ in range(3):
            rig.start()
            job = rig.running(1)
            assert (job["attempts"], job["error"]) == (1, None)
            rig.stop()
            assert rig.states() == ["interrupted", "queued", "queued", "queued"]
            assert (rig.job(1)["attempts"], rig.job(1)["error"]) == (0, "the daemon was stopped")
            assert is_gone(job["pid"])
        rig.plan()
        rig.start()
        rig.wait_for("done", "done", "done", "done")
    finally:
        rig.close()


def cut_off(rig: JobRig) -> None:
    """The job that runs is left running in the store, as a power cut or a kill leaves it."""
    running = rig.running(1)
    rig.stop()
    left = {name: running[name] for name in ("state", "attempts", "host_boot", "interruptions", "pid")}
    rig.store.update("jobs", {"id": 1}, left)


def test_power_cuts_are_no_attempts_of_the_job_that_they_interrupt(tmp_path: Path) -> None:
    rig = JobRig(tmp_path, max_attempts=2)
    try:
        rig.store.begin_run(rig.clock.now())
        rig.session("a")
        rig.plan(gap="hang")
        for cuts in range(5):
            rig.start(boot=f"boot-{cuts}")
            rig.clock.advance(200.0)
            assert rig.running(1)["attempts"] == 1
            cut_off(rig)
            rig.store.begin_run(rig.clock.now())  # the run before did not end in order
        rig.plan()
        rig.start(boot="the last one")
        rig.clock.advance(200.0)
        rig.wait_for("done", "done", "done", "done")
        assert (rig.job(1)["attempts"], rig.job(1)["interruptions"]) == (1, 5)
    finally:
        rig.close()


def test_a_job_in_which_the_daemon_was_killed_has_used_an_attempt(tmp_path: Path) -> None:
    rig = JobRig(tmp_path, max_attempts=2)
    try:
        rig.store.begin_run(rig.clock.now())
        rig.session("a")
        rig.plan(gap="hang")
        for attempt in (1, 2):
            rig.start()
            rig.clock.advance(200.0)
            assert rig.running(1)["attempts"] == attempt
            cut_off(rig)
            rig.store.begin_run(rig.clock.now())
        rig.start()
        rig.wait_for("failed", "cancelled", "cancelled", "cancelled")
        assert rig.job(1)["error"].startswith("interrupted 2 times")
    finally:
        rig.close()


def test_a_job_that_an_orderly_stop_had_no_time_to_write_down_has_used_no_attempt(rig: JobRig) -> None:
    rig.store.begin_run(rig.clock.now())
    rig.session("a")
    rig.plan(gap="hang")
    rig.start()
    cut_off(rig)
    rig.store.end_run(rig.clock.now())
    rig.store.begin_run(rig.clock.now())
    JobQueue(rig.store, "swdt82", rig.clock).interrupt_left_over("boot-a")
    assert (rig.states()[0], rig.job(1)["attempts"]) == ("interrupted", 0)


def test_a_result_that_the_store_refuses_is_no_attempt(rig: JobRig) -> None:
    rig.session("a")
    with rig.store.transaction() as db:
        refuse = "BEGIN SELECT RAISE(ABORT, 'database or disk is full'); END"
        db.execute(f"CREATE TRIGGER full BEFORE UPDATE ON jobs WHEN NEW.state = 'done' {refuse}")
    rig.start()
    rig.wait_for("interrupted", "queued", "queued", "queued")
    assert (rig.job(1)["attempts"], rig.job(1)["interruptions"]) == (0, 1)
    with rig.store.transaction() as db:
        db.execute("DROP TRIGGER full")
    rig.clock.advance(6.0)
    rig.wait_for("done", "done", "done", "done")


def test_an_interrupted_job_waits_before_it_runs_again_and_can_be_cancelled_meanwhile(rig: JobRig) -> None:
    rig.session("a")
    rig.plan(gap="hang")
    rig.start()
    rig.running(1)
    rig.stop()
    ended = rig.store.instant(rig.clock.now().shifted(100 * NS_PER_S), "ended_")
    rig.store.update("jobs", {"id": 1}, {**ended, "attempts": 1})  # as after a kill
    runner = rig.start()
    rig.look_on()
    assert rig.states() == ["interrupted", "queued", "queued", "queued"]
    assert runner.cancel_command({"id": 1}) == "job 1 (gap) is cancelled"
    assert rig.states() == ["cancelled", "cancelled", "cancelled", "cancelled"]


# ---- messages --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b'{"progress": 1, "message": "x"}\n', ProgressMessage(1.0, "x")),
        (b'{"progress": 1.0000001, "message": "x"}\n', ProgressMessage(1.0, "x")),
        (b'{"progress": 1%b, "message": "x"}\n' % (b"0" * 400), ProgressMessage(1.0, "x")),
        (b'{"result": {"model": null}}\n', Outcome("done", result={"model": None})),
        (b'{"error": "too poor"}\n', Outcome("failed", "too poor")),
    ],
)
def test_a_message_is_what_it_says(line: bytes, message: ProgressMessage | Outcome) -> None:
    assert parse_message(line) == message


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.sampled_from(["progress", "message", "result", "error"]), inner),
)


@given(st.binary() | JSON.map(lambda value: json.dumps(value).encode()))
def test_any_line_is_progress_or_an_end(line: bytes) -> None:
    message: Any = parse_message(line)
    if isinstance(message, ProgressMessage):
        assert 0.0 <= message.share <= 1.0
    else:
        assert message.state == ("done" if message.result is not None else "failed")


def test_a_daemon_without_a_descriptor_left_uses_up_no_attempt(rig: JobRig) -> None:
    rig.session("a")
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
    try:
        rig.start()
        rig.wait_for("interrupted", "queued", "queued", "queued")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert (rig.job(1)["attempts"], rig.job(1)["interruptions"]) == (0, 1)
    rig.clock.advance(6.0)
    rig.wait_for("done", "done", "done", "done")
