"""The store keeps what was committed, refuses a second writer, and never lets a wrong type or NaN in."""

from __future__ import annotations

import contextlib
import logging
import os
import resource
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from daemon.store import WHOLE_DAEMON, Reader, Store, StoreBusyError, StoreError, connection
from daemon.store.rows import sql_value, stamp_of
from drivers.readings import (
    CanCapture,
    Capture,
    DecodeFailure,
    DeviceEvent,
    EventKind,
    Fix,
    Gap,
    GapReason,
    LockState,
    Reading,
    Status,
)
from tests.daemon.support.store import BOOT, at, fix, frame, reading, serial_bytes, table

HOLDER = """
import sys, time
from pathlib import Path
from daemon.store import Store
store = Store(Path(sys.argv[1]))
print("open", flush=True)
sys.stdin.read()
"""


# ---- opening ---------------------------------------------------------------------------------------------------------


def test_every_table_is_strict_and_commits_survive_power_loss(store: Store) -> None:
    tables = store.rows("SELECT name, strict FROM pragma_table_list WHERE schema = 'main' AND type = 'table'")
    ours = [t for t in tables if not str(t["name"]).startswith(("sqlite_", "_sqlite"))]
    assert {"raw_chunks", "observations", "notices"} <= {t["name"] for t in ours}
    assert all(t["strict"] == 1 for t in ours)
    with store.transaction():  # of the connection that writes
        for pragma, value in (("journal_mode", "wal"), ("synchronous", 2), ("foreign_keys", 1)):
            assert [*store.rows(f"PRAGMA {pragma}")[0].values()] == [value]


