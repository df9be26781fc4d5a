"""A clock that is set is an event with its size; what only looks like one is none."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.acquisition.acquisition import Acquisition
from daemon.acquisition.clock_watch import ClockWatch
from daemon.store import Store
from drivers.clock import NS_PER_S, ManualClock, ScaledClock, Stamp, SystemClock
from drivers.readings import EventKind
from tests.daemon.support.acquisition import ListLink, NumberDecoder, wait_until
from tests.daemon.support.store import at, frame, table


class SetClock(SystemClock):
    """The host's clocks, with a UTC that tests set."""

    ahead_s = 0.0

    def now(self) -> Stamp:
        now = super().now()
        return Stamp(now.utc_ns + round(self.ahead_s * NS_PER_S), now.monotonic_ns, now.boot_id)


def told(watch: ClockWatch, *looks: tuple[float, float]) -> list[tuple[str, int | None]]:
    """Text and size of the steps that are told at looks (monotonic s, s that UTC is ahead)."""
    found = []
    for monotonic_s, ahead_s in looks:
        now = at(monotonic_s)
        event = watch.look(Stamp(now.utc_ns + round(ahead_s * NS_PER_S), now.monotonic_ns, now.boot_id))
        if event is not None:
            assert (event.device, event.kind) == ("clock", EventKind.CLOCK_STEP)
            found.append((event.text, event.code))
    return found


@pytest.mark.parametrize("direction", [("forward", 3600.2), ("back", -0.15)])
def test_a_clock_that_is_set_is_told_once_with_its_size(direction: tuple[str, float]) -> None:
    word, step_s = direction
    looks = [(t / 10, 0.0 if t < 20 else step_s) for t in range(60)]
    ((text, code),) = told(ClockWatch(), *looks)
    assert f"was set {word} by {abs(step_s):.1f} s" in text
    assert code == pytest.approx(step_s * 1000, abs=1)


def test_reads_that_lie_apart_once_and_a_clock_that_creeps_are_no_steps() -> None:
    assert (
        told(ClockWatch(), (0, 0), (0.1, 0.3), (0.2, 0), (0.3, -0.2), (0.4, 0), (0.5, 0.3), (0.6, 0.6), (0.7, 0)) == []
    )
    assert told(ClockWatch(), *((t / 10, t / 100) for t in range(100))) == []


def test_a_step_while_rigcal_did_not_run_is_told_at_the_next_start_of_the_same_boot() -> None:
    ((text, code),) = told(ClockWatch(at(0)), (100, -7200), (100.1, -7200), (100.2, -7200))
    assert "set back by 7200.0 s while rigcal was not running" in text
    assert code == -7_200_000
    assert told(ClockWatch(at(0, "another boot")), (100, -7200), (100.1, -7200)) == []
    assert told(ClockWatch(at(0)), (100, 0), (100.1, 0)) == []


def test_a_scaled_clock_makes_no_steps() -> None:
    clock, watch = ScaledClock(25.0, at(0)), ClockWatch()
    assert [watch.look(clock.now()) for _ in range(1000)] == [None] * 1000


def test_a_clock_that_is_set_while_acquiring_is_an_event_in_the_store(path: Path, store: Store) -> None:
    clock = SetClock()
    acquisition = Acquisition(
        [ListLink("boom", [frame(1)])],
        {},
        store,
        clock,
        batch_seconds=0.01,
        on_records=lambda _: None,
        clock_watch=ClockWatch(),
    )
    acquisition.start()
    try:
        wait_until(lambda: bool(table(path, "raw_chunks")))  # it has looked before it stores what came
        clock.ahead_s = 3600.2
        wait_until(lambda: bool(table(path, "device_events")))
    finally:
        acquisition.stop()
    (event,) = table(path, "device_events")
    assert (event["device"], event["kind"]) == ("clock", "clock_step")
    assert event["code"] == pytest.approx(3_600_200, abs=50)
    assert [e.kind for e in acquisition.status().last_events] == ["clock_step"]


def test_a_replay_invents_no_step_of_the_clock(path: Path, store: Store) -> None:
    early, late = frame(1), frame(2, 1.0)
    stepped = Stamp(late.stamp.utc_ns + 3600 * NS_PER_S, late.stamp.monotonic_ns, late.stamp.boot_id)
    items = [early, type(late)(late.link, stepped, late.arbitration_id, late.data)]
    clock = ManualClock(at(0))
    acquisition = Acquisition([ListLink("boom", [])], {"boom": NumberDecoder}, store, clock, on_records=lambda _: None)
    acquisition.run_inline(items)
    assert table(path, "device_events") == []


def test_the_run_before_is_known_however_it_ended(store: Store) -> None:
    store.begin_run(at(0))
    assert store.previous_end is None
    store.note_alive(at(5))
    store.begin_run(at(9))  # the one before was killed
    assert store.previous_end == at(5)
    store.end_run(at(20))
    store.begin_run(at(30))
    assert store.previous_end == at(20)
