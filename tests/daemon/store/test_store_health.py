"""A store that is damaged, replaced, unlinked or short of room is noticed, and people are told what to do."""

from __future__ import annotations

import contextlib
import re
import shutil
import sqlite3
import subprocess
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from click.testing import CliRunner

from daemon.cli.main import main
from daemon.commands import REFUSED, CommandError
from daemon.composition import Parts, joiner
from daemon.config.config import Config
from daemon.control.command_table import COMMANDS
from daemon.control.protocol import request
from daemon.control_commands import UNGUARDED
from daemon.service import Daemon
from daemon.store import Reader, Store, StoreError
from daemon.store.files import FileIdentity
from drivers.clock import SystemClock
from drivers.readings import DeviceEvent, EventKind, LinkItem
from tests.daemon.support.acquisition import ListLink, wait_until
from tests.daemon.support.damage import fill, small_disk, tear
from tests.daemon.support.idle_daemon import running as run_daemon
from tests.daemon.support.jobs import SOURCE, JobRig
from tests.daemon.support.store import at, frame, table
from tests.daemon.support.watch import results, settled, watched

# ---- damage ----------------------------------------------------------------------------------------------------------


def test_a_start_that_fails_leaves_the_check_to_the_next(tmp_path: Path) -> None:
    config = Config(rig="swdt82", state_directory=tmp_path)
    with watched(config.store_path, ends_in_order=False):
        pass
    config.socket_path.mkdir()
    with pytest.raises(CommandError, match=re.escape(str(config.socket_path))), running(tmp_path):
        pass
    with watched(config.store_path) as (_, watch):
        assert settled(watch) == "ok"
    assert results(config.store_path) == ["ok"]


def test_jobs_wait_while_the_store_cannot_be_trusted(tmp_path: Path) -> None:
    rig = JobRig(tmp_path)
    asked: list[bool] = []
    released = threading.Event()

    def is_held() -> bool:
        asked.append(True)
        return not released.is_set()

    try:
        rig.session("a")
        rig.start(is_held=is_held)
        rig.wait(lambda: len(asked) >= 2)
        assert rig.jobs() == []
        released.set()
        rig.wait_for("done", "done", "done", "done")
    finally:
        rig.close()


# ---- files -----------------------------------------------------------------------------------------------------------


def test_a_store_that_is_unlinked_is_noticed_and_can_be_saved_as_the_message_says(path: Path, tmp_path: Path) -> None:
    with watched(path, ends_in_order=False) as (store, watch):
        assert watch.health.state == "ok"
        for suffix in ("", "-wal", "-shm"):
            path.with_name(path.name + suffix).unlink()
        store.insert("links", {"name": "boom", "kind": "can"})
        watch.look()
        assert watch.health.state == "missing"
        commands = re.search(r"`(cp [^`]*)`", watch.health.text)
        assert commands is not None
        (tmp_path / "rescue").mkdir()
        subprocess.run(commands[1], shell=True, check=True, cwd=tmp_path / "rescue")
    with contextlib.closing(sqlite3.connect(tmp_path / "rescue" / "saved.sqlite")) as saved:
        assert saved.execute("SELECT name FROM links").fetchall() == [("boom",)]
        assert saved.execute("PRAGMA integrity_check").fetchall() == [("ok",)]


@pytest.mark.parametrize("suffix", ["", "-wal", "-shm"])
def test_a_file_of_the_store_that_another_takes_the_place_of_is_noticed_until_it_is_back(
    path: Path, suffix: str
) -> None:
    with watched(path) as (_, watch):
        file = path.with_name(path.name + suffix)
        aside = file.with_name("aside")
        file.rename(aside)
        watch.look()
        assert watch.health.state == "missing"
        file.write_bytes(aside.read_bytes())
        watch.look()
        assert watch.health.state == "replaced"
        assert str(file) in watch.health.text
        assert "move the file back" in watch.health.text
        aside.rename(file)
        watch.look()
        assert (watch.health.state, watch.health.text) == ("ok", "")


