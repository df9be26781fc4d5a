"""A stop has a bounded time and stores raw captures first; a start goes live at once, whatever the last run left."""

from __future__ import annotations

import contextlib
import itertools
import logging
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from daemon.acquisition import acquisition as acquisition_module
from daemon.acquisition import backlog
from daemon.acquisition.acquisition import Acquisition, AcquisitionError
from daemon.commands import CommandError
from daemon.composition import Parts, joiner
from daemon.config.config import Config
from daemon.control.protocol import request
from daemon.host.systemd import Notifier
from daemon.service import Daemon
from daemon.store import Reader, Store
from drivers.clock import SystemClock
from drivers.readings import Capture, LinkItem, Record
from tests.daemon.support.acquisition import DEADLINE_S, ListLink, NumberDecoder, values, wait_until
from tests.daemon.support.damage import fill_up, tear
from tests.daemon.support.jobs import SOURCE
from tests.daemon.support.store import frame, reading, serial_bytes, table


@pytest.fixture
def store(path: Path) -> Iterator[Store]:
    store = opened(path)
    yield store
    store.close()


def opened(path: Path) -> Store:
    store = Store(path)
    store.declare_channels({"theta1": "deg"}, {})
    return store


def acquisition_on(
    store: Store, links: Sequence[ListLink], decoder: Callable[[], NumberDecoder] = NumberDecoder
) -> Acquisition:
    return Acquisition(
        links, {"boom": decoder}, store, SystemClock(), batch_seconds=0.01, on_records=lambda records: None
    )


def stored(path: Path) -> list[int]:
    """Numbers of the raw frames."""
    with Reader(path) as reader:
        return [int.from_bytes(capture.data, "little") for capture in reader.captures("boom")]


class TellsWhenItStops(ListLink):
    """A link that tells when it was asked to stop."""

    def __init__(self, name: str, items: Sequence[LinkItem]) -> None:
        super().__init__(name, items)
        self.stopping = threading.Event()

    def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
        super().run(emit, stop)
        self.stopping.set()


class Blocks(NumberDecoder):
    """A decoder that waits for an event, and then takes its time for each frame."""

    def __init__(self, go_on: threading.Event, each_s: float = 0.0) -> None:
        super().__init__()
        self._go_on, self._each_s = go_on, each_s

    def feed(self, capture: Capture) -> Sequence[Record]:
        assert self._go_on.wait(DEADLINE_S)
        time.sleep(self._each_s)
        return super().feed(capture)


# ---- stops -----------------------------------------------------------------------------------------------------------


