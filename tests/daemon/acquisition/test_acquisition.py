"""Acquisition stores every capture before it decodes it, loses nothing unsaid, and outlives the faults of its parts."""

from __future__ import annotations

import json
import logging
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import pytest

from daemon.acquisition import acquisition as acquisition_module
from daemon.acquisition import link_intake
from daemon.acquisition.acquisition import Acquisition
from daemon.acquisition.status.snapshot import AcquisitionStatus
from daemon.store import Reader, Store
from drivers.clock import ManualClock, SystemClock
from drivers.readings import (
    Capture,
    DeviceEvent,
    EventKind,
    Gap,
    GapReason,
    LinkItem,
    LinkLoop,
    Record,
)
from tests.daemon.acquisition_support import (
    DEADLINE_S,
    ListLink,
    NumberDecoder,
    SilenceDecoder,
    wait_until,
)
from tests.daemon.damage import fill_up, make_room
from tests.daemon.store_support import at, frame, serial_bytes, table

Make = Callable[..., Acquisition]


@pytest.fixture
def store(path: Path) -> Iterator[Store]:
    store = Store(path)
    store.declare_channels({"theta1": "deg"}, {})
    yield store
    store.close()


@pytest.fixture
def acquire(store: Store) -> Iterator[Make]:
    """Makes an Acquisition on the store and stops it after the test."""
    made: list[Acquisition] = []

    def make(
        links: Sequence[LinkLoop], decoders: dict[str, Callable[[], NumberDecoder]] | None = None, **options: object
    ) -> Acquisition:
        options.setdefault("on_records", lambda _: None)
        options.setdefault("batch_seconds", 0.01)
        clock = options.pop("clock", None) or SystemClock()
        one = Acquisition(links, {"boom": NumberDecoder} if decoders is None else decoders, store, clock, **options)  # type: ignore[arg-type] # options of any type
        made.append(one)
        return one

    yield make
    for one in made:
        one.stop()


def raw(path: Path) -> list[Capture]:
    with Reader(path) as reader:
        return [*reader.captures()]


def values(path: Path) -> list[float]:
    return [row["value"] for row in table(path, "joint_samples")]


# ---- the ordinary way ------------------------------------------------------------------------------------------------


def test_every_capture_is_stored_decoded_and_handed_on_in_order(path: Path, acquire: Make) -> None:
    frames = [frame(n) for n in range(5000)]
    line = serial_bytes(b"Q+", 1.0)
    boom, station = ListLink("boom", frames), ListLink("station", [line])
    handed_on: list[Record] = []
    acquisition = acquire(
        [boom, station], {"boom": NumberDecoder, "station": NumberDecoder}, on_records=handed_on.extend
    )
    acquisition.start()
    wait_until(lambda: boom.done.is_set() and station.done.is_set())
    acquisition.stop()
    assert [c for c in raw(path) if c.link == "boom"] == frames
    assert [c for c in raw(path) if c.link == "station"] == [line]
    assert values(path) == list(range(5000))
    assert len(table(path, "fixes")) == 1
    assert len(handed_on) == 5001
    assert table(path, "undecoded_chunks") == []


def test_raw_bytes_are_committed_before_they_are_decoded(path: Path, acquire: Make) -> None:
    seen: list[bool] = []

    class LookingDecoder(NumberDecoder):
        def feed(self, capture: Capture) -> Sequence[Record]:
            seen.append(capture in raw(path))
            return super().feed(capture)

    link = ListLink("boom", [frame(n) for n in range(20)])
    acquisition = acquire([link], {"boom": LookingDecoder})
    acquisition.start()
    wait_until(link.done.is_set)
    acquisition.stop()
    assert seen == [True] * 20


def test_a_link_without_a_decoder_is_captured_all_the_same(path: Path, acquire: Make) -> None:
    link = ListLink("boom", [frame(1)])
    acquisition = acquire([link], {})
    acquisition.start()
    wait_until(link.done.is_set)
    acquisition.stop()
    assert raw(path) == [frame(1)]
    assert table(path, "undecoded_chunks") == table(path, "joint_samples") == []