def test_a_store_that_is_overwritten_by_a_copy_of_itself_is_damaged_and_checked_at_the_next_start(path: Path) -> None:
    def store_events(store: Store, count: int) -> None:
        store.insert_records([DeviceEvent("boom", at(k), EventKind.WARNING, "text " * 40, k) for k in range(count)])
        store._db.conn.execute("PRAGMA wal_checkpoint(TRUNCATE)")

    with watched(path, ends_in_order=False) as (store, watch):  # as the daemon does with a damaged store
        store_events(store, 500)
        copy = path.read_bytes()
        store_events(store, 2000)
        watch.look()
        assert watch.health.state == "ok"
        path.write_bytes(copy)  # as `cp` does: the file keeps its identity
        for _ in range(2):
            watch.look()
            assert watch.health.state == "damaged"
            assert "another program has overwritten it" in watch.health.text
    with watched(path) as (_, watch):
        assert settled(watch) in ("ok", "damaged")
    assert results(path)


def test_the_log_of_a_store_that_is_a_link_is_watched_and_saved_too(path: Path, tmp_path: Path) -> None:
    disk = tmp_path / "larger_disk"
    disk.mkdir()
    path.symlink_to(disk / "rigcal.sqlite")
    with watched(path) as (_, watch):
        (disk / "rigcal.sqlite-wal").rename(disk / "aside")
        watch.look()
        assert watch.health.state == "missing"
        assert "saved.sqlite-wal" in watch.health.text


def test_a_reader_that_wants_the_daemons_store_refuses_another_file_of_that_name(path: Path) -> None:
    with watched(path) as (store, _):
        ours = store.files.database
        with Reader(path, ours) as reader:
            assert reader.boots()
    path.rename(path.with_name("aside"))
    Store(path).close()
    assert FileIdentity.of(path) != ours
    with pytest.raises(StoreError, match="not the store that the daemon writes to"):
        Reader(path, ours)


@pytest.mark.slow
def test_a_job_does_not_work_on_a_store_that_took_the_place_of_the_daemons(tmp_path: Path) -> None:
    rig = JobRig(tmp_path)
    (tmp_path / "other").mkdir()
    other = JobRig(tmp_path / "other")
    try:
        rig.session("a")
        other.session("a")
        other.close()
        path = rig.config.store_path
        path.rename(tmp_path / "aside")
        other.config.store_path.rename(path)
        rig.start(real=True)
        rig.wait_for("interrupted", "queued", "queued", "queued")
        assert rig.job(1)["attempts"] == 0  # it is offered again when the file is back
        assert "not the store that the daemon writes to" in rig.job(1)["error"]
    finally:
        rig.close()


@pytest.mark.slow
def test_a_job_during_which_the_store_vanishes_waits_and_is_done_once_the_file_is_back(tmp_path: Path) -> None:
    rig = JobRig(tmp_path)
    path, aside = rig.config.store_path, tmp_path / "aside"
    try:
        rig.session("a")
        path.rename(aside)  # after the last look at it, so jobs are not held
        rig.start(real=True)
        rig.wait_for("interrupted", "queued", "queued", "queued")
        assert "there is no store" in rig.job(1)["error"] or "not the store" in rig.job(1)["error"]
        assert (rig.job(1)["attempts"], rig.job(1)["interruptions"]) == (0, 1)
        rig.stop()
        aside.rename(path)
        rig.start()
        rig.wait_for("done", "done", "done", "done")
    finally:
        rig.close()


# ---- room ------------------------------------------------------------------------------------------------------------


def test_a_disk_that_fills_up_is_seen_before_it_is_full(tmp_path: Path) -> None:
    with watched(tmp_path / "rigcal.sqlite") as (_, watch):
        assert watch.health.free_bytes
    with (
        small_disk(tmp_path / "disk", 4096) as disk,
        watched(disk / "rigcal.sqlite", ends_in_order=False) as (_, watch),
    ):
        before = watch.health.free_bytes
        fill(disk)
        watch.look()
        assert watch.health.is_low
        assert before
        assert watch.health.free_bytes == 0


# ---- the daemon ------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def running(tmp_path: Path, captures: Sequence[LinkItem] = ()) -> Iterator[tuple[Config, Daemon]]:
    config = Config(rig="swdt82", state_directory=tmp_path)
    rig = SOURCE.rig
    store = Store(config.store_path)
    parts = Parts("live", rig, SOURCE.text, SystemClock(), [ListLink("boom", captures)], {}, joiner(config, rig))
    try:
        daemon = Daemon(config, store, parts)
    except CommandError:
        store.close()
        raise
    with run_daemon(daemon, store):
        yield config, daemon


