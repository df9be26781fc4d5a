"""What may go goes, the oldest first; no session, nothing that was captured in it, and nothing new ever does."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.store import Reader, Store
from daemon.store.queries.device_states import device_states
from daemon.store.upkeep import retention
from daemon.store.upkeep.housekeeping import Housekeeping, Keeping
from daemon.store.upkeep.retention import Retention, Room, cutoff_ns, room
from drivers.canopen.supervision import VOIDS
from drivers.clock import NS_PER_S, ManualClock, Stamp
from drivers.readings import Capture, DeviceEvent, EventKind, Fix, Reading
from tests.daemon.support.damage import small_disk
from tests.daemon.support.store import at, fix, frame, reading, table

MINUTE_S = 60.0
NOW_NS = 1_800_000_000 * NS_PER_S  # of the wall clock, at 0 s
DAY_S = 86_400.0


@pytest.fixture
def store(path: Path) -> Iterator[Store]:
    with contextlib.closing(Store(path)) as store:
        store.declare_channels({"theta1": "deg"}, {"valve": "mA"})
        yield store


def fill(store: Store, minutes: int, begin_s: float = 0.0, boot: str = "boot-a", utc_ns: int = NOW_NS) -> None:
    """A chunk a minute, with what was decoded of it."""

    def when(seconds: float) -> Stamp:
        stamp = at(begin_s + seconds, boot)
        return replace(stamp, utc_ns=stamp.utc_ns - at(0.0).utc_ns + utc_ns)

    with store.transaction():
        for minute in range(minutes):
            second = minute * MINUTE_S
            captures = [replace(frame(n), stamp=when(second + n)) for n in range(3)]
            store.mark_decoded(store.append_captures(captures))
            records: list[Reading | Fix] = [
                replace(reading(channel, 0.0, 1.0, unit), stamp=when(second))
                for channel, unit in (("theta1", "deg"), ("valve", "mA"))
            ]
            store.insert_records([*records, replace(fix(0.0), stamp=when(second), last_byte=when(second))])


def session(store: Store, name: str, since: Stamp, until: Stamp | None, state: str = "closed") -> None:
    about = {
        "id": name,
        "rig": "swdt82",
        "prism": "r",
        "operator": "",
        "state": state,
    }
    ended = {} if until is None else store.instant(until, "ended_")
    store.insert("calibration_sessions", about | {"kind": "static_poses"} | store.instant(since, "started_") | ended)


def minutes_left(path: Path, boot: str = "boot-a") -> list[int]:
    with Reader(path) as reader:
        captures: list[Capture] = [c for c in reader.captures() if c.stamp.boot_id == boot]
    return sorted({round((c.stamp.monotonic_ns - at(0.0).monotonic_ns) / NS_PER_S) // 60 for c in captures})


def retention_of(store: Store, now_ns: int = NOW_NS) -> Retention:
    clock = ManualClock()
    clock.set(Stamp(now_ns, 0, "boot-a"))
    return Retention(store, clock)


def delete_all(store: Store, older_than_ns: int | None = None, now_ns: int = NOW_NS) -> int:
    retention = retention_of(store, now_ns)
    return sum(1 for _ in iter(lambda: retention.delete_oldest(older_than_ns), None))


def test_all_but_sessions_and_the_last_hour_may_go_for_room(path: Path, store: Store) -> None:
    fill(store, 200)
    session(store, "s1", at(50 * MINUTE_S), at(60 * MINUTE_S))
    session(store, "s2", at(90 * MINUTE_S), at(95 * MINUTE_S), "aborted")
    assert delete_all(store) > 0
    left = minutes_left(path)
    in_sessions = [*range(49, 61), *range(89, 96)]  # a minute before, and a little after
    assert left[: len(in_sessions)] == in_sessions
    assert left[len(in_sessions) :] == [*range(139, 200)]
    for name in ("joint_samples", "signals", "fixes"):
        rows = {(row["monotonic_ns"] - at(0.0).monotonic_ns) // (60 * NS_PER_S) for row in table(path, name)}
        assert rows >= set(left)
        assert not rows & {*range(45), *range(65, 88), *range(100, 135)}
    with contextlib.closing(sqlite3.connect(path)) as db:
        assert db.execute("PRAGMA foreign_key_check").fetchall() == []


def test_what_was_captured_in_an_open_session_stays_in_every_boot(path: Path, store: Store) -> None:
    fill(store, 30)
    session(store, "s1", at(20 * MINUTE_S), None, "open")
    fill(store, 300, boot="boot-b")
    delete_all(store)
    assert minutes_left(path) == [*range(19, 30)]
    assert minutes_left(path, "boot-b") == [*range(300)]


def test_what_a_device_reports_again_and_again_goes_and_its_last_state_stays_known(path: Path, store: Store) -> None:
    fill(store, 200)
    session(store, "s1", at(50 * MINUTE_S), at(60 * MINUTE_S))
    reported = [
        (EventKind.EMERGENCY, f"node 32: device hardware; {VOIDS}", 0x5000),
        (EventKind.EMERGENCY_CLEARED, "node 32: all errors have cleared", 0),
        (EventKind.ALARM, "node 32: position error", 1),
        (EventKind.ALARM, "theta1 (node 32): cannot be set up", None),
        (EventKind.PRESET_JUMP, "a jump", None),
    ]
    times = [minute * MINUTE_S + second for minute in range(200) for second in (0.5, 1.0, 1.5)]
    store.insert_records([DeviceEvent("theta1", at(t), *event) for t in times[:300] for event in reported])
    other = [DeviceEvent("theta1", at(t), EventKind.EMERGENCY, "node 32: temperature", 0x4000) for t in times[300:]]
    store.insert_records(
        [*other, *(DeviceEvent("theta2", at(t), EventKind.BOOT_UP, "node 33 has booted") for t in times)]
    )
    before = at(300 * MINUTE_S)
    with Reader(path) as reader:
        states = device_states(reader, before)
    delete_all(store)
    with Reader(path) as reader:
        assert device_states(reader, before) == states
        assert device_states(reader, at(55 * MINUTE_S)), "what a session needs"
    left = [(row["device"], row["kind"], row["code"]) for row in table(path, "device_events")]
    in_session = 3 * 16  # a minute before, and a few after
    assert left.count(("theta1", "alarm", None)) == left.count(("theta1", "preset_jump", None)) == 300
    assert 3 * 11 < left.count(("theta1", "emergency", 0x5000)) < in_session
    assert 3 * 11 < left.count(("theta1", "alarm", 1)) < in_session
    assert 3 * 60 < left.count(("theta2", "boot_up", None)) < 3 * 62 + in_session


def test_only_what_is_older_goes_by_age(path: Path, store: Store) -> None:
    fill(store, 100)
    fill(store, 100, begin_s=10 * DAY_S)
    assert delete_all(store, NOW_NS + round(5 * DAY_S * NS_PER_S)) == 5  # steps of 20 chunks
    assert minutes_left(path)[0] == round(10 * DAY_S / 60)
    assert delete_all(store, NOW_NS + round(5 * DAY_S * NS_PER_S)) == 0


def test_captures_of_a_clock_that_was_not_set_are_as_old_as_those_after_them(path: Path, store: Store) -> None:
    fill(store, 5, utc_ns=0)  # 1970, then NTP
    fill(store, 200, begin_s=400.0)
    assert delete_all(store, NOW_NS) == 0
    assert minutes_left(path)[:5] == [0, 1, 2, 3, 4]
    assert delete_all(store, NOW_NS + round(3600 * NS_PER_S)) > 0
    assert minutes_left(path)[0] == 60


def test_captures_of_a_clock_that_was_not_set_for_days_go_as_well(path: Path, store: Store) -> None:
    fill(store, retention.LOOKED_AT + 50, boot="boot of 1970", utc_ns=0)
    fill(store, 100, begin_s=10 * DAY_S)
    assert delete_all(store, NOW_NS + round(5 * DAY_S * NS_PER_S)) == 0, "no older than what follows"
    fill(store, 100, begin_s=20 * DAY_S)
    assert delete_all(store, NOW_NS + round(15 * DAY_S * NS_PER_S)) > 0
    assert minutes_left(path)[0] == round(20 * DAY_S / 60)
    assert minutes_left(path, "boot of 1970") == []


@pytest.mark.parametrize("wrong_by_days", [-150, -10_000, 150])
def test_captures_of_a_boot_are_as_old_as_the_monotonic_clock_says_whatever_the_clock_was_set_to(
    path: Path, store: Store, wrong_by_days: int
) -> None:
    fill(store, 240, utc_ns=NOW_NS + round(wrong_by_days * DAY_S * NS_PER_S))
    fill(store, 60, begin_s=240 * MINUTE_S)  # the clock was set
    now_ns = NOW_NS + 5 * 3600 * NS_PER_S
    assert retention_of(store).oldest_ns() == pytest.approx(NOW_NS, abs=60 * NS_PER_S)
    assert delete_all(store, now_ns - round(30 * DAY_S * NS_PER_S)) == 0
    assert minutes_left(path) == [*range(300)]
    assert delete_all(store, now_ns - 3 * 3600 * NS_PER_S) > 0
    assert minutes_left(path)[0] == 120


@pytest.mark.parametrize("wrong_by_days", [-150, -300, -10_000, 3650])
def test_a_clock_that_is_set_wrong_at_the_end_of_a_boot_makes_its_captures_neither_older_nor_younger(
    path: Path, store: Store, wrong_by_days: int
) -> None:
    fill(store, 240)
    fill(store, 2, begin_s=240 * MINUTE_S, utc_ns=NOW_NS + round(wrong_by_days * DAY_S * NS_PER_S))
    fill(store, 120, begin_s=300 * MINUTE_S, boot="boot-b")
    now_ns = NOW_NS + 8 * 3600 * NS_PER_S
    assert retention_of(store).oldest_ns() == pytest.approx(NOW_NS, abs=60 * NS_PER_S)
    assert delete_all(store, now_ns - round(30 * DAY_S * NS_PER_S)) == 0
    assert minutes_left(path) == [*range(242)]
    assert delete_all(store, now_ns - 5 * 3600 * NS_PER_S) > 0
    assert minutes_left(path)[0] == 180


def test_captures_of_a_wrong_clock_are_no_older_where_those_before_them_lie_in_a_session(
    path: Path, store: Store
) -> None:
    fill(store, 240)
    fill(store, 9, begin_s=240 * MINUTE_S, utc_ns=NOW_NS - round(150 * DAY_S * NS_PER_S))
    fill(store, 120, begin_s=300 * MINUTE_S, boot="boot-b")
    session(store, "s1", at(60.0), at(240 * MINUTE_S))
    assert delete_all(store, NOW_NS - round(30 * DAY_S * NS_PER_S)) == 0
    assert minutes_left(path) == [*range(249)]


@pytest.mark.parametrize("behind_s", [45 * MINUTE_S, 3 * DAY_S])
def test_a_newest_clock_that_is_behind_makes_no_capture_as_old_as_a_wrong_clock_said(
    path: Path, store: Store, behind_s: float
) -> None:
    fill(store, 5, utc_ns=NOW_NS - round(200 * DAY_S * NS_PER_S))
    fill(store, 55, begin_s=5 * MINUTE_S)  # the clock was set
    fill(store, 1, begin_s=60 * MINUTE_S, boot="boot-b", utc_ns=NOW_NS - round(behind_s * NS_PER_S))
    session(store, "s1", at(6 * MINUTE_S), at(20 * MINUTE_S))
    newest_ns = NOW_NS + round((60 * MINUTE_S - behind_s) * NS_PER_S)
    assert delete_all(store, newest_ns - round(30 * DAY_S * NS_PER_S)) == 0
    assert minutes_left(path) == [*range(60)]


def test_a_clock_that_was_set_after_the_newest_capture_tells_how_old_captures_are(path: Path, store: Store) -> None:
    """A computer without a battery for its clock: each boot begins at the same wrong date."""
    wrong_ns = NOW_NS - round(200 * DAY_S * NS_PER_S)
    fill(store, 30, utc_ns=wrong_ns)
    fill(store, 90, begin_s=30 * MINUTE_S)  # the clock was set
    fill(store, 10, boot="boot-b", utc_ns=wrong_ns)
    now_ns = NOW_NS + round(3 * DAY_S * NS_PER_S)
    assert delete_all(store, now_ns - round(30 * DAY_S * NS_PER_S), now_ns) == 0
    assert minutes_left(path) == [*range(120)]


@pytest.mark.parametrize("is_newest", [True, False])
def test_captures_of_a_clock_that_is_behind_are_no_older_than_a_session_before_them(
    path: Path, store: Store, is_newest: bool
) -> None:
    day_ns = round(DAY_S * NS_PER_S)
    fill(store, 10)
    begin, end = (replace(at(s), utc_ns=NOW_NS + round(s * NS_PER_S)) for s in (0.0, 10 * MINUTE_S))
    session(store, "s1", begin, end)
    fill(store, 100, boot="boot-b", utc_ns=NOW_NS - 200 * day_ns)  # and it was never set
    if not is_newest:
        fill(store, 100, boot="boot-c", utc_ns=NOW_NS + day_ns)
    for later_days, is_kept in ((2, True), (40, False)):
        now_ns = NOW_NS + later_days * day_ns
        delete_all(store, now_ns - 30 * day_ns, now_ns)
        assert (minutes_left(path, "boot-b") == [*range(100)]) is is_kept


@pytest.mark.parametrize("wrong_by_days", [-150, 150])
def test_captures_are_kept_while_the_newest_clock_is_wrong(path: Path, store: Store, wrong_by_days: int) -> None:
    wrong_ns = NOW_NS + round(wrong_by_days * DAY_S * NS_PER_S)
    fill(store, 120)
    fill(store, 120, boot="boot-b", begin_s=120 * MINUTE_S, utc_ns=wrong_ns)
    assert delete_all(store, min(wrong_ns, NOW_NS) - round(30 * DAY_S * NS_PER_S)) == 0
    assert (minutes_left(path), minutes_left(path, "boot-b")) == ([*range(120)], [*range(120, 240)])


def test_what_waits_to_be_decoded_stays(path: Path, store: Store) -> None:
    waiting = store.append_captures([frame(0, 0.0)])
    fill(store, 120, begin_s=10.0)
    delete_all(store)
    assert store.undecoded_chunks() == waiting
    assert len(table(path, "raw_chunks")) == 1 + 61


def test_a_fix_that_an_observation_names_stays(path: Path, store: Store) -> None:
    fill(store, 100)
    session(store, "s1", at(90 * MINUTE_S), at(95 * MINUTE_S))
    observation = {"session_id": "s1", "fix_id": 1, "prism": "r", "x_mm": 0.0, "y_mm": 0.0, "z_mm": 0.0}
    observation |= {"moving": 0, "values_json": {}}
    store.insert("observations", observation | store.instant(at(0.0)))
    delete_all(store)
    assert table(path, "fixes")[0]["id"] == 1
    assert table(path, "observations")[0]["fix_id"] == 1


def test_freed_pages_are_used_again_and_are_room(path: Path, store: Store) -> None:
    fill(store, 400)
    before = room(store, 2**30)
    pages = store.pragma("page_count")
    delete_all(store)
    assert room(store, 2**30).inside_bytes > before.inside_bytes
    fill(store, 200, begin_s=DAY_S)
    assert store.pragma("page_count") <= pages + 5


def test_a_log_that_a_reader_keeps_is_no_reason_to_delete(
    path: Path, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retention, "KEPT_BYTES", 0)
    fill(store, 100)
    with Reader(path) as reader:
        left_open = reader.captures("boom")
        next(left_open)
        before = room(store, 2**30)
        fill(store, 100, begin_s=DAY_S)
        after = room(store, 2**30)
    grown = after.log_bytes - before.log_bytes
    assert grown > 0
    assert not Room(0, 0, after.log_bytes, grown).is_short


def test_deleting_reads_by_indexes(store: Store) -> None:
    fill(store, 3)
    statements = {
        retention._CHUNKS: (0, 0, 9, 9, 20, 0),
        retention._ROWS.format("joint_samples"): (0, 0, 9, 9, 20),
        retention._ROWS.format("signals"): (0, 0, 9, 9, 20),
        retention._ROWS.format("decode_failures"): (0, 0, 9, 9, 20),
        retention._FIXES: (0, 0, 9, 9, 20, "ts1"),
        retention._NEWEST: (),
    }
    for sql, parameters in statements.items():
        plan = str(store.rows(f"EXPLAIN QUERY PLAN {sql}", parameters))
        assert "SEARCH" in plan or "USING COVERING INDEX" in plan
        assert "SCAN observations" not in plan
        assert not any(f"SCAN {name}'" in plan for name in ("raw_chunks", "joint_samples", "signals", "fixes")), plan
        assert "TEMP B-TREE" not in plan


# ---- as the daemon does it -------------------------------------------------------------------------------------------


def keeping(path: Path, **changes: object) -> Keeping:
    kept = Keeping(keep_days=None, free_bytes=0, models=path.parent / "models", backup_directory=None, backups=2)
    return replace(kept, **changes)  # type: ignore[arg-type]


def run(housekeeping: Housekeeping) -> int:
    return sum(1 for _ in iter(housekeeping.step, False))


@pytest.mark.parametrize("minutes", [30, 90])
def test_the_log_says_of_want_of_room_what_is_true(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, minutes: int
) -> None:
    with small_disk(tmp_path / "small", 16_000) as place:
        path = place / "rigcal.sqlite"
        with contextlib.closing(Store(path)) as store:
            store.declare_channels({"theta1": "deg"}, {"valve": "mA"})
            fill(store, minutes)
            session(store, "s1", at(0.0), None, "open")
            usage = shutil.disk_usage(place)
            (place / "ballast").write_bytes(bytes(usage.free - round(0.08 * usage.total)))
            housekeeping = Housekeeping(store, ManualClock(at(90 * MINUTE_S)), keeping(path, free_bytes=2**60))
            run(housekeeping)
            assert housekeeping.state.has_nothing_left
            assert minutes_left(path) == list(range(minutes))
            said = [record.getMessage() for record in caplog.records if "space" in record.getMessage()]
            assert said == [f"{path}: little space is left, and nothing more may be deleted"]


def test_want_of_room_deletes_the_oldest_and_tells(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with small_disk(tmp_path / "small", 16_000) as place:
        path = place / "rigcal.sqlite"
        with contextlib.closing(Store(path)) as store:
            store.declare_channels({"theta1": "deg"}, {"valve": "mA"})
            fill(store, 400)
            clock = ManualClock(at(400 * MINUTE_S))
            wanted = keeping(path, free_bytes=2**60)  # of which a tenth of the disk counts
            easy = Housekeeping(store, clock, wanted)
            run(easy)
            assert not easy.state.is_short
            usage = shutil.disk_usage(place)
            (place / "ballast").write_bytes(bytes(usage.free - round(0.08 * usage.total)))
            housekeeping = Housekeeping(store, clock, wanted)
            assert housekeeping.step()
            assert housekeeping.state.is_short
            assert not housekeeping.state.has_nothing_left
            run(housekeeping)
            assert housekeeping.state.deleted_until_utc_ns is not None
            first = next(record.getMessage() for record in caplog.records if "space" in record.getMessage())
            assert first == f"{path}: little space is left; the oldest captures outside sessions are deleted"
            assert minutes_left(path)[-1] == 399
            if housekeeping.state.is_short:
                assert housekeeping.state.has_nothing_left
                assert minutes_left(path)[0] in (400 - 62, 400 - 61)  # two minutes may be packed in one chunk
            else:  # before all was deleted that might go
                assert 0 < minutes_left(path)[0] <= 400 - 61


def test_age_deletes_at_most_a_week_of_records_a_day_whatever_the_clock_says(path: Path, store: Store) -> None:
    for day in range(20):
        fill(store, 3, begin_s=day * DAY_S)
    clock = ManualClock(
        Stamp(NOW_NS + round(50 * 365 * DAY_S) * NS_PER_S, 0, "boot-a")
    )  # a clock that runs ahead by decades
    week = 7 * 24 * 60
    for _ in range(3):  # restarts
        run(Housekeeping(store, clock, keeping(path, keep_days=30.0)))
        assert minutes_left(path)[0] in range(week, week + 3)  # by whole chunks, which were packed
    clock.advance(DAY_S)
    run(Housekeeping(store, clock, keeping(path, keep_days=30.0)))
    assert minutes_left(path)[0] in range(2 * week, 2 * week + 3)


def test_a_clock_that_is_not_set_deletes_nothing() -> None:
    assert cutoff_ns(10**9 * NS_PER_S, 30.0) is None
    assert cutoff_ns(1_800_000_000 * NS_PER_S, 30.0) == (1_800_000_000 - 30 * 86_400) * NS_PER_S
