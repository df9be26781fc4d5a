"""The check for damage: when it is made, what it finds, and what neither ends it nor is taken for a sound store."""

from __future__ import annotations

import contextlib
import resource
import shutil
import sqlite3
import threading
from pathlib import Path

import pytest

from daemon.store import Store, health
from daemon.store.health import StoreWatch
from drivers.clock import ManualClock, Stamp
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.damage import tear
from tests.daemon.support.sessions import disk_fails
from tests.daemon.support.store import at, fix
from tests.daemon.support.watch import results, settled, watched


class FaultyClock(ManualClock):
    """Fails the check for damage, and nothing else."""

    is_faulty = True

    def now(self) -> Stamp:
        if self.is_faulty and threading.current_thread().name == "store-check":
            raise ArithmeticError("a fault")
        return super().now()


def test_a_store_is_checked_after_an_unclean_end_and_not_after_an_orderly_one(path: Path) -> None:
    with watched(path):
        pass
    with watched(path, ends_in_order=False):
        assert results(path) == []
    with watched(path) as (_, watch):
        assert settled(watch) == "ok"
        assert results(path) == ["ok"]
    with watched(path):
        assert results(path) == ["ok"]


def damaged(path: Path) -> None:
    """A store whose run was killed, and one of whose indexes is torn."""
    with watched(path, ends_in_order=False) as (store, _):
        store.declare_channels({"theta1": "deg"}, {})
        store.insert_records([fix(n / 10) for n in range(100)])
    shutil.copy(path, path.with_name("backup"))
    tear(path, "fixes_by_instant")


def test_damage_after_an_unclean_end_is_told_and_not_forgotten_by_the_next_start(path: Path) -> None:
    damaged(path)
    for _ in range(2):  # the first of them ends in order
        with watched(path) as (_, watch):
            assert settled(watch) == "damaged"
            text = watch.health.text
            assert str(path) in text
            assert "restore the store from a backup" in text
            assert watch.health.since == at(0)
    assert "ok" not in results(path)
    path.with_name("backup").replace(path)
    with watched(path) as (_, watch):
        assert settled(watch) == "ok"


def test_damage_that_is_reported_with_a_name_that_is_no_text_is_damage(path: Path) -> None:
    with watched(path, ends_in_order=False), contextlib.closing(sqlite3.connect(path)) as db:
        db.execute("CREATE TABLE torn (n INTEGER)")
        db.execute("INSERT INTO torn VALUES (NULL)")
        db.execute("PRAGMA writable_schema = ON")
        db.execute("UPDATE sqlite_schema SET sql = 'CREATE TABLE torn (n INTEGER NOT NULL)' WHERE name = 'torn'")
        db.commit()
    path.write_bytes(path.read_bytes().replace(b"torn", b"tor\xff"))
    with watched(path) as (_, watch):
        assert settled(watch) == "damaged"
        assert "Could not decode to UTF-8" in watch.health.text


def test_a_check_that_fails_by_a_fault_of_its_own_is_made_again_and_the_store_is_not_sound_before(
    path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(health, "RETRY_S", 0.05)
    monkeypatch.setattr(health, "AT_START_S", 0.2)
    with watched(path, ends_in_order=False):
        pass
    clock = FaultyClock(at(0))
    with watched(path, clock=clock) as (_, watch):
        assert watch.health.state == "checking"
        assert sum("the check for damage has failed" in record.message for record in caplog.records) == 1
        clock.is_faulty = False
        assert settled(watch) == "ok"
    assert results(path) == ["ok"]


def test_a_check_that_a_stop_ends_is_made_again(path: Path) -> None:
    with watched(path, ends_in_order=False):
        pass
    with contextlib.closing(Store(path)) as store:
        store.begin_run(at(0))
        watch = StoreWatch(store, ManualClock(at(0)))
        watch.stop()  # as when the stop comes while it runs
        watch.start()
        wait_until(lambda: results(path) == [None])
        store.end_run(at(1))
    with watched(path) as (_, watch):
        assert settled(watch) == "ok"
        assert results(path) == [None, "ok"]


@pytest.mark.slow
def test_a_long_check_ends_at_a_stop(path: Path) -> None:
    with watched(path, ends_in_order=False) as (store, _), store.transaction() as db:
        db.execute("CREATE TABLE long (n INTEGER PRIMARY KEY, text TEXT NOT NULL UNIQUE) STRICT")
        db.execute(
            "WITH RECURSIVE c(n) AS (VALUES (1) UNION ALL SELECT n + 1 FROM c WHERE n < 500000) "
            "INSERT INTO long SELECT n, printf('%032d', (n * 7919) % 500009) FROM c"
        )
    with contextlib.closing(Store(path)) as store:
        store.begin_run(at(0))
        watch = StoreWatch(store, ManualClock(at(0)))
        starting = threading.Thread(target=watch.start)
        starting.start()
        wait_until(lambda: watch._connection is not None)
        watch.stop()
        starting.join()
        assert watch._check is not None
        assert not watch._check.is_alive()
    assert results(path) == [None]


def test_a_check_that_lacks_a_descriptor_finds_no_damage_and_is_made_once_there_is_one(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(health, "RETRY_S", 0.05)
    monkeypatch.setattr(health, "AT_START_S", 0.2)
    with watched(path, ends_in_order=False):
        pass
    with contextlib.closing(Store(path)) as store:
        store.begin_run(at(0))
        watch = StoreWatch(store, ManualClock(at(0)))
        before = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
        try:
            watch.start()
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
        assert watch.health.state == "checking"
        assert settled(watch) == "ok"
    assert results(path) == ["ok"]


def test_damage_is_found_although_the_disk_takes_no_row_about_the_check(path: Path) -> None:
    damaged(path)
    with contextlib.closing(Store(path)) as store:
        store.begin_run(at(0))
        watch = StoreWatch(store, ManualClock(at(0)))
        with disk_fails():
            watch.start()
            assert settled(watch) == "damaged"
        watch.stop()