def test_the_status_of_a_running_daemon_says_that_its_store_is_gone(tmp_path: Path) -> None:
    with running(tmp_path) as (config, daemon):
        told = request(config.socket_path, "status")
        assert told["store"] == str(config.store_path)
        assert told["store_health"]["state"] == "ok"
        config.store_path.rename(tmp_path / "aside")
        wait_until(lambda: request(config.socket_path, "status")["store_health"]["state"] == "missing")
        assert daemon.store_health.state == "missing"


def test_lists_neither_fail_inside_the_daemon_nor_come_from_another_file_when_the_store_is_gone(tmp_path: Path) -> None:
    with running(tmp_path) as (config, _):
        assert request(config.socket_path, "session.list") == []
        config.store_path.rename(tmp_path / "aside")
        for command in ("session.list", "jobs.list"):
            with pytest.raises(
                CommandError, match="replaced or removed while the daemon ran; `rigcal status` shows what to do"
            ):
                request(config.socket_path, command)
        shutil.copy(tmp_path / "aside", config.store_path)
        with pytest.raises(
            CommandError, match="replaced or removed while the daemon ran; `rigcal status` shows what to do"
        ):
            request(config.socket_path, "session.list")


def test_a_store_that_is_gone_hides_neither_its_alarm_nor_anything_else_while_a_session_is_open(tmp_path: Path) -> None:
    with running(tmp_path) as (config, _):
        request(config.socket_path, "setup.new", {"id": "S1"})
        request(config.socket_path, "session.start", {"prism": "r"})
        config.store_path.rename(tmp_path / "aside")
        wait_until(lambda: request(config.socket_path, "status")["alarms"]["active"])
        status = request(config.socket_path, "status")
        assert [alarm["kind"] for alarm in status["alarms"]["active"]] == ["store_unsound"]
        assert (status["session"]["state"], status["unreadable"].get("session")) == ("open", None)
        assert status["acquisition"]["links"][0]["name"] == "boom"


def test_sessions_of_a_file_that_took_the_store_s_place_are_not_shown(tmp_path: Path) -> None:
    with running(tmp_path) as (config, _):
        request(config.socket_path, "setup.new", {"id": "S1"})
        request(config.socket_path, "session.start", {"prism": "r"})
        Store(tmp_path / "another.sqlite").close()
        (tmp_path / "another.sqlite").rename(config.store_path)
        for command in ("session.list", "jobs.list"):
            with pytest.raises(CommandError, match=r"not the store that the daemon writes to.*`rigcal status`"):
                request(config.socket_path, command)


def test_a_damaged_table_of_alarms_keeps_no_daemon_from_starting(tmp_path: Path) -> None:
    with running(tmp_path) as (config, _):
        pass
    tear(config.store_path, "alarms", "alarms_one_active")
    with running(tmp_path) as (config, daemon):
        assert request(config.socket_path, "status")["acquisition"]["links"][0]["name"] == "boom"
        wait_until(lambda: daemon.store_health.state == "damaged")


@pytest.mark.parametrize(
    "names",
    [
        ("gaps", "sqlite_autoindex_gaps_1"),
        ("device_events",),
        ("device_events_of_states",),
        ("daemon_runs",),
        ("calibration_sessions", "calibration_sessions_one_open"),
        ("jobs", "jobs_by_state"),
    ],
)
def test_a_damaged_table_keeps_no_daemon_from_starting_and_acquiring(tmp_path: Path, names: tuple[str, ...]) -> None:
    opened = DeviceEvent("boom", at(0.0), EventKind.LINK_UP, "boom: open")
    frames = [opened, *(frame(number, float(number)) for number in range(3))]
    with running(tmp_path, frames) as (config, _):
        wait_until(lambda: len(table(config.store_path, "raw_chunks")) > 0)
        request(config.socket_path, "setup.new", {"id": "S1"})
        request(config.socket_path, "session.start", {"prism": "r"})
    before = len(table(config.store_path, "raw_chunks"))
    tear(config.store_path, *names)
    with running(tmp_path, frames) as (config, daemon):
        wait_until(lambda: daemon.store_health.state == "damaged")
        wait_until(lambda: len(table(config.store_path, "raw_chunks")) > before)
        wait_until(lambda: request(config.socket_path, "status")["alarms"]["active"])
        status = request(config.socket_path, "status")
        assert "store_unsound" in [alarm["kind"] for alarm in status["alarms"]["active"]]
        assert status["acquisition"]["error"] is None