def test_a_stop_with_a_long_queue_stores_it_raw_and_leaves_the_decoding_to_the_next_start(
    path: Path, store: Store, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(acquisition_module, "STOP_S", 0.2, raising=False)
    frames = [frame(n) for n in range(11_000)]
    link = TellsWhenItStops("boom", frames)
    acquisition = acquisition_on(store, [link], lambda: Blocks(link.stopping, each_s=0.0001))
    acquisition.start()
    wait_until(link.done.is_set)
    acquisition.stop()
    wait_until(lambda: not acquisition.alive(within_s=DEADLINE_S))
    assert stored(path) == list(range(11_000))
    assert table(path, "undecoded_chunks") != []
    assert len(values(path)) < 11_000

    again = acquisition_on(store, [])
    again.start()
    wait_until(lambda: table(path, "undecoded_chunks") == [])
    again.stop()
    assert values(path) == list(range(11_000))


def test_what_a_full_disk_keeps_from_being_stored_before_the_end_is_counted(
    path: Path, store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    gate = threading.Event()
    link = ListLink("boom", [frame(n) for n in range(3000)], gate)
    acquisition = acquisition_on(store, [link])
    acquisition.start()
    fill_up(store)
    gate.set()
    wait_until(link.done.is_set)
    wait_until(lambda: acquisition.status().error is not None)
    with caplog.at_level(logging.CRITICAL):
        acquisition.stop()
    lost = re.search(r"(\d+) captures could not be stored before the shutdown", caplog.text)
    assert lost is not None
    assert len(stored(path)) + int(lost[1]) == 3000
    with pytest.raises(AcquisitionError, match="could not be stored"):
        acquisition.check()


def test_a_stop_does_not_wait_for_a_commit_that_never_ends(
    path: Path, store: Store, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(acquisition_module, "STOP_S", 0.3, raising=False)
    monkeypatch.setattr("daemon.store.connection.CLOSE_TIMEOUT_S", 0.1, raising=False)
    gate, go_on, closed = threading.Event(), threading.Event(), threading.Event()
    link = ListLink("boom", [frame(n) for n in range(100)], gate)
    acquisition = acquisition_on(store, [link])
    acquisition.start()
    # A disk that hangs in the commit: SQLite calls this just before it.
    store._db.conn.set_trace_callback(
        lambda sql: (sql == "COMMIT" and gate.is_set() and go_on.wait(DEADLINE_S)) or None
    )
    gate.set()
    wait_until(link.done.is_set)

    def end() -> None:
        acquisition.stop()
        store.close()
        closed.set()

    ending = threading.Thread(target=end)
    ending.start()
    try:
        assert closed.wait(DEADLINE_S / 2)
        assert "captures could not be stored before the shutdown" in caplog.text
    finally:
        go_on.set()
        ending.join()
        wait_until(lambda: not acquisition.alive(within_s=DEADLINE_S))


def composed(directory: Path, link: ListLink, visit: Callable[[object], int] | None = None) -> tuple[Store, Daemon]:
    config = Config(rig="swdt82", state_directory=directory)
    store = Store(config.store_path)
    rig = SOURCE.rig
    parts = Parts("live", rig, SOURCE.text, SystemClock(), [link], {}, joiner(config, rig), visit=visit)
    return store, Daemon(config, store, parts)


def test_clients_that_are_still_being_served_do_not_delay_what_was_captured(tmp_path: Path, path: Path) -> None:
    go_on, served = threading.Event(), threading.Semaphore(0)

    def visit(_: object) -> int:
        served.release()
        go_on.wait(2 * DEADLINE_S)
        return 0

    def ask() -> None:
        with contextlib.suppress(CommandError):  # which of the two comes first, the end or the answer, is chance
            request(tmp_path / "control.sock", "simulation.visit", {"poses": []})

    class LastWords(ListLink):
        def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
            stop.wait()
            super().run(emit, stop)

    store, daemon = composed(tmp_path, LastWords("boom", [frame(n) for n in range(100)]), visit)
    stop = threading.Event()
    running = threading.Thread(target=daemon.run, args=(stop, Notifier({})))
    running.start()
    clients = [threading.Thread(target=ask) for _ in range(6)]
    for client in clients:
        client.start()
    try:
        for _ in clients:
            assert served.acquire(timeout=DEADLINE_S)
        stop.set()
        wait_until(lambda: len(stored(path)) == 100)
    finally:
        go_on.set()
        running.join()
        for client in clients:
            client.join()
        store.close()


def test_a_run_whose_captures_were_lost_at_its_end_did_not_end_in_order(tmp_path: Path, path: Path) -> None:
    gate = threading.Event()
    link = ListLink("boom", [frame(n) for n in range(3000)], gate)
    store, daemon = composed(tmp_path, link)
    stop, failures = threading.Event(), []

    def run() -> None:
        try:
            daemon.run(stop, Notifier({}))
        except AcquisitionError as error:
            failures.append(str(error))

    running = threading.Thread(target=run)
    running.start()
    wait_until(lambda: daemon._acquisition.alive(within_s=DEADLINE_S))
    fill_up(store)
    gate.set()
    wait_until(lambda: daemon._acquisition.status().error is not None)
    stop.set()
    running.join()
    store.close()
    assert failures
    assert "could not be stored" in failures[0]
    assert [row["clean"] for row in table(path, "daemon_runs")] == [0]


def test_a_disk_that_never_answers_is_an_alarm_and_does_not_keep_the_daemon_from_stopping(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acquisition_module, "WRITE_HUNG_S", 0.5)
    monkeypatch.setattr("daemon.service.STOP_S", 4.0)
    monkeypatch.setattr("daemon.store.connection.CLOSE_TIMEOUT_S", 0.1)
    gate, hangs, go_on = threading.Event(), threading.Event(), threading.Event()
    store, daemon = composed(tmp_path, ListLink("boom", [frame(n) for n in range(100)], gate))
    writer_hangs = threading.Event()

    def hang(sql: str) -> None:  # SQLite calls it just before the commit
        if sql == "COMMIT" and hangs.is_set() and threading.current_thread().name == "writer":
            writer_hangs.set()
            go_on.wait(DEADLINE_S)

    store._db.conn.set_trace_callback(hang)
    stop = threading.Event()

    def run() -> None:
        with contextlib.suppress(AcquisitionError):  # what is not stored by the end
            daemon.run(stop, Notifier({}))

    running = threading.Thread(target=run)
    running.start()
    try:
        wait_until(lambda: daemon._acquisition.alive(within_s=DEADLINE_S))
        hangs.set()
        gate.set()
        wait_until(writer_hangs.is_set)
        wait_until(lambda: "store_hangs" in [alarm["kind"] for alarm in daemon._alarms.status()["active"]])
        assert daemon._sessions.open_session() is None, "what is read waits for no commit"
        stop.set()
        running.join(DEADLINE_S / 2)
        assert not running.is_alive(), "the main loop waits for the commit"
    finally:
        go_on.set()
        running.join()
        store.close()


# ---- starts ----------------------------------------------------------------------------------------------------------


def test_a_start_captures_at_once_while_it_decodes_what_the_last_run_left(path: Path, store: Store) -> None:
    store.append_captures([frame(n) for n in range(100)])
    go_on = threading.Event()
    link = ListLink("boom", [frame(n) for n in range(100, 200)])
    acquisition = acquisition_on(store, [link], lambda: Blocks(go_on))
    starting = threading.Thread(target=acquisition.start)
    starting.start()
    try:
        wait_until(link.done.is_set)
        assert acquisition.status().is_behind
        assert values(path) == []
    finally:
        go_on.set()
        starting.join()
    wait_until(lambda: values(path) == list(range(200)))
    wait_until(lambda: not acquisition.status().is_behind)
    acquisition.stop()
    assert table(path, "undecoded_chunks") == []


def test_decoding_that_is_slower_than_capturing_loses_nothing_and_keeps_the_order(
    path: Path, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backlog, "HELD_CAPTURES", 50)
    go_on = threading.Event()
    gates = [threading.Event() for _ in range(4)]
    links = [ListLink("boom", [frame(100 * i + n) for n in range(100)], gate) for i, gate in enumerate(gates)]
    acquisition = acquisition_on(store, links, lambda: Blocks(go_on))
    acquisition.start()
    try:
        gates[0].set()
        wait_until(lambda: len(stored(path)) == 100)
        for gate in gates[1:]:
            gate.set()
        wait_until(lambda: all(link.done.is_set() for link in links))
    finally:
        go_on.set()
    wait_until(lambda: len(values(path)) == 400)
    wait_until(lambda: table(path, "undecoded_chunks") == [])
    acquisition.stop()
    assert values(path) == [float(number) for number in stored(path)]


def test_a_long_queue_is_worked_off_in_batches_that_hold_one_time_of_all_links(
    path: Path, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    busy, go_on = threading.Event(), threading.Event()
    batches: list[Sequence[Record]] = []

    def take(records: Sequence[Record]) -> None:
        if records:
            batches.append(records)
        busy.set()
        assert go_on.wait(DEADLINE_S)

    boom = ListLink("boom", [frame(n) for n in range(9000)], busy)
    station = ListLink("station", [serial_bytes(b"Q", n * 0.1) for n in range(90)], busy)
    decoders = {"boom": NumberDecoder, "station": NumberDecoder}
    acquisition = Acquisition([boom, station], decoders, store, SystemClock(), on_records=take)
    acquisition.start()
    wait_until(lambda: boom.done.is_set() and station.done.is_set())
    go_on.set()
    wait_until(lambda: len(values(path)) == 9000)
    acquisition.stop()
    assert len(batches) >= 3
    spans = [[r.stamp.monotonic_ns for r in records if hasattr(r, "stamp")] for records in batches]
    assert all(max(earlier) <= min(later) for earlier, later in itertools.pairwise(spans))


def test_damage_that_keeps_readings_out_of_the_store_does_not_keep_raw_captures_out(path: Path) -> None:
    before = opened(path)
    before.insert_records([reading("theta1", n / 10, float(n)) for n in range(10)])
    before.close()
    tear(path, "joint_samples")
    store = opened(path)
    gate = threading.Event()
    links = [ListLink("boom", [frame(1)]), ListLink("boom", [frame(2)], gate)]
    acquisition = acquisition_on(store, links)
    acquisition.start()
    try:
        wait_until(lambda: acquisition.status().error is not None)
        assert "restore the store from a backup" in str(acquisition.status().error)
        gate.set()
        wait_until(lambda: stored(path) == [1, 2])
    finally:
        acquisition.stop()
        store.close()
    assert len(table(path, "undecoded_chunks")) == 2