def test_the_version_of_sqlite_is_logged_at_the_start(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        Store(path).close()
    assert f"SQLite {sqlite3.sqlite_version}" in caplog.text


def test_a_second_daemon_is_refused_and_told_who_holds_the_store(path: Path) -> None:
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "open\n"
        with pytest.raises(StoreBusyError, match=f"process {holder.pid} has this store open for writing") as refused:
            Store(path)
        assert refused.value.pid == holder.pid
        holder.kill()
    Store(path).close()  # a killed holder holds nothing


def test_a_second_store_of_the_same_process_is_refused_too(store: Store, path: Path) -> None:
    with pytest.raises(StoreBusyError, match=f"process {os.getpid()}"):
        Store(path)


def test_a_store_that_was_moved_and_linked_to_is_held_by_either_name(store: Store, path: Path, tmp_path: Path) -> None:
    link = tmp_path / "elsewhere" / "rigcal.sqlite"
    link.parent.mkdir()
    link.symlink_to(path)
    with pytest.raises(StoreBusyError, match=f"process {os.getpid()}"):
        Store(link)
    store.close()
    with contextlib.closing(Store(link)), pytest.raises(StoreBusyError):
        Store(path)


def test_closing_lets_others_in_and_may_be_repeated(path: Path) -> None:
    first = Store(path)
    first.close()
    first.close()
    Store(path).close()


def test_a_lock_file_without_a_process_number_is_still_a_lock(store: Store, path: Path) -> None:
    path.with_name(path.name + ".lock").write_text("")
    with pytest.raises(StoreBusyError, match="another process"):
        Store(path)


def test_a_missing_directory_is_named(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"nowhere/x\.sqlite\.lock.*the directory must exist"):
        Store(tmp_path / "nowhere" / "x.sqlite")


def test_a_file_that_is_no_database_is_refused_and_let_go(path: Path) -> None:
    path.write_bytes(b"this is no database, however one looks at it" * 100)
    for _ in range(2):  # the second time shows that the lock was released
        with pytest.raises(StoreError, match=r"rigcal\.sqlite: cannot be used as a store"):
            Store(path)
    with pytest.raises(StoreError, match="cannot be read as a store"):
        Reader(path)


def test_a_store_of_a_newer_rigcal_is_refused_untouched(path: Path) -> None:
    Store(path).close()
    with sqlite3.connect(path) as connection:
        connection.execute(
            "INSERT INTO _sqlite_migrations (migration_set, name, applied_at) VALUES ('rigcal', 'm999_later', '')"
        )
    connection.close()
    for _ in range(2):
        with pytest.raises(StoreError, match=r"made by a newer rigcal.*m999_later"):
            Store(path)


def test_a_sqlite_without_strict_tables_is_refused(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "OLDEST_SQLITE", (99, 0, 0))
    with pytest.raises(StoreError, match=r"too old; rigcal needs 99\.0\.0"):
        Store(path)


# ---- transactions and rows -------------------------------------------------------------------------------------------


def test_a_transaction_that_raises_leaves_nothing_behind(store: Store, path: Path) -> None:
    def fails() -> None:
        with store.transaction():
            store.insert_records([reading("theta1", 0.0, 1.0)])
            raise RuntimeError("no")

    with pytest.raises(RuntimeError):
        fails()
    assert table(path, "boots") == table(path, "channels") == table(path, "signals") == []
    store.insert_records([reading("theta1", 0.0, 1.0)])  # boot and channel are made again
    assert len(table(path, "signals")) == 1


def test_a_nested_transaction_can_fail_alone(store: Store, path: Path) -> None:
    def feed_then_boom() -> None:
        with store.transaction():
            store.insert("links", {"name": "feed", "kind": "can"})
            store.insert("links", {"name": "boom", "kind": "can"})

    with store.transaction():
        store.insert("links", {"name": "boom", "kind": "can"})
        with pytest.raises(sqlite3.IntegrityError):
            feed_then_boom()
    assert [row["name"] for row in table(path, "links")] == ["boom"]


def test_numpy_scalars_nan_and_lists_become_what_strict_columns_hold(store: Store, path: Path) -> None:
    store.insert("station_setups", _setup(store, "S1") | {"tilt_arcsec": np.float32(1.5), "ppm": np.nan})
    store.insert("control_points", {"setup_id": "S1", "name": "A", "x_mm": np.float64(1), "y_mm": 2, "z_mm": 3.0})
    shot = {"setup_id": "S1", "name": "A", "phase": "start", "x_mm": 1.0, "y_mm": 2.0, "z_mm": 3.0}
    store.insert("control_shots", {**shot, **store.instant(at(1)), "fix_ids_json": [np.int64(3), 4]})
    assert table(path, "station_setups")[0] | {"tilt_arcsec": 1.5, "ppm": None} == table(path, "station_setups")[0]
    assert table(path, "control_points")[0]["x_mm"] == 1.0
    assert table(path, "control_shots")[0]["fix_ids_json"] == "[3,4]"
    assert sql_value({"rms_mm": np.float64(0.5), "bad": float("inf"), "all": np.array([1, 2])}) == (
        '{"rms_mm":0.5,"bad":null,"all":[1,2]}'
    )
    assert (sql_value(True), sql_value(Status.OK), sql_value(np.int16(-3)), sql_value(b"x")) == (1, "ok", -3, b"x")


def test_a_value_that_no_column_can_hold_is_named(store: Store) -> None:
    with pytest.raises(TypeError, match="a object cannot be stored"):
        store.insert("links", {"name": object(), "kind": "can"})


def test_update_changes_the_rows_that_match_and_counts_them(store: Store, path: Path) -> None:
    store.insert("station_setups", _setup(store, "S1"))
    store.insert("station_setups", _setup(store, "S2"))
    assert store.update("station_setups", {"id": "S2", "tilt_arcsec": None}, {"state": "moved"}) == 1
    assert store.update("station_setups", {"id": "S3"}, {"state": "moved"}) == 0
    assert [row["state"] for row in table(path, "station_setups")] == ["ok", "moved"]


def test_a_row_of_an_unknown_parent_is_refused(store: Store) -> None:
    with pytest.raises(sqlite3.IntegrityError):
        store.insert("control_points", {"setup_id": "S9", "name": "A", "x_mm": 0.0, "y_mm": 0.0, "z_mm": 0.0})


def test_a_rig_has_at_most_one_live_model(store: Store) -> None:
    model = {"rig": "ur10", "path": "m", "manifest_sha256": "0", "stage": "hybrid", "state": "live"}
    store.insert("models", {**model, **store.instant(at(0), "created_")})
    store.insert("models", {**model, "rig": "swdt82", **store.instant(at(0), "created_")})
    with pytest.raises(sqlite3.IntegrityError):
        store.insert("models", {**model, **store.instant(at(1), "created_")})


def test_transactions_of_several_threads_take_turns(store: Store, path: Path) -> None:
    def insert(name: str) -> None:
        for number in range(50):
            with store.transaction():
                store.insert("links", {"name": f"{name}{number}", "kind": "can"})

    threads = [threading.Thread(target=insert, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert len(table(path, "links")) == 200


def test_what_is_read_waits_for_no_other_thread_s_transaction(store: Store) -> None:
    store.begin_run(at(0))
    begun, may_end = threading.Event(), threading.Event()

    def write_slowly() -> None:
        with store.transaction():
            store.update("daemon_runs", {"id": 1}, {"pid": 1})
            begun.set()
            may_end.wait(60)

    seen: list[int | None] = []

    def pid() -> int | None:
        return store.number("SELECT pid FROM daemon_runs", [])

    writer = threading.Thread(target=write_slowly)
    writer.start()
    try:
        assert begun.wait(60)
        reader = threading.Thread(target=lambda: seen.append(pid()), daemon=True)
        reader.start()
        reader.join(10)
        assert seen == [os.getpid()]  # as last committed
    finally:
        may_end.set()
        writer.join()
    assert pid() == 1
    with store.transaction():
        store.update("daemon_runs", {"id": 1}, {"pid": 2})
        assert pid() == 2  # in a transaction, with its own changes


def _setup(store: Store, name: str) -> dict[str, object]:
    return {"id": name, "instrument": "GTS-8", "serial": "7", "state": "ok", **store.instant(at(0), "created_")}


# ---- records ---------------------------------------------------------------------------------------------------------


def test_readings_go_to_joints_or_signals_with_three_clocks(store: Store, path: Path) -> None:
    store.declare_channels({"theta1": "deg"}, {"boom_valve": "mA"})
    store.insert_records(
        [
            Reading("theta1", at(0.25), 12.5, "deg", Status.OK, 4711),
            Reading("boom_valve", at(0.5), None, "mA", Status.NOT_AVAILABLE, 255),
        ]
    )
    (joint,) = table(path, "joint_samples")
    (signal,) = table(path, "signals")
    with Reader(path) as reader:
        assert reader.stamp(joint) == at(0.25)
        channels = {row["id"]: (row["name"], row["unit"], row["kind"]) for row in reader.rows("SELECT * FROM channels")}
    assert channels[joint["channel_id"]] == ("theta1", "deg", "joint")
    assert channels[signal["channel_id"]] == ("boom_valve", "mA", "signal")
    assert (joint["value"], joint["status"], joint["raw_counts"]) == (12.5, "ok", 4711)
    assert (signal["value"], signal["status"], signal["raw_counts"]) == (None, "not_available", 255)


def test_a_channel_that_changes_its_unit_is_another_channel(store: Store, path: Path) -> None:
    store.insert_records([reading("boom_valve", 0, 1.0, "mA"), reading("boom_valve", 1, 1.0, "V")])
    first, second = table(path, "signals")
    assert first["channel_id"] != second["channel_id"]


@pytest.mark.parametrize(
    ("value", "status", "stored"),
    [
        (float("nan"), Status.OK, (None, "malformed")),
        (float("-inf"), Status.OK, (None, "malformed")),
        (None, Status.OK, (None, "malformed")),
        (3.0, Status.DEVICE_ALARM, (None, "device_alarm")),
        (np.float64(3.0), Status.OK, (3.0, "ok")),
    ],
)
def test_only_a_finite_value_of_an_ok_reading_is_stored(
    store: Store, path: Path, value: float | None, status: Status, stored: tuple[float | None, str]
) -> None:
    store.insert_records([reading("theta1", 0, value, status=status)])
    (row,) = table(path, "signals")
    assert (row["value"], row["status"]) == stored


def test_a_device_counter_of_64_bits_fits(store: Store, path: Path) -> None:
    store.insert_records([Reading("theta1", at(0), 1.0, "deg", Status.OK, 2**64 - 1)])
    assert table(path, "signals")[0]["raw_counts"] == -1


def test_a_fix_keeps_all_that_the_instrument_said(store: Store, path: Path) -> None:
    one = fix(1.0)
    store.insert_records([fix(0.5), one])
    row = table(path, "fixes")[1]
    assert store.fix_id(one) == row["id"]
    assert store.fix_id(fix(2.0)) is None
    boots = {1: BOOT}
    back = Fix(
        str(row["station"]),
        stamp_of(row, boots),
        stamp_of(row, boots, "last_byte_"),
        Status(str(row["status"])),
        LockState(str(row["lock"])),
        tilt_ok=bool(row["tilt_ok"]),
        **{
            name: row[name]
            for name in (
                *("hz_angle_rad", "zenith_angle_rad", "slope_distance_m", "north_m", "east_m", "up_m", "face"),
                *("prism_constant_mm", "ppm", "edm_level", "reason", "raw"),
            )
        },
    )
    assert back == one


def test_a_fix_with_a_number_that_is_none_is_stored_as_malformed(store: Store, path: Path) -> None:
    store.insert_records([Fix("ts1", at(0), at(0), Status.OK, LockState.LOCKED, hz_angle_rad=float("nan"))])
    (row,) = table(path, "fixes")
    assert (row["status"], row["hz_angle_rad"], row["reason"]) == (
        "malformed",
        None,
        "hz_angle_rad is not a finite number",
    )


def test_events_are_rows_of_their_own(store: Store, path: Path) -> None:
    store.insert_records([DeviceEvent("theta1", at(3), EventKind.EMERGENCY, "voltage", 0x3100)])
    (row,) = table(path, "device_events")
    assert (row["device"], row["kind"], row["text"], row["code"]) == ("theta1", "emergency", "voltage", 0x3100)


def test_failures_alike_are_counted_and_keep_a_bounded_excerpt(store: Store, path: Path) -> None:
    store.insert_records(
        [
            DecodeFailure("ts1", at(1), "BCC", b"x" * 1000),
            DecodeFailure("ts1", at(2), "BCC", b"y"),
            DecodeFailure("ts1", at(3), "no ETX", b"z"),
        ]
    )
    first, second = table(path, "decode_failures")
    assert (first["reason"], first["count"], first["excerpt"]) == ("BCC", 2, b"x" * 64)
    assert (second["reason"], second["count"], second["excerpt"]) == ("no ETX", 1, b"z")


def test_a_gap_is_one_row_that_its_end_completes(store: Store, path: Path) -> None:
    store.insert_records([Gap("theta1", GapReason.SILENT, at(1))])
    (row,) = table(path, "gaps")
    assert row["end_utc_ns"] is None
    store.insert_records([Gap("theta1", GapReason.SILENT, at(1), at(4), 150)])
    store.insert_records([Gap("theta1", GapReason.SILENT, at(5), at(6))])
    first, second = table(path, "gaps")
    assert (first["end_utc_ns"], first["missed"]) == (at(4).utc_ns, 150)
    assert (second["end_utc_ns"], second["missed"]) == (at(6).utc_ns, None)


# ---- raw captures ----------------------------------------------------------------------------------------------------


def test_captures_wait_to_be_decoded_until_they_are_marked(store: Store) -> None:
    captures: list[Capture] = [frame(1), serial_bytes(b"Q", 0.0015), frame(2)]
    first, second = store.append_captures(captures)
    assert store.undecoded_chunks() == [first, second]
    assert store.chunk_captures(first) == [captures[0], captures[2]]
    assert store.chunk_captures(second) == [captures[1]]
    store.mark_decoded([first])
    assert store.undecoded_chunks() == [second]
    store.mark_decoded([second])
    assert store.undecoded_chunks() == []


def test_readers_give_the_captures_of_a_link_and_a_time_again(store: Store, path: Path) -> None:
    frames = [frame(n) for n in range(100)]
    line = serial_bytes(b"Q", 0.05)
    store.append_captures(frames[:50])
    store.append_captures([*frames[50:], line])
    with Reader(path) as reader:
        assert [*reader.captures()] == [*frames, line]
        assert [*reader.captures("boom")] == frames
        assert [*reader.captures("station")] == [line]
        assert [*reader.captures("boom", at(0.040), at(0.060))] == frames[40:61]
        assert [*reader.captures("elsewhere")] == []


def test_a_damaged_chunk_is_named(store: Store, path: Path) -> None:
    (chunk,) = store.append_captures([frame(1)])
    store.update("raw_chunks", {"id": chunk}, {"chunk": b"RCAP and nonsense"})
    with pytest.raises(StoreError, match=f"raw chunk {chunk}:"):
        store.chunk_captures(chunk)
    with Reader(path) as reader, pytest.raises(StoreError, match=f"raw chunk {chunk}:"):
        [*reader.captures()]


def test_what_cannot_be_encoded_is_not_half_stored(store: Store, path: Path) -> None:
    with pytest.raises(StoreError):
        store.append_captures([frame(1, link="other"), CanCapture("boom", at(0), -1, b"")])
    assert table(path, "raw_chunks") == table(path, "links") == []


# ---- runs of the daemon ----------------------------------------------------------------------------------------------


def test_a_first_run_has_no_gap_before_it(store: Store, path: Path) -> None:
    store.begin_run(at(0))
    assert table(path, "gaps") == []
    (run,) = table(path, "daemon_runs")
    assert run["id"] == store.run_id
    assert store.stamp(run, "started_") == at(0)
    assert store.stamp_or_none(run, "ended_") is None
    assert (run["pid"], run["sqlite_version"], run["clean"]) == (os.getpid(), sqlite3.sqlite_version, 0)


def test_the_time_between_two_runs_is_a_gap_and_ends_those_left_open(path: Path) -> None:
    store = Store(path)
    store.begin_run(at(0))
    store.insert_records([Gap("theta1", GapReason.SILENT, at(1))])
    store.note_alive(at(4))  # so long were the links read
    store.end_run(at(5))
    store.close()
    store = Store(path)
    store.begin_run(at(60))
    store.close()
    silent, stopped = table(path, "gaps")
    assert (silent["channel"], silent["end_utc_ns"]) == ("theta1", at(5).utc_ns)
    assert (stopped["channel"], stopped["reason"]) == (WHOLE_DAEMON, "not_running")
    assert (stopped["start_utc_ns"], stopped["end_utc_ns"]) == (at(4).utc_ns, at(60).utc_ns)
    first, second = table(path, "daemon_runs")
    assert (first["clean"], second["clean"]) == (1, 0)


@pytest.mark.parametrize(
    ("alive_s", "captured_s", "captured_boot", "ended_s"), [(5, 7, BOOT, 7), (9, 7, BOOT, 9), (5, 7, "boot-z", 5)]
)
def test_a_killed_run_ended_at_its_last_sign_and_may_have_lost_what_came_since_it_had_stored_all(
    path: Path, alive_s: float, captured_s: float, captured_boot: str, ended_s: float
) -> None:
    store = Store(path)
    store.begin_run(at(0))
    store.note_alive(at(alive_s))
    store.append_captures([frame(1, captured_s, boot_id=captured_boot)])
    store.close()  # without end_run, as after a kill
    store = Store(path)
    store.begin_run(at(60, "boot-b"))
    assert store.previous_end == at(ended_s)
    store.close()
    (gap,) = table(path, "gaps")
    with Reader(path) as reader:
        assert reader.stamp(gap, "start_") == at(alive_s)
        assert reader.stamp(gap, "end_") == at(60, "boot-b")


def test_a_gap_that_a_killed_run_left_open_after_its_last_sign_does_not_end_before_it_began(path: Path) -> None:
    store = Store(path)
    store.begin_run(at(0))
    store.note_alive(at(5))
    store.insert_records([Gap("boom", GapReason.LINK_DOWN, at(7)), Gap("station", GapReason.LINK_DOWN, at(3))])
    store.close()
    store = Store(path)
    store.begin_run(at(60))
    store.close()
    ends = {row["channel"]: row["end_monotonic_ns"] for row in table(path, "gaps")}
    assert ends == {"boom": at(7).monotonic_ns, "station": at(5).monotonic_ns, WHOLE_DAEMON: at(60).monotonic_ns}


def test_a_run_that_never_began_neither_lives_nor_ends(store: Store, path: Path) -> None:
    store.note_alive(at(0))
    store.end_run(at(1))
    assert table(path, "daemon_runs") == []


# ---- readers ---------------------------------------------------------------------------------------------------------


def test_readers_work_beside_the_writer_and_cannot_write(store: Store, path: Path) -> None:
    with Reader(path) as reader:
        assert [*reader.rows("SELECT * FROM links")] == []
        store.insert("links", {"name": "boom", "kind": "can"})
        assert [*reader.rows("SELECT name FROM links WHERE kind = ?", ["can"])] == [{"name": "boom"}]
        with pytest.raises(sqlite3.OperationalError, match="readonly"):
            [*reader.rows("DELETE FROM links")]


def test_readers_work_without_a_writer(path: Path) -> None:
    store = Store(path)
    store.insert("links", {"name": "boom", "kind": "can"})
    store.close()
    with Reader(path) as reader:
        assert [*reader.rows("SELECT name FROM links")] == [{"name": "boom"}]


def test_a_reader_of_nothing_says_so(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"none\.sqlite: there is no store"):
        Reader(tmp_path / "none.sqlite")
    assert [*tmp_path.iterdir()] == []


def test_a_row_without_an_instant_is_not_taken_for_one() -> None:
    with pytest.raises(ValueError, match="end_utc_ns"):
        stamp_of({"end_utc_ns": None, "end_monotonic_ns": None, "end_boot_id": None}, {}, "end_")


def test_records_are_stored_while_the_process_has_no_descriptor_left(path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.closing(Store(path)) as store:
        store.begin_run(at(0))
        store.declare_channels({"theta1": "deg"}, {})
        store.insert_records([reading("theta1", n, 1.0) for n in range(20_000)])
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
        try:
            with store.transaction():  # what one step of it may undo is more than SQLite holds in memory by itself
                store.insert_records([reading("theta1", n + 0.5, 2.0) for n in range(0, 20_000, 20)])
            store.end_run(at(20_000))
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert sum(row["value"] == 2.0 for row in table(path, "joint_samples")) == 1000
