"""`time_s` of all sessions lies on one axis that never runs backward, whatever the computer's clock was set to."""

from __future__ import annotations

import csv
import io
from itertools import pairwise

import pytest

from daemon.sessions.session_data import sessions_csv
from daemon.store.queries.time_axis import TimeAxis, time_axis
from daemon.store.reader import Reader
from drivers.clock import NS_PER_S, Stamp
from tests.daemon.support.sessions import SOURCE, STEP_S, Rig, closed_afterwards, controlled

HOUR_S = 3600.0
YEARS_S = 5 * 365 * 86_400.0

rig = closed_afterwards(Rig)


def step(rig: Rig, seconds: float, boot: str = "") -> None:
    """Set the computer's clock, and boot the computer where one is named."""
    now = rig.clock.now()
    monotonic_ns = NS_PER_S if boot else now.monotonic_ns
    rig.clock.set(Stamp(now.utc_ns + round(seconds * NS_PER_S), monotonic_ns, boot or now.boot_id))
    if boot:
        rig.store.begin_run(rig.clock.now())
        rig.keeper = rig.new_keeper()


def times(rig: Rig, *sessions: str) -> dict[str, list[float]]:
    """Session -> time_s of its rows."""
    found: dict[str, list[float]] = {name: [] for name in sessions}
    with Reader(rig.store.path) as reader:
        for row in csv.DictReader(io.StringIO(sessions_csv(reader, SOURCE.rig, sessions).decode())):
            found[row["session"]].append(float(row["time_s"]))
    return found


def present(rig: Rig) -> float | None:
    return time_axis(rig.store).present(rig.clock.now())


@pytest.fixture
def first(rig: Rig) -> str:
    """A session before anything happens to the clock."""
    rig.say("setup_new", id="S1")
    return controlled(rig)


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [-HOUR_S, HOUR_S])
def test_a_clock_that_is_set_between_sessions_does_not_move_the_later_one(rig: Rig, first: str, seconds: float) -> None:
    ended = present(rig)
    rig.live(60)
    step(rig, seconds)
    second = controlled(rig)
    found = times(rig, first, second)
    assert ended is not None
    assert found[first][0] == 0.0
    assert 60.0 < found[second][0] - ended < 75.0
    assert found[second] == times(rig, second)[second], "the axis is the same whichever sessions are asked for"
    assert present(rig) == pytest.approx(found[second][-1], abs=5.0)


def test_a_boot_with_an_earlier_clock_follows_directly_on_the_one_before(rig: Rig, first: str) -> None:
    step(rig, -YEARS_S, "next boot")
    assert present(rig) is None, "the clock is wrong, and nothing else tells the time"
    rig.live(3)
    second = controlled(rig)
    step(rig, YEARS_S, "boot with a clock that is right")
    third = controlled(rig)
    found = times(rig, first, second, third)
    rows = [at_s for name in (first, second, third) for at_s in found[name]]
    assert all(later >= earlier for earlier, later in pairwise(rows))
    assert found[second][0] - found[first][-1] < 60.0
    assert found[third][0] - found[second][-1] < 60.0, "by the clock of the first boot, which was right"


def test_a_boot_whose_clock_is_right_lies_as_much_later_as_the_clock_says(rig: Rig, first: str) -> None:
    step(rig, HOUR_S, "next boot")
    assert present(rig) == pytest.approx(HOUR_S, abs=60.0)
    second = controlled(rig)
    found = times(rig, first, second)
    assert found[second][0] - found[first][-1] == pytest.approx(HOUR_S, abs=60.0)
    step(rig, -2 * HOUR_S)
    rig.live(STEP_S)
    assert present(rig) == pytest.approx(found[second][-1], abs=10.0)


