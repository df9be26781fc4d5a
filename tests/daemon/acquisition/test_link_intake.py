"""A link's loss is a record from the start of the run on."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from daemon.acquisition import link_intake
from daemon.acquisition.acquisition import Acquisition
from daemon.acquisition.link_intake import LinkIntake
from daemon.store import Store
from drivers.clock import SystemClock
from drivers.readings import CanCapture, DeviceEvent, EventKind, Gap, GapReason, LinkItem
from simulators.replay import ReplayLink
from tests.daemon.support.acquisition import DEADLINE_S, ListLink, wait_until


def test_the_time_from_the_start_of_a_run_until_a_link_is_open_is_a_gap(tmp_path: Path) -> None:
    clock = SystemClock()
    begun = clock.now()
    with contextlib.closing(Store(tmp_path / "store.sqlite")) as store:
        store.begin_run(begun)
        up, first = begun.shifted(700_000_000), begun.shifted(750_000_000)
        opened = ListLink(
            "boom", [DeviceEvent("boom", up, EventKind.LINK_UP, "open"), CanCapture("boom", first, 1, b"")]
        )
        down = ListLink("station", [Gap("station", GapReason.LINK_DOWN, up)])
        replayed = ListLink(
            "log", [CanCapture("log", first, 1, b""), DeviceEvent("log", up, EventKind.LINK_UP, "open")]
        )
        acquisition = Acquisition([opened, down, replayed], {}, store, clock, on_records=lambda _: None)
        acquisition.start()
        for link in (opened, down, replayed):
            wait_until(link.done.is_set)
        acquisition.stop()
        gaps = store.rows("SELECT channel, reason, start_monotonic_ns, end_monotonic_ns FROM gaps ORDER BY 1, 3")
    start_ns, up_ns = begun.monotonic_ns, up.monotonic_ns
    assert [tuple(gap.values()) for gap in gaps] == [
        ("boom", "link_down", start_ns, up_ns),
        ("station", "link_down", start_ns, up_ns),
        ("station", "link_down", up_ns, None),
    ]


def test_a_link_counts_as_read_from_its_first_word_on() -> None:
    """Until then the gap until its port is open is not told yet, and a kill would lose it."""
    clock = SystemClock()
    begun = clock.now()
    read, gate, stop = begun.shifted(2_000_000_000), threading.Event(), threading.Event()
    loop = ListLink("boom", [DeviceEvent("boom", begun.shifted(1_000_000_000), EventKind.LINK_UP, "open")], gate)
    loop.read_until = read
    intake = LinkIntake(loop, clock, 100, begun)
    intake.start(stop)
    assert intake.read_until == begun
    gate.set()
    wait_until(lambda: intake.read_until == read)
    stop.set()
    intake.join(DEADLINE_S)
    gap, _ = intake.drain()
    assert gap == Gap("boom", GapReason.LINK_DOWN, begun, begun.shifted(1_000_000_000))


def test_what_came_between_a_loop_s_death_and_its_next_life_lies_in_a_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_intake, "RESTART_S", 0.01)
    clock = SystemClock()
    begun = clock.now()
    read, opened = begun.shifted(1_000_000_000), begun.shifted(3_000_000_000)

    class Dies(ListLink):
        lives = 0

        def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
            self.lives += 1
            emit(DeviceEvent("boom", begun if self.lives == 1 else opened, EventKind.LINK_UP, "open"))
            if self.lives == 1:
                self.read_until = read
                raise RuntimeError("a defect")
            super().run(emit, stop)

    loop, stop = Dies("boom", []), threading.Event()
    intake = LinkIntake(loop, clock, 100, begun)
    intake.start(stop)
    wait_until(loop.done.is_set)
    stop.set()
    intake.join(DEADLINE_S)
    assert [item for item in intake.drain() if isinstance(item, Gap)] == [
        Gap("boom", GapReason.LINK_DOWN, read, opened)
    ]


@pytest.mark.parametrize("is_open", [False, True])
def test_a_link_that_is_not_read_for_long_has_a_gap_of_its_own(monkeypatch: pytest.MonkeyPatch, is_open: bool) -> None:
    """Its loop hangs, as it opens the port or later. What the others captured meanwhile is in no doubt."""
    monkeypatch.setattr(link_intake, "LEFT_BEHIND_S", 0.0)
    clock = SystemClock()
    begun = clock.now().shifted(-9_000_000_000)
    read = opened = begun.shifted(1_000_000_000)
    up = DeviceEvent("boom", opened, EventKind.LINK_UP, "open")
    gate, stop = threading.Event(), threading.Event()
    loop = ListLink("boom", [up], gate)
    intake = LinkIntake(loop, clock, 100, begun)
    intake.start(stop)
    if is_open:
        gate.set()
        wait_until(loop.done.is_set)
        intake.drain()  # what came of the start
        loop.read_until = read
    since = read if is_open else begun
    assert intake.drain() == [Gap("boom", GapReason.LINK_DOWN, since)]
    assert (intake.read_until, intake.drain()) == (None, []), "it is told once, and not waited for"
    if is_open:
        loop.read_until = clock.now().shifted(1_000_000_000)  # it goes on
        assert intake.drain() == [Gap("boom", GapReason.LINK_DOWN, since, loop.read_until)]
        assert intake.read_until == loop.read_until
    else:
        gate.set()
        wait_until(loop.done.is_set)
        assert intake.drain() == [Gap("boom", GapReason.LINK_DOWN, since, opened), up]
    stop.set()
    intake.join(DEADLINE_S)


def test_a_log_that_begins_late_is_no_link_that_is_down(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_intake, "LEFT_BEHIND_S", 0.0)
    clock = SystemClock()
    begun = clock.now().shifted(-60_000_000_000)
    late = CanCapture("boom", clock.now().shifted(200_000_000), 1, b"")
    replay, stop = ReplayLink("boom", [late], clock), threading.Event()
    intake = LinkIntake(replay, clock, 100, begun)
    intake.start(stop)
    assert intake.drain() == []
    wait_until(replay.is_finished.is_set)
    assert intake.drain() == [late]
    stop.set()
    intake.join(DEADLINE_S)