def test_a_link_that_is_lost_and_comes_back_is_told_in_the_log(acquire: Make, caplog: pytest.LogCaptureFixture) -> None:
    lost = DeviceEvent("boom", at(0), EventKind.LINK_LOST, "boom: the bus went away")
    back = DeviceEvent("boom", at(1), EventKind.LINK_UP, "boom: the bus is open")
    with caplog.at_level(logging.INFO):
        acquisition = acquire([ListLink("boom", [lost, back])])
        acquisition.start()
        wait_until(lambda: back.text in caplog.messages)
    told = [(record.levelname, record.message) for record in caplog.records]
    assert told == [("WARNING", lost.text), ("INFO", back.text)]


def test_what_a_link_reports_is_stored_beside_what_it_captured(path: Path, acquire: Make) -> None:
    up = DeviceEvent("boom", at(0), EventKind.LINK_UP, "open")
    link = ListLink("boom", [up, frame(1)])
    acquisition = acquire([link])
    acquisition.start()
    wait_until(lambda: bool(values(path)))
    assert acquisition.status().links[0].up is True
    acquisition.stop()
    assert [row["kind"] for row in table(path, "device_events")] == ["link_up"]


def test_decoders_are_told_the_time_and_their_consumer_too(acquire: Make) -> None:
    decoder = NumberDecoder()
    calls: list[Sequence[Record]] = []
    acquisition = acquire([], {"boom": lambda: decoder}, on_records=calls.append)
    acquisition.start()
    wait_until(lambda: len(decoder.ticks) >= 3 and len(calls) >= 3)
    acquisition.stop()
    gaps_ns = [b.monotonic_ns - a.monotonic_ns for a, b in zip(decoder.ticks, decoder.ticks[1:], strict=False)]
    assert all(gap_ns >= 100_000_000 for gap_ns in gaps_ns)


def test_stopping_stores_what_the_links_still_captured(path: Path, acquire: Make) -> None:
    class LastWords(ListLink):
        def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
            stop.wait()
            for n in range(100):
                emit(frame(n))

    acquisition = acquire([LastWords("boom", [])], batch_seconds=5.0)
    acquisition.start()
    acquisition.stop()
    assert values(path) == list(range(100))


def test_status_is_a_snapshot_that_json_can_carry(path: Path, acquire: Make) -> None:
    items: list[LinkItem] = [DeviceEvent("boom", at(0), EventKind.LINK_UP, "open"), frame(6), frame(7)]
    link, station = ListLink("boom", items), ListLink("station", [serial_bytes(b"Q", 0.5)])
    clock = ManualClock(at(2.0))

    acquisition = acquire([link, station], {"boom": NumberDecoder, "station": NumberDecoder}, clock=clock)
    assert acquisition.status().writer_lag_s == 0.0
    acquisition.start()
    wait_until(lambda: bool(values(path)) and bool(table(path, "fixes")))
    wait_until(lambda: bool(acquisition.status().channels) and bool(acquisition.status().stations))
    status = acquisition.status()
    (channel,), (fix_status,) = status.channels, status.stations
    assert (channel.name, channel.value, channel.unit, channel.status) == ("theta1", 7.0, "deg", "ok")
    assert channel.age_s == pytest.approx(2.0 - 0.007)
    assert (fix_status.name, fix_status.status, fix_status.lock, fix_status.fixes) == ("ts1", "ok", "locked", 1)
    boom = status.links[0]
    assert (boom.name, boom.up, boom.captures, boom.dropped, boom.queued, boom.restarts) == ("boom", True, 2, 0, 0, 0)
    assert status.links[1].up is True, "it says nothing of a port, but bytes come from it"
    assert status.writer_lag_p99_s >= 1.5
    assert status.error is None
    assert json.loads(json.dumps(asdict(status)))["channels"][0]["status"] == "ok"


