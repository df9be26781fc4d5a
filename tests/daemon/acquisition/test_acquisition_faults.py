"""Acquisition outlives full queues and disks, parts that fail and killed processes, and loses nothing unsaid."""

from __future__ import annotations

import contextlib
import logging
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import can
import pytest

from daemon.acquisition import acquisition as acquisition_module
from daemon.acquisition import link_intake
from daemon.acquisition.acquisition import Acquisition
from daemon.store import Reader, Store
from drivers.can.ports import CanLinkConfig
from drivers.can_link import CanLink
from drivers.clock import SystemClock
from drivers.readings import (
    Capture,
    DeviceEvent,
    EventKind,
    LinkItem,
    Record,
)
from tests.daemon.support.acquisition import (
    DEADLINE_S,
    ListLink,
    Make,
    NumberDecoder,
    raw,
    values,
    wait_until,
)
from tests.daemon.support.damage import fill_up, make_room
from tests.daemon.support.store import at, frame, table
from tests.drivers.multicast import GROUP, multicast_bus, unused_port

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


def on_a_full_disk(acquire: Make, store: Store, frames: Sequence[LinkItem]) -> tuple[Acquisition, ListLink]:
    """Acquisition whose disk is full since before its link emits `frames`, and that has noticed it."""
    gate = threading.Event()
    link = ListLink("boom", frames, gate)
    acquisition = acquire([link])
    acquisition.start()
    fill_up(store)
    gate.set()
    wait_until(lambda: acquisition.status().error is not None)
    return acquisition, link


def test_a_full_disk_is_told_and_waited_for_and_nothing_is_lost(
    path: Path, store: Store, acquire: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acquisition_module, "RETRY_S", 0.02)
    frames = [frame(n) for n in range(3000)]
    acquisition, link = on_a_full_disk(acquire, store, frames)
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
    acquisition, _ = on_a_full_disk(acquire, store, [frame(n) for n in range(3000)])
    with caplog.at_level(logging.CRITICAL):
        acquisition.stop()
    assert "nothing is stored any more: " in caplog.text
    assert "Traceback" not in caplog.text
    assert not acquisition.alive(within_s=DEADLINE_S)


def test_a_disk_that_has_room_again_while_the_daemon_stops_takes_all_that_waits(
    path: Path, store: Store, acquire: Make
) -> None:
    acquisition, _ = on_a_full_disk(acquire, store, [frame(n) for n in range(3000)])
    room = threading.Timer(0.5, make_room, [store])
    room.start()
    acquisition.stop()
    room.join()
    assert acquisition.has_stored_all
    assert [int.from_bytes(capture.data, "little") for capture in raw(path)] == list(range(3000))


