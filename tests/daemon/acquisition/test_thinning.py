"""Outside sessions one reading a second is stored, and whatever changes its status; in sessions everything is."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path
from threading import Event

import pytest

from daemon.acquisition.acquisition import Acquisition
from daemon.acquisition.thinning import Thinning
from daemon.store.store import Store
from drivers.clock import NS_PER_S, Stamp, SystemClock
from drivers.readings import CanCapture, DecodeFailure, LinkItem, Reading, Record, Status
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.store import at, fix, reading, table


def outside(_: Stamp) -> bool:
    return False


def seconds_of(records: list[Record]) -> list[int]:
    """Into which second of the test each reading falls."""
    start_ns = at(0.0).monotonic_ns
    return [(r.stamp.monotonic_ns - start_ns) // NS_PER_S for r in records if isinstance(r, Reading)]


def test_one_reading_of_each_channel_and_one_fix_a_second_are_kept() -> None:
    records: list[Record] = []
    for n in range(500):
        records += [reading("theta1", n / 100, 1.0), reading("theta2", n / 100, 2.0)]
        records += [fix(n / 100)] if n % 10 == 0 else []
    kept = Thinning(outside).kept(records)
    assert seconds_of(kept) == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    assert len(kept) == 15


def test_in_a_session_and_only_there_all_are_kept() -> None:
    records = [reading("theta1", n / 100, 1.0) for n in range(500)]
    third_second = range(at(2.0).monotonic_ns, at(3.0).monotonic_ns)
    kept = Thinning(lambda record: record.stamp.monotonic_ns in third_second).kept(records)
    seconds = seconds_of(kept)
    assert [seconds.count(second) for second in range(5)] == [1, 1, 100, 1, 1]


def test_a_change_of_status_another_boot_and_all_that_is_no_reading_are_kept() -> None:
    alarm = reading("theta1", 0.02, None, status=Status.DEVICE_ALARM)
    failure = DecodeFailure("theta1", at(0.03), "cut off", b"1")
    again = reading("theta1", 0.04, 1.0)
    rebooted = Reading("theta1", Stamp(1, 1, "another"), 1.0, "deg")
    records = [reading("theta1", 0.0, 1.0), reading("theta1", 0.01, 1.0), alarm, failure, again, rebooted]
    assert Thinning(outside).kept(records) == [records[0], alarm, failure, again, rebooted]


def test_a_change_of_status_whose_first_commit_is_refused_is_stored_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One reading of an alarm amid many good ones, of which one a second is stored."""
    monkeypatch.setattr("daemon.acquisition.acquisition.RETRY_S", 0.02)
    store, clock = Store(tmp_path / "rigcal.sqlite"), SystemClock()
    store.begin_run(clock.now())
    store.declare_channels({"theta1": "deg"}, {})
    alarm, captures, refusals = 15, 30, iter([True])

    class Link:
        name, read_until = "boom", None

        def run(self, emit: Callable[[LinkItem], None], stop: Event) -> None:
            for number in range(captures):
                emit(CanCapture("boom", clock.now(), 0x181, bytes([number])))
                stop.wait(0.02)
            stop.wait()

    class Alarmed:
        def feed(self, capture: CanCapture) -> list[Record]:
            is_bad = capture.data[0] == alarm
            status = Status.DEVICE_ALARM if is_bad else Status.OK
            return [Reading("theta1", capture.stamp, None if is_bad else 1.0, "deg", status)]

        def tick(self, now: object) -> list[Record]:
            return []

    seen: list[Record] = []

    def refuse_once() -> None:
        if any(isinstance(r, Reading) and r.status is Status.DEVICE_ALARM for r in seen) and next(refusals, False):
            error = sqlite3.OperationalError("database is locked")
            error.sqlite_errorcode, error.sqlite_errorname = sqlite3.SQLITE_BUSY, "SQLITE_BUSY"
            raise error

    acquisition = Acquisition(
        [Link()],
        {"boom": Alarmed},
        store,
        clock,
        on_records=seen.extend,
        also_store=refuse_once,
        thinning=Thinning(lambda _: False),
    )
    acquisition.start()
    wait_until(lambda: len([r for r in seen if isinstance(r, Reading)]) == captures)
    assert acquisition.stop()
    statuses = [row["status"] for row in table(store.path, "joint_samples")]
    store.close()
    assert next(refusals, None) is None, "the disk has refused once"
    assert "device_alarm" in statuses