def test_the_rate_of_a_link_is_what_it_was_lately(acquire: Make) -> None:
    clock = ManualClock(at(0))
    first, second = threading.Event(), threading.Event()
    links = [
        ListLink("boom", [frame(n) for n in range(10)], first),
        ListLink("boom", [frame(n) for n in range(30)], second),
    ]
    acquisition = acquire(links, clock=clock)
    acquisition.start()
    first.set()
    wait_until(lambda: acquisition.status().links[0].captures == 10)
    clock.advance(2.0)
    second.set()
    wait_until(lambda: acquisition.status().links[0].captures == 40)
    assert 0 < acquisition.status().links[0].captures_per_s <= 20.0


# ---- losses are never silent -----------------------------------------------------------------------------------------


def test_what_a_full_queue_drops_is_counted_and_recorded(path: Path, acquire: Make) -> None:
    busy, go_on = threading.Event(), threading.Event()

    def block(_: Sequence[Record]) -> None:
        busy.set()
        go_on.wait(DEADLINE_S)

    class Flood(ListLink):
        def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
            busy.wait(DEADLINE_S)
            super().run(emit, stop)

    event = DeviceEvent("boom", at(9), EventKind.WARNING, "still taken")
    link = Flood("boom", [*(frame(n) for n in range(1000)), event])
    acquisition = acquire([link], queue_captures=100, on_records=block)
    acquisition.start()
    wait_until(link.done.is_set)
    assert acquisition.status().links[0].dropped == 900
    go_on.set()
    acquisition.stop()
    assert values(path) == list(range(100))
    kept, dropped = table(path, "device_events")
    assert kept["text"] == "still taken"
    assert (dropped["kind"], dropped["code"]) == ("frames_dropped", 900)
    (gap,) = table(path, "gaps")
    assert (gap["channel"], gap["reason"], gap["missed"]) == ("boom", "frames_lost", 900)
    assert (gap["start_utc_ns"], gap["end_utc_ns"]) == (frame(100).stamp.utc_ns, frame(999).stamp.utc_ns)


def test_a_full_disk_is_told_and_waited_for_and_nothing_is_lost(
    path: Path, store: Store, acquire: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acquisition_module, "RETRY_S", 0.02)
    gate = threading.Event()
    frames = [frame(n) for n in range(3000)]
    link = ListLink("boom", frames, gate)
    acquisition = acquire([link])
    acquisition.start()
    fill_up(store)
    gate.set()
    wait_until(lambda: acquisition.status().error is not None)
    assert "full" in str(acquisition.status().error)
    assert acquisition.alive(within_s=DEADLINE_S)
    wait_until(link.done.is_set)
    make_room(store)
    wait_until(lambda: acquisition.status().error is None)
    acquisition.stop()
    assert raw(path) == frames
    assert values(path) == list(range(3000))


def test_a_disk_that_stays_full_does_not_keep_the_daemon_from_stopping(
    store: Store, acquire: Make, caplog: pytest.LogCaptureFixture
) -> None:
    gate = threading.Event()
    link = ListLink("boom", [frame(n) for n in range(3000)], gate)
    acquisition = acquire([link])
    acquisition.start()
    fill_up(store)
    gate.set()
    wait_until(lambda: acquisition.status().error is not None)
    with caplog.at_level(logging.CRITICAL):
        acquisition.stop()
    assert "the writer failed" in caplog.text
    assert not acquisition.alive(within_s=DEADLINE_S)


# ---- the faults of its parts -----------------------------------------------------------------------------------------