@pytest.mark.parametrize("wrong_s", [2 * YEARS_S, HOUR_S / 2, -YEARS_S / 10, -10 * YEARS_S])
@pytest.mark.parametrize("is_wrong_first", [True, False])
def test_a_clock_that_is_wrong_at_the_begin_or_the_end_of_a_boot_moves_no_later_boot(
    rig: Rig, first: str, wrong_s: float, *, is_wrong_first: bool
) -> None:
    step(rig, HOUR_S + is_wrong_first * wrong_s, "boot-2")
    second = controlled(rig)
    step(rig, -wrong_s if is_wrong_first else wrong_s)
    third = controlled(rig)
    step(rig, 24 * HOUR_S - (not is_wrong_first) * wrong_s, "boot-3")
    small_s = abs(wrong_s) if abs(wrong_s) < HOUR_S else 0.0  # cannot be told from time that passed
    assert present(rig) == pytest.approx(25 * HOUR_S, abs=120.0 + small_s)
    fourth = controlled(rig)
    found = times(rig, first, second, third, fourth)
    assert found[second][0] - found[first][-1] == pytest.approx(HOUR_S, abs=60.0 + small_s)
    assert found[third][0] - found[second][-1] < 60.0
    assert found[fourth][0] - found[third][-1] == pytest.approx(24 * HOUR_S, abs=60.0 + small_s)
    assert found[fourth][-1] == pytest.approx(present(rig), abs=10.0)


def test_boots_whose_clock_is_behind_lie_as_far_apart_as_it_says_and_move_no_boot_whose_clock_is_right(
    rig: Rig, first: str
) -> None:
    step(rig, HOUR_S - YEARS_S / 10, "boot-2")
    second = controlled(rig)
    step(rig, HOUR_S, "boot-3")
    third = controlled(rig)
    step(rig, 24 * HOUR_S + YEARS_S / 10, "boot-4")
    fourth = controlled(rig)
    found = times(rig, first, second, third, fourth)
    assert found[second][0] - found[first][-1] < 60.0
    assert found[third][0] - found[second][-1] == pytest.approx(HOUR_S, abs=60.0)
    assert found[fourth][0] == pytest.approx(26 * HOUR_S, abs=180.0), "the hour that was lost is there again"


def test_a_boot_whose_clock_is_behind_is_not_timed_by_a_clock_that_was_wrong_before_it_was_set(rig: Rig) -> None:
    wrong_s = 200 * 24 * HOUR_S
    step(rig, -wrong_s, "boot-1")
    rig.say("setup_new", id="S1")
    first = controlled(rig)
    step(rig, wrong_s)
    second = controlled(rig)
    step(rig, -HOUR_S / 10, "boot-2")
    third = controlled(rig)
    step(rig, 24 * HOUR_S + HOUR_S / 10, "boot-3")
    fourth = controlled(rig)
    found = times(rig, first, second, third, fourth)
    assert found[third][0] - found[second][-1] < 60.0
    assert found[fourth][0] - found[third][-1] == pytest.approx(24 * HOUR_S, abs=HOUR_S / 5)


@pytest.mark.parametrize(("ahead_s", "pause_s"), [(24 * HOUR_S, 16 * HOUR_S), (2 * HOUR_S, 1.2 * HOUR_S)])
def test_a_boot_after_one_whose_clock_was_ahead_until_it_was_set_lies_as_much_later_as_its_clock_says(
    rig: Rig, ahead_s: float, pause_s: float
) -> None:
    step(rig, ahead_s, "boot-1")
    rig.say("setup_new", id="S1")
    first = controlled(rig)
    step(rig, -ahead_s)
    second = controlled(rig)
    step(rig, pause_s, "boot-2")
    before = present(rig)
    third = controlled(rig)
    found = times(rig, first, second, third)
    assert before == pytest.approx(found[second][-1] + pause_s, abs=60.0)
    assert found[third][0] - found[second][-1] == pytest.approx(pause_s, abs=60.0)


def test_boots_after_one_whose_clock_was_years_ahead_lie_as_far_apart_as_theirs_says(rig: Rig, first: str) -> None:
    step(rig, 2 * YEARS_S, "boot-2")
    second = controlled(rig)
    step(rig, HOUR_S - 2 * YEARS_S, "boot-3")
    third = controlled(rig)
    step(rig, HOUR_S, "boot-4")
    fourth = controlled(rig)
    found = times(rig, first, second, third, fourth)
    assert found[third][0] - found[second][-1] < 60.0
    assert found[fourth][0] - found[third][-1] == pytest.approx(HOUR_S, abs=60.0)


def test_a_store_without_observations_has_an_axis_of_the_clock(rig: Rig) -> None:
    assert time_axis(rig.store) == TimeAxis({})