def test_no_command_that_would_change_a_store_whose_file_is_gone_is_carried_out(tmp_path: Path) -> None:
    with running(tmp_path) as (config, daemon):
        request(config.socket_path, "setup.new", {"id": "S1"})
        config.store_path.rename(tmp_path / "aside")
        wait_until(lambda: daemon.store_health.state == "missing")
        for command, arguments in [
            ("session.start", {"prism": "r"}),
            ("guide.start", {}),
            ("setup.new", {"id": "S2"}),
            ("session.accept", {"id": "s001-r"}),
            ("session.reject", {"id": "s001-r"}),
            ("jobs.retry", {"id": 1}),
            ("model.accept", {"id": 1}),
            ("model.zeros-checked", {}),
            ("store.prune", {"days": 1}),
            ("store.redecode", {"session": "s001-r"}),
        ]:
            with pytest.raises(CommandError, match=r"not carried out: .*the file that rigcal writes to is gone") as no:
                request(config.socket_path, command, arguments)
            assert no.value.status == REFUSED
        assert [setup["id"] for setup in request(config.socket_path, "setup.list")] == ["S1"]


def test_every_exception_from_that_is_a_command_that_changes_something() -> None:
    assert {name for name, command in COMMANDS.items() if command.changes}.issuperset(UNGUARDED)


@pytest.mark.parametrize(("command", "state"), [("session.stop", "closed"), ("session.abort", "aborted")])
def test_a_session_can_be_ended_while_the_store_s_file_is_gone_and_the_answer_says_what_may_be_lost(
    tmp_path: Path, command: str, state: str
) -> None:
    with running(tmp_path) as (config, daemon):
        request(config.socket_path, "setup.new", {"id": "S1"})
        request(config.socket_path, "session.start", {"prism": "r", "id": "first"})
        config.store_path.rename(tmp_path / "aside")
        wait_until(lambda: daemon.store_health.state == "missing")
        answer = request(config.socket_path, command)
        assert (answer["id"], answer["state"]) == ("first", state)
        assert "may be lost when the daemon stops" in answer["advice"][-1]
        assert "the file that rigcal writes to is gone" in answer["advice"][-1]
        assert request(config.socket_path, "status")["session"] is None


def test_a_damaged_table_hides_nothing_else_from_status(tmp_path: Path) -> None:
    with running(tmp_path) as (config, _):
        pass
    tear(config.store_path, "device_events")
    with running(tmp_path) as (config, _):
        status = request(config.socket_path, "status")
        assert "malformed" in status["unreadable"]["events"]
        assert status["acquisition"]["links"][0]["name"] == "boom"
        shown = CliRunner().invoke(main, ["status", "--socket", str(config.socket_path)])
        assert "events: cannot be read from the store" in shown.output


def test_damage_that_is_met_after_an_orderly_end_is_an_alarm_holds_jobs_and_is_searched_for_at_the_next_start(
    tmp_path: Path,
) -> None:
    with running(tmp_path) as (config, _):
        pass
    tear(config.store_path, "device_events")
    with running(tmp_path) as (config, daemon):
        assert "malformed" in request(config.socket_path, "status")["unreadable"]["events"]
        wait_until(lambda: request(config.socket_path, "status")["alarms"]["active"])
        status = request(config.socket_path, "status")
        assert status["store_health"]["state"] == "damaged"
        assert "restore the store from a backup" in status["store_health"]["text"]
        assert [alarm["kind"] for alarm in status["alarms"]["active"]] == ["store_unsound"]
        assert daemon._are_jobs_held()
    with running(tmp_path) as (config, _):
        wait_until(lambda: request(config.socket_path, "status")["store_health"]["state"] == "damaged")
    assert any(result not in (None, "ok") for result in results(config.store_path))
