"""Acquisition stores every capture before it decodes it, and a replay gives the rows that were made live."""

from __future__ import annotations

import json
import logging
import sqlite3
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import pytest

from daemon.acquisition.acquisition import Acquisition
from daemon.acquisition.status.snapshot import AcquisitionStatus
from daemon.store import Store
from drivers.clock import ManualClock
from drivers.readings import (
    Capture,
    DeviceEvent,
    EventKind,
    Gap,
    GapReason,
    LinkItem,
    Record,
)
from tests.daemon.support.acquisition import (
    ListLink,
    Make,
    NumberDecoder,
    SilenceDecoder,
    raw,
    values,
    wait_until,
)
from tests.daemon.support.damage import fill_up
from tests.daemon.support.store import at, frame, serial_bytes, table

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


def with_two_bursts(acquire: Make, clock: ManualClock, frames: tuple[int, int], apart_s: float) -> Acquisition:
    """Acquisition that has stored so many frames of a link at one instant, and so many a while later."""
    first, second = threading.Event(), threading.Event()
    links = [
        ListLink("boom", [frame(n) for n in range(count)], event)
        for count, event in zip(frames, (first, second), strict=True)
    ]
    acquisition = acquire(links, clock=clock)
    acquisition.start()
    first.set()
    wait_until(lambda: acquisition.status().links[0].captures == frames[0])
    clock.advance(apart_s)
    second.set()
    wait_until(lambda: acquisition.status().links[0].captures == sum(frames))
    return acquisition


def test_the_rate_of_a_link_is_what_it_was_lately(acquire: Make) -> None:
    clock = ManualClock(at(0))
    acquisition = with_two_bursts(acquire, clock, (10, 30), apart_s=2.0)
    assert 0 < acquisition.status().links[0].captures_per_s <= 20.0


def test_a_link_has_no_rate_when_every_link_has_fallen_silent(acquire: Make) -> None:
    clock = ManualClock(at(0))
    acquisition = with_two_bursts(acquire, clock, (10, 800), apart_s=1.0)
    assert acquisition.status().links[0].captures_per_s == 800.0
    clock.advance(0.6)
    assert acquisition.status().links[0].captures_per_s == 500.0, "no batch says so, but time has passed"
    clock.advance(600.0)
    assert acquisition.status().links[0].captures_per_s == 0.0


def test_what_was_left_behind_is_decoded_apart_from_what_comes_live(path: Path, store: Store, acquire: Make) -> None:
    store.append_captures([frame(1)])
    decoders: list[NumberDecoder] = []

    def fresh() -> NumberDecoder:
        decoders.append(NumberDecoder())
        return decoders[-1]

    acquisition = acquire([ListLink("boom", [frame(2)])], {"boom": fresh})
    acquisition.start()
    wait_until(lambda: values(path) == [1, 2])
    assert [decoder.fed for decoder in decoders if decoder.fed] == [[frame(1)], [frame(2)]]


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
