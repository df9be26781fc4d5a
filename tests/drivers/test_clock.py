"""The host's two clocks are read as of one instant, however the thread that reads them is interrupted."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.clock import NS_PER_S, ManualClock, ScaledClock, Stamp, SystemClock

AHEAD_NS = 1_700_000_000 * NS_PER_S
READING_NS = 100  # what it takes to read a clock
START = Stamp(AHEAD_NS + NS_PER_S, NS_PER_S, "boot")


class Computer:
    """Clocks that agree, on a computer that interrupts whoever reads them.

    Args:
        interruptions_ns: after each reading, in turn; none when they are used up.
    """

    def __init__(self, interruptions_ns: Iterator[int]) -> None:
        self.elapsed_ns = NS_PER_S
        self._interruptions_ns = interruptions_ns

    def clock(self) -> SystemClock:
        return SystemClock(lambda: self._reading(AHEAD_NS), lambda: self._reading(0))

    def _reading(self, ahead_ns: int) -> int:
        read_ns = self.elapsed_ns + ahead_ns
        self.elapsed_ns += READING_NS + next(self._interruptions_ns, 0)
        return read_ns


@pytest.mark.parametrize("number", range(4))
def test_an_interruption_between_two_clocks_does_not_shift_them(number: int) -> None:
    computer = Computer(iter([NS_PER_S if n == number else 0 for n in range(number + 1)]))
    started_ns = computer.elapsed_ns
    now = computer.clock().now()
    assert abs(now.utc_ns - now.monotonic_ns - AHEAD_NS) <= 2 * READING_NS
    assert started_ns <= now.monotonic_ns <= computer.elapsed_ns


def test_of_readings_that_are_all_interrupted_the_best_counts() -> None:
    interruptions_ns = [50_000_000, 40_000_000, 30_000_000, 20_000_000, 300_000, 200_000] + [60_000_000] * 20
    now = Computer(iter(interruptions_ns)).clock().now()
    assert abs(now.utc_ns - now.monotonic_ns - AHEAD_NS) < 500_000


def test_clocks_that_are_not_interrupted_are_read_once() -> None:
    computer = Computer(iter(()))
    computer.clock().now()
    assert computer.elapsed_ns - NS_PER_S == 3 * READING_NS


def test_an_instant_of_the_host_is_known_on_a_clock_that_runs_fast() -> None:
    clock = ScaledClock(20.0, START, real_origin_ns=5 * NS_PER_S)
    host = Stamp(7, 6 * NS_PER_S, "host")
    assert clock.of_host(host) == START.shifted(20 * NS_PER_S)
    assert clock.of_host(host.doubted()) == START.shifted(20 * NS_PER_S).doubted()
    before, host, after = clock.now(), clock.host.now(), clock.now()
    assert before.monotonic_ns <= clock.of_host(host).monotonic_ns <= after.monotonic_ns


def test_a_clock_that_is_moved_by_hand_shows_what_it_was_set_to_at_any_instant_of_the_host() -> None:
    clock = ManualClock(START)
    assert clock.of_host(clock.host.now()) == START
    assert clock.of_host(clock.host.now().doubted()) == START.doubted()


def test_a_doubtful_instant_stays_doubtful_when_it_is_shifted() -> None:
    assert START.doubted().shifted(1) == START.shifted(1).doubted() != START.shifted(1)
