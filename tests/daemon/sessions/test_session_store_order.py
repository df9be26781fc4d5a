"""What the store refuses has not happened: memory never knows more of a session than the store."""

import contextlib
import hashlib
import sqlite3
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from sqlite_utils import Database

from calibration.rig.description import parse_rig
from daemon.commands import CommandError
from daemon.control.protocol import request
from daemon.control.server import ControlServer
from daemon.jobs.job_queue import JobQueue
from daemon.jobs.order import Outcome
from daemon.jobs.scheduler import CHAIN, DueChain, next_job
from daemon.store.errors import unwritable_errors
from daemon.store.migrations import MIGRATIONS
from daemon.store.store import Store
from tests.daemon.support.damage import fill_up, make_room
from tests.daemon.support.sessions import SOURCE, Rig, another_program_writes, disk_fails


def open_sessions(rig: Rig) -> list[str]:
    return [row["id"] for row in rig.store.rows("SELECT id FROM calibration_sessions WHERE state = 'open'")]


@pytest.mark.parametrize("command", ["stop", "abort"])
def test_a_session_whose_end_cannot_be_stored_stays_open_here_and_there(session_rig: Rig, command: str) -> None:
    session_rig.say("start", prism="r")
    session_rig.live(2)
    with disk_fails(), pytest.raises(sqlite3.OperationalError):
        session_rig.say(command)
    with pytest.raises(CommandError, match="session 's001-r' is open; stop or abort it first"):
        session_rig.say("start", prism="b")
    assert open_sessions(session_rig) == ["s001-r"]
    before = session_rig.say("show", id="s001-r")["observations"]
    session_rig.live(2)
    assert session_rig.say("show", id="s001-r")["observations"] > before + 30, (
        "its fixes are its observations all along"
    )
    session_rig.say(command)
    assert session_rig.say("start", prism="b")["id"] == "s002-b"
    session_rig.keeper = session_rig.new_keeper()
    session_rig.live(2)
    assert {row["session_id"] for row in session_rig.store.rows("SELECT * FROM observations WHERE prism = 'b'")} == {
        "s002-b"
    }
    assert open_sessions(session_rig) == ["s002-b"]


def test_a_session_whose_start_finds_the_disk_full_is_not_open(session_rig: Rig) -> None:
    fill_up(session_rig.store)
    with pytest.raises(sqlite3.OperationalError, match="database or disk is full"):
        session_rig.say("start", prism="r")
    assert session_rig.keeper.open_session() is None
    assert open_sessions(session_rig) == []
    make_room(session_rig.store)
    assert session_rig.say("start", prism="r")["id"] == "s001-r"