def test_only_captures_are_counted_as_given_up(acquire: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that found the queue full too; what else a link tells late does not make the end of a run unclean."""
    monkeypatch.setattr(acquisition_module, "LINKS_STOP_S", 0.05)
    release = threading.Event()

    class Late(ListLink):
        def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
            release.wait(DEADLINE_S)
            super().run(emit, stop)

    event = DeviceEvent("boom", at(9), EventKind.WARNING, "late")
    late, full = Late("boom", [event]), Late("aux", [frame(n, link="aux") for n in range(5)])
    acquisition = acquire([late, full], queue_captures=3)
    acquisition.start()
    of_event, of_frames = acquisition._intakes
    acquisition.stop()
    release.set()
    for link in (late, full):
        wait_until(link.done.is_set)
    assert (of_event.queued, of_event.unstored) == (1, 0)
    assert (of_frames.queued, of_frames.unstored) == (3, 5)
    assert acquisition.has_stored_all


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
    assert caplog.text.count("its decoder failed") == 1


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
    assert "could not be processed further" in caplog.text


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


def run_process(path: Path, *arguments: int) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.daemon.support.acquisition", str(path), *map(str, arguments)],
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
    assert gap["start_utc_ns"] <= raw(path)[-1].stamp.utc_ns < gap["end_utc_ns"]
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


@pytest.mark.parametrize("lived_on_s", [0.0, 0.015, 0.04, 0.2])
def test_what_a_killed_process_had_still_to_read_after_a_stall_lies_in_the_gap(path: Path, lived_on_s: float) -> None:
    """It stands still while frames come, and is killed before it has read, or committed, those that wait."""
    port = unused_port()
    process = run_process(path, -1, port)
    sent_ns = []
    with multicast_bus(port) as bus:

        def send(number: int, until: Callable[[], bool]) -> int:
            while not until():
                sent_ns.append(time.monotonic_ns())
                bus.send(can.Message(arbitration_id=0x181, data=number.to_bytes(8, "little")))
                number += 1
                time.sleep(0.001)
            return number

        def after(seconds: float) -> Callable[[], bool]:
            until = time.monotonic() + seconds
            return lambda: time.monotonic() > until

        number = send(0, lambda: len(table(path, "raw_chunks")) > 3)
        number = send(number, after(1.5))  # beyond the first heartbeat
        process.send_signal(signal.SIGSTOP)
        number = send(number, after(1.5))
        process.send_signal(signal.SIGCONT)
        number = send(number, after(lived_on_s))
        process.kill()
        send(number, after(0.1))
    process.communicate(timeout=DEADLINE_S)

    with contextlib.closing(Store(path)) as store:
        store.begin_run(SystemClock().now())
    (killed,) = [gap for gap in table(path, "gaps") if gap["reason"] == "not_running"]
    stored = {int.from_bytes(capture.data, "little") for capture in raw(path)}
    lost = [number for number in range(len(sent_ns)) if number not in stored]
    assert lost
    first = next(number for number in lost if number > min(stored))  # before it, the process was not there yet
    assert sent_ns[first] > killed["start_monotonic_ns"] - 5_000_000
    # Not more is doubted than what came since the process was stopped, and some seconds before
    assert killed["start_monotonic_ns"] > sent_ns[number - 1] - 5_000_000_000


def test_what_comes_while_a_run_ends_in_order_lies_in_the_gap(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A link that hangs must not hide what the others, which have stopped, read no more meanwhile."""
    monkeypatch.setattr(acquisition_module, "LINKS_STOP_S", 0.5)
    clock, port, release = SystemClock(), unused_port(), threading.Event()

    class Hangs(ListLink):
        def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
            emit(DeviceEvent("aux", clock.now(), EventKind.LINK_UP, "open"))
            release.wait(DEADLINE_S)

    options = {"port": port, "hop_limit": 0}
    link = CanLink(CanLinkConfig(name="boom", interface="udp_multicast", channel=GROUP, options=options), clock)
    sent_ns: list[int] = []
    has_ended = threading.Event()

    def send() -> None:
        while not has_ended.wait(0.001):
            sent_ns.append(time.monotonic_ns())
            bus.send(can.Message(arbitration_id=0x181, data=(len(sent_ns) - 1).to_bytes(8, "little")))

    sender = threading.Thread(target=send)
    with contextlib.closing(Store(path)) as store, multicast_bus(port) as bus:
        store.declare_channels({"theta1": "deg"}, {})
        store.begin_run(clock.now())
        acquisition = Acquisition(
            [link, Hangs("aux", [])], {"boom": NumberDecoder}, store, clock, on_records=lambda _: None
        )
        acquisition.start()
        sender.start()
        wait_until(lambda: len(table(path, "raw_chunks")) > 10)
        acquisition.stop()
        store.end_run(clock.now())
        has_ended.set()
        sender.join(DEADLINE_S)
        release.set()
        store.begin_run(clock.now())
    (between,) = [gap for gap in table(path, "gaps") if gap["reason"] == "not_running"]
    stored = {int.from_bytes(capture.data, "little") for capture in raw(path)}
    lost = [number for number in range(min(stored), len(sent_ns)) if number not in stored]
    assert sent_ns[-1] - sent_ns[lost[0]] > 400_000_000, "it was waited for the link that hangs"
    assert sent_ns[lost[0]] > between["start_monotonic_ns"] - 5_000_000
    assert between["start_monotonic_ns"] > sent_ns[lost[0]] - 2_000_000_000


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