def test_a_link_whose_loop_dies_is_started_again(
    path: Path, acquire: Make, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(link_intake, "RESTART_S", 0.01)

    class Dies(ListLink):
        runs = 0

        def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
            self.runs += 1
            emit(frame(self.runs))
            if self.runs == 1:
                raise RuntimeError("a defect")
            if self.runs > 2:
                stop.wait()

    acquisition = acquire([Dies("boom", [])])
    acquisition.start()
    wait_until(lambda: values(path) == [1.0, 2.0, 3.0])
    status = acquisition.status().links[0]
    assert (status.restarts, status.up) == (2, False)
    acquisition.stop()
    raised, returned = table(path, "device_events")
    assert (raised["kind"], returned["kind"]) == ("link_lost", "link_lost")
    assert "RuntimeError: a defect" in raised["text"]
    assert "it returned" in returned["text"]


def test_a_link_that_does_not_stop_is_left_behind(
    path: Path, acquire: Make, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(acquisition_module, "LINKS_STOP_S", 0.05)
    release = threading.Event()

    class Stuck(ListLink):
        def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
            release.wait()

    acquisition = acquire([Stuck("boom", [])])
    acquisition.start()
    acquisition.stop()
    assert "link boom did not stop" in caplog.text
    release.set()


def test_a_decoder_that_raises_is_a_failure_of_that_frame_alone(
    path: Path, acquire: Make, caplog: pytest.LogCaptureFixture
) -> None:
    link = ListLink("boom", [frame(n) for n in range(5)])
    acquisition = acquire([link], {"boom": lambda: NumberDecoder(fail_at=2)})
    acquisition.start()
    wait_until(lambda: len(values(path)) == 4)
    wait_until(lambda: acquisition.status().decode_failures == {"boom": 1})
    acquisition.stop()
    assert values(path) == [0, 1, 3, 4]
    (failure,) = table(path, "decode_failures")
    assert failure["reason"] == "the decoder failed: ZeroDivisionError: a defect"
    assert failure["excerpt"] == frame(2).data


def test_a_decoder_that_raises_at_a_tick_does_not_end_acquisition(
    path: Path, acquire: Make, caplog: pytest.LogCaptureFixture
) -> None:
    class BadTick(NumberDecoder):
        def tick(self, now: object) -> Sequence[Record]:
            raise ValueError("a defect")

    acquisition = acquire([], {"boom": BadTick})
    acquisition.start()
    wait_until(lambda: len(table(path, "decode_failures")) >= 2)
    acquisition.stop()
    assert caplog.text.count("its decoder is defective") == 1


def test_a_record_that_the_store_refuses_keeps_no_other_out(
    path: Path, acquire: Make, caplog: pytest.LogCaptureFixture
) -> None:
    class BadText(NumberDecoder):
        def feed(self, capture: Capture) -> Sequence[Record]:
            bad = DeviceEvent("boom", capture.stamp, EventKind.WARNING, "\ud800")
            worse = DeviceEvent("boom", capture.stamp, EventKind.WARNING, "", 2**70)
            return [bad, *super().feed(capture), worse]

    link = ListLink("boom", [DeviceEvent("boom", at(0), EventKind.LINK_UP, "\udfff"), frame(1), frame(2)])
    acquisition = acquire([link], {"boom": BadText})
    acquisition.start()
    wait_until(lambda: len(values(path)) == 2)
    acquisition.stop()
    assert table(path, "device_events") == table(path, "undecoded_chunks") == []
    assert sum(row["count"] for row in table(path, "decode_failures")) == 5


def test_a_consumer_that_fails_does_not_end_acquisition_and_leaves_nothing_half_done(
    path: Path, store: Store, acquire: Make, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(records: Sequence[Record]) -> None:
        with store.transaction():
            store.insert("links", {"name": f"half{len(records)}", "kind": "can"})
            raise RuntimeError("a defect")

    gate = threading.Event()
    links = [ListLink("boom", [frame(1)]), ListLink("boom", [frame(2)], gate)]
    acquisition = acquire(links, on_records=fails)
    acquisition.start()
    wait_until(lambda: len(values(path)) == 1)
    gate.set()
    wait_until(lambda: len(values(path)) == 2)
    acquisition.stop()
    assert [row["name"] for row in table(path, "links")] == ["boom"]
    assert "could not be handed on" in caplog.text


def test_a_writer_that_hangs_is_not_alive(acquire: Make) -> None:
    busy, go_on = threading.Event(), threading.Event()

    def block(_: Sequence[Record]) -> None:
        busy.set()
        go_on.wait(DEADLINE_S)

    acquisition = acquire([], on_records=block)
    assert not acquisition.alive(within_s=60)
    acquisition.start()
    busy.wait(DEADLINE_S)
    wait_until(lambda: not acquisition.alive(within_s=0.05))
    go_on.set()
    wait_until(lambda: acquisition.alive(within_s=0.5))


# ---- killed at any time ----------------------------------------------------------------------------------------------


def run_process(path: Path, kill_at: int) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.daemon.acquisition_support", str(path), str(kill_at)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "acquiring\n"
    return process


def integrity(path: Path) -> str:
    with Reader(path) as reader:
        return str(next(iter(reader.rows("PRAGMA integrity_check")))["integrity_check"])


def test_a_process_killed_while_it_decodes_loses_no_committed_row(path: Path) -> None:
    process = run_process(path, 500)
    assert process.wait(DEADLINE_S) == -9
    process.communicate()
    assert integrity(path) == "ok"
    left = table(path, "undecoded_chunks")
    assert left
    numbers = [int.from_bytes(c.data, "little") for c in raw(path)]
    assert numbers == list(range(len(numbers)))
    assert len(numbers) > 500
    decoded = len(table(path, "joint_samples"))
    assert decoded <= 500

    store = Store(path)
    store.declare_channels({"theta1": "deg"}, {})
    clock = SystemClock()
    store.begin_run(clock.now())
    handed_on: list[Record] = []
    acquisition = Acquisition([], {"boom": NumberDecoder}, store, clock, on_records=handed_on.extend)
    acquisition.start()
    acquisition.stop()
    store.end_run(clock.now())
    store.close()

    assert values(path) == numbers
    assert len(handed_on) == len(numbers) - decoded
    assert table(path, "undecoded_chunks") == []
    (gap,) = table(path, "gaps")
    assert (gap["channel"], gap["reason"]) == ("daemon", "not_running")
    last = raw(path)[-1].stamp
    assert gap["start_utc_ns"] == last.utc_ns < gap["end_utc_ns"]
    assert [row["clean"] for row in table(path, "daemon_runs")] == [0, 1]


def test_a_process_killed_from_outside_keeps_all_that_a_reader_had_seen(path: Path) -> None:
    process = run_process(path, -1)
    wait_until(lambda: len(table(path, "raw_chunks")) > 20)
    seen_chunks, seen_values = table(path, "raw_chunks"), values(path)
    process.kill()
    process.communicate(timeout=DEADLINE_S)
    assert integrity(path) == "ok"
    assert table(path, "raw_chunks")[: len(seen_chunks)] == seen_chunks
    assert values(path)[: len(seen_values)] == seen_values
    with Store(path).transaction() as db:  # it opens again, for writing
        assert db.execute("SELECT count(*) FROM daemon_runs").fetchone()[0] == 1


def test_a_damaged_chunk_does_not_keep_the_daemon_from_starting(
    path: Path, store: Store, acquire: Make, caplog: pytest.LogCaptureFixture
) -> None:
    (bad,) = store.append_captures([frame(1)])
    store.append_captures([frame(2)])
    store.update("raw_chunks", {"id": bad}, {"chunk": b"RCAP"})
    acquisition = acquire([])
    acquisition.start()
    acquisition.stop()
    assert values(path) == [2]
    (failure,) = table(path, "decode_failures")
    assert f"raw chunk {bad}" in failure["reason"]
    assert table(path, "undecoded_chunks") == []


def test_what_was_left_behind_is_decoded_apart_from_what_comes_live(path: Path, store: Store, acquire: Make) -> None:
    store.append_captures([frame(1)])
    decoders: list[NumberDecoder] = []

    def fresh() -> NumberDecoder:
        decoders.append(NumberDecoder())
        return decoders[-1]

    acquisition = acquire([ListLink("boom", [frame(2)])], {"boom": fresh})
    acquisition.start()
    wait_until(lambda: values(path) == [1, 2])
    assert [decoder.fed for decoder in decoders] == [[frame(1)], [frame(2)]]


# ---- replay ----------------------------------------------------------------------------------------------------------


def dump(path: Path) -> list[str]:
    with sqlite3.connect(path) as connection:
        lines = [line for line in connection.iterdump() if "_sqlite_migrations" not in line]
    connection.close()
    return lines


def replay(path: Path, items: Sequence[LinkItem]) -> AcquisitionStatus:
    store = Store(path)
    store.declare_channels({"theta1": "deg"}, {})
    decoders = {"boom": SilenceDecoder, "station": NumberDecoder}
    acquisition = Acquisition([], decoders, store, ManualClock(), on_records=lambda _: None)
    acquisition.run_inline(items)
    store.close()
    return acquisition.status()


def mixed() -> list[LinkItem]:
    items: list[LinkItem] = []
    for n in range(9000):
        items.append(frame(n))
        if n % 50 == 0:
            items.append(serial_bytes(b"Q%d" % n, n / 1000 + 0.0005))
    items.insert(4000, DeviceEvent("boom", at(4.0), EventKind.WARNING, "heard live"))
    return items


def test_the_same_captures_give_the_same_rows_byte_for_byte(tmp_path: Path) -> None:
    first, second = tmp_path / "a.sqlite", tmp_path / "b.sqlite"
    replay(first, mixed())
    replay(second, iter(mixed()))  # type: ignore[arg-type] # any iterable will do
    assert dump(first) == dump(second)
    assert values(first) == list(range(9000))
    assert len(table(first, "fixes")) == 180
    assert len(table(first, "device_events")) == 1
    assert table(first, "undecoded_chunks") == []


def test_a_replay_gives_the_records_that_were_made_live(tmp_path: Path, path: Path, acquire: Make) -> None:
    items = mixed()
    link = ListLink("boom", items)
    acquisition = acquire([link], {"boom": NumberDecoder, "station": NumberDecoder})
    acquisition.start()
    wait_until(link.done.is_set)
    acquisition.stop()
    replayed = tmp_path / "replayed.sqlite"
    replay(replayed, raw(path))

    def facts(of: Path, name: str) -> list[dict[str, object]]:
        return [{k: v for k, v in row.items() if k != "id"} for row in table(of, name, "utc_ns")]

    assert facts(replayed, "joint_samples") == facts(path, "joint_samples")
    assert facts(replayed, "fixes") == facts(path, "fixes")


def test_in_a_replay_time_is_what_the_captures_say(path: Path) -> None:
    replay(path, [frame(n) for n in range(300)] + [frame(300, 10.0), frame(301, 10.05)])
    (gap,) = table(path, "gaps")
    assert gap["start_utc_ns"] == frame(299).stamp.utc_ns


def test_a_decoder_lives_within_one_boot(path: Path, store: Store, acquire: Make) -> None:
    decoders: list[NumberDecoder] = []

    def fresh() -> NumberDecoder:
        decoders.append(NumberDecoder())
        return decoders[-1]

    acquisition = acquire([], {"boom": fresh})
    acquisition.run_inline([frame(n) for n in range(300)] + [frame(n, boot_id="boot-b") for n in range(300)])
    assert [len(decoder.fed) for decoder in decoders] == [300, 300]
    assert values(path) == [*range(300), *range(300)]


def test_time_of_one_boot_means_nothing_to_a_decoder_in_another(acquire: Make) -> None:
    quiet, busy = NumberDecoder(), NumberDecoder()
    acquisition = acquire([], {"boom": lambda: busy, "station": lambda: quiet})
    items: list[LinkItem] = [serial_bytes(b"Q", 0.0)]  # from a log of another host
    items += [frame(n, boot_id="boot-b") for n in range(300)]
    acquisition.run_inline(items)
    assert busy.ticks[-1].boot_id == "boot-b"
    assert {stamp.boot_id for stamp in quiet.ticks} == {"boot-a"}


def test_a_replay_onto_a_full_disk_fails_at_once(store: Store, acquire: Make) -> None:
    fill_up(store)
    with pytest.raises(sqlite3.OperationalError, match="full"):
        acquire([]).run_inline([frame(n) for n in range(3000)])


def test_gaps_that_a_link_reports_are_stored_in_a_replay(path: Path, store: Store, acquire: Make) -> None:
    gap = Gap("boom", GapReason.LINK_DOWN, at(0), at(1))
    acquire([]).run_inline([gap, frame(1)])
    assert [row["reason"] for row in table(path, "gaps")] == ["link_down"]