def test_a_full_disk_is_told_in_a_sentence_that_says_what_to_do(
    session_rig: Rig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def start(arguments: Mapping[str, Any]) -> dict[str, Any]:
        with unwritable_errors(session_rig.store.path):  # as the daemon carries commands out
            return session_rig.keeper.start_command(arguments)

    server = ControlServer(tmp_path / "s", {"session.start": start})
    try:
        fill_up(session_rig.store)
        with pytest.raises(CommandError) as caught:
            request(tmp_path / "s", "session.start", {"prism": "r"})
    finally:
        server.close()
    assert caught.value.status == 1
    sentence = str(caught.value)
    assert f"{session_rig.store.path}: cannot be written, the disk is full (database or disk is full;" in sentence
    assert sentence.endswith("nothing was changed, so repeat the command afterwards")
    assert "Traceback" not in caplog.text


def test_the_store_holds_one_open_session_of_a_rig(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    (row,) = session_rig.store.rows("SELECT * FROM calibration_sessions")
    with pytest.raises(sqlite3.IntegrityError, match="UNIQUE"):
        session_rig.store.insert("calibration_sessions", row | {"id": "second"})
    session_rig.store.insert("calibration_sessions", row | {"id": "another session_rig's", "rig": "ur10"})


def test_of_the_open_sessions_of_an_older_store_none_goes_on_and_each_says_why(
    tmp_path: Path,
) -> None:
    old = Database(tmp_path / "rigcal.sqlite")
    MIGRATIONS.apply(old, stop_before="m008_one_open_session")
    with old.atomic():
        old["boots"].insert({"id": 1, "kernel_boot_id": "manual", "booted_utc_ns": 0})
        instant = {"utc_ns": 1, "monotonic_ns": 1, "boot_id": 1}
        sha256 = hashlib.sha256(SOURCE.text.encode()).hexdigest()
        setup = {"id": "S1", "instrument": "", "serial": "", "state": "ok"}
        old["station_setups"].insert({**setup, **{f"created_{name}": value for name, value in instant.items()}})
        for number, (name, rig, note) in enumerate([("a", "swdt82", "windy"), ("b", "swdt82", ""), ("x", "ur10", "")]):
            session: dict[str, Any] = {"id": name, "rig": rig, "rig_sha256": sha256, "rig_text": SOURCE.text}
            session |= {
                "setup_id": "S1",
                "prism": "r",
                "operator": "",
                "kind": "static_poses",
                "state": "open",
                "note": note,
            }
            session |= {f"started_{key}": value + number * (key != "boot_id") for key, value in instant.items()}
            old["calibration_sessions"].insert(session)
    old.close()
    rig = Rig(tmp_path / "rigcal.sqlite")
    a, b, x = rig.say("list")
    assert (a["state"], b["state"], x["state"]) == ("aborted", "closed", "closed")
    assert a["note"].startswith("windy; aborted by rigcal: it was still open when session b was started")
    assert a["ended_utc_ns"] == b["started_utc_ns"]
    assert b["note"] == "closed by rigcal: session x was started while it was open"
    assert b["not_used"] == "it was still open when session x was started"
    assert x["note"] == "closed by rigcal: the rig was changed from ur10 to swdt82 while it was open"
    assert rig.keeper.open_session() is None
    rig.store.close()


def test_a_session_whose_rig_file_is_changed_under_it_is_closed_and_gets_no_fix_of_the_other_rig(
    session_rig: Rig,
) -> None:
    session_rig.say("start", prism="r")
    session_rig.live(2)
    before = session_rig.say("list")[0]["observations"]
    session_rig.machine = parse_rig(SOURCE.text.replace('name = "r"', 'name = "rod"'), "rig.toml")
    aimed: list[str] = []
    session_rig.keeper = session_rig.new_keeper(aimed.append)
    session_rig.live(2)
    assert session_rig.keeper.open_session() is None
    assert aimed == [], "the rig has no such prism any more"
    (session,) = session_rig.say("list")
    assert (session["state"], session["observations"]) == ("closed", before)
    assert "the rig file was changed" in session["note"]
    assert session_rig.say("start", prism="rod")["id"] == "s002-rod"


@pytest.mark.parametrize("by", ["the disk", "another program"])
def test_what_is_observed_while_the_store_is_refused_is_stored_later(session_rig: Rig, by: str) -> None:
    with session_rig.store.transaction() as db:
        db.execute("PRAGMA busy_timeout = 10")
    path = session_rig.store.path
    session_rig.say("start", prism="r")
    session_rig.live(2)
    session_rig.observing = disk_fails if by == "the disk" else partial(another_program_writes, path)
    session_rig.live(1)
    session_rig.observing = contextlib.nullcontext
    session_rig.live(2)
    observed = [
        row["monotonic_ns"] for row in session_rig.store.rows("SELECT monotonic_ns FROM observations ORDER BY id")
    ]
    measured = [row["monotonic_ns"] for row in session_rig.store.rows("SELECT monotonic_ns FROM fixes ORDER BY id")]
    assert observed == measured[: len(observed)]
    assert len(observed) > 80


def cancelled_while_it_runs(rig: Rig) -> tuple[JobQueue, int]:
    """The queue with a job of a session that was begun and cancelled; the number of that job."""
    rig.say("setup_new", id="S1")
    name = rig.say("start", prism="r")["id"]
    rig.say("stop")
    jobs = JobQueue(rig.store, "swdt82", rig.clock)
    jobs.queue(DueChain(CHAIN, name, name))
    job = next_job(jobs.state())
    assert job is not None
    assert jobs.begin(job, 60.0)
    jobs.cancel(job.id)
    return jobs, job.id


def test_a_cancellation_is_kept_when_the_jobs_end_cannot_be_stored(tmp_path: Path) -> None:
    rig = Rig(tmp_path / "rigcal.sqlite")
    jobs, job_id = cancelled_while_it_runs(rig)
    with disk_fails(), pytest.raises(sqlite3.OperationalError):
        jobs.end(job_id, Outcome("done", result={"model": "m"}))
    jobs.interrupt_running("the daemon could not see it through", is_attempt=False)
    assert {row["state"] for row in rig.store.rows("SELECT state FROM jobs")} == {"cancelled"}
    rig.store.close()


def test_a_cancellation_outlives_a_daemon_that_is_killed_before_the_job_has_ended(tmp_path: Path) -> None:
    rig = Rig(tmp_path / "rigcal.sqlite")
    cancelled_while_it_runs(rig)
    rig.store.close()
    again = Store(tmp_path / "rigcal.sqlite")
    JobQueue(again, "swdt82", rig.clock).interrupt_left_over("this boot")
    assert {row["state"] for row in again.rows("SELECT state FROM jobs")} == {"cancelled"}
    again.close()
