from __future__ import annotations

import math
from dataclasses import dataclass, field

import pytest

from daemon.sessions.prisms.guard import MotionLimit, OperatorConfirmation, PrismGuard
from drivers.clock import Stamp
from drivers.readings import DeviceEvent, EventKind, Fix, LockState, Status
from drivers.stations.config import StationConfig

START = Stamp(1_700_000_000_000_000_000, 1_000_000_000, "boot")
A_DAY_S = 86_400.0


def at(seconds: float) -> Stamp:
    return START.shifted(round(seconds * 1e9))


def order(stamp: Stamp) -> tuple[int, int]:
    return int(stamp.boot_id != START.boot_id), stamp.monotonic_ns


@dataclass
class Watched:
    """A guard, and what it said of the fixes that it was given.

    Attributes:
        limit: of the station.
        says_lock: whether its records say that it is locked.
    """

    limit: MotionLimit = field(default_factory=MotionLimit)
    says_lock: bool = True
    words: list[OperatorConfirmation] = field(default_factory=list)
    events: list[DeviceEvent] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.guard = PrismGuard("station", self.limit, self.words, order)

    def fixes(
        self, start_s: float, count: int, slope_m: float, step_m: float = 0.0, every_s: float = 0.1
    ) -> list[bool]:
        """Feed fixes of a target that moves by `step_m` from one to the next; which of them count."""
        lock = LockState.LOCKED if self.says_lock else LockState.UNKNOWN
        stamps = [at(start_s + every_s * k) for k in range(count)]
        for k, stamp in enumerate(stamps):
            slope = slope_m + step_m * k
            self._see(Fix("station", stamp, stamp, Status.OK, lock, 0.0, math.pi / 2, slope))
        return [self.guard.doubt(stamp) is None for stamp in stamps]

    def coordinates(self, start_s: float, north_m: float) -> bool:
        stamp = at(start_s)
        fix = Fix("station", stamp, stamp, Status.OK, LockState.UNKNOWN, north_m=north_m, east_m=0.0, up_m=0.0)
        self._see(fix)
        return self.guard.doubt(stamp) is None

    def no_prism(self, start_s: float) -> None:
        """The station says that it is not on a prism, or has no distance."""
        lock = LockState.SEARCHING if self.says_lock else LockState.UNKNOWN
        self._see(Fix("station", at(start_s), at(start_s), Status.NOT_AVAILABLE, lock))

    def say(self, seconds: float, *, is_turning: bool = False) -> None:
        self.words.append(OperatorConfirmation(at(seconds), is_turning))

    def _see(self, fix: Fix) -> None:
        event = self.guard.see(fix)
        if event is not None:
            self.events.append(event)

    def told(self, kind: EventKind) -> list[str]:
        return [event.text for event in self.events if event.kind is kind]


def test_motion_is_no_jump() -> None:
    watched = Watched()
    assert all(watched.fixes(0, 30, 10, 0.1))  # 1 m/s
    assert watched.events == []


def test_fast_motion_whose_fixes_were_read_late_is_no_jump() -> None:
    watched = Watched()
    for k in range(100):  # 4 m/s, measured every 0.5 s, every third read 0.3 s late
        assert watched.fixes(0.5 * k + (0.3 if k % 3 == 0 else 0.0), 1, 10 + 2.0 * k) == [True]


def test_the_fixes_after_a_jump_are_in_doubt_with_when_how_far_and_what_to_do() -> None:
    watched = Watched()
    assert watched.fixes(0, 5, 10, 0.05) == [True] * 5
    assert watched.fixes(0.5, 20, 11.75, 0.05) == [False] * 20
    (text,) = watched.told(EventKind.PRISM_JUMP)
    assert text.startswith("the target moved 1.55 m away after 0.10 s: perhaps another prism")
    assert "rigcal session confirm-prism" in text
    suspicion = watched.guard.suspicion
    assert suspicion is not None
    assert (suspicion.station, suspicion.since, suspicion.distance_m) == ("station", at(0.5), pytest.approx(1.55))
    assert suspicion.reason == "perhaps another prism: the station's target jumped by 1.55 m"
    assert "aim station at the session's prism" in suspicion.remedy


def test_however_long_another_prism_is_followed_its_fixes_never_count() -> None:
    watched = Watched()
    watched.fixes(0, 5, 10)
    assert not any(watched.fixes(0.5, 400, 20))
    assert not any(watched.fixes(60, 100, 20, every_s=A_DAY_S))
    assert watched.guard.suspicion is not None


def test_a_new_lock_on_another_prism_ends_no_suspicion() -> None:
    watched = Watched()
    watched.fixes(0, 5, 10)
    watched.fixes(0.5, 5, 11.5)
    watched.no_prism(1)
    assert not any(watched.fixes(40, 20, 11.5))
    watched.no_prism(50)
    assert not any(watched.fixes(60, 20, 15))
    assert watched.told(EventKind.PRISM_JUMP)[1:] == [
        "locked again 1.50 m from the prism: perhaps another prism; its fixes are still not used",
        "locked again 5.00 m from the prism: perhaps another prism; its fixes are still not used",
    ]


def test_a_search_that_finds_another_prism_far_away_is_suspected_however_long_it_took() -> None:
    for took_s in (2.0, 30.0, A_DAY_S):
        watched = Watched()
        watched.fixes(0, 5, 10)
        watched.no_prism(0.5)
        assert not any(watched.fixes(took_s, 5, 12.5))
        assert watched.told(EventKind.PRISM_JUMP)[0].startswith("locked again 2.50 m away")


def test_a_new_lock_near_the_place_of_the_loss_counts() -> None:
    watched = Watched()
    watched.fixes(0, 5, 10)
    watched.no_prism(0.5)
    assert all(watched.fixes(3, 5, 11.9))
    assert watched.events == []


def test_how_far_a_new_lock_may_be_can_be_set() -> None:
    watched = Watched(MotionLimit(relock_within_m=10.0))
    watched.fixes(0, 5, 10)
    watched.no_prism(0.5)
    assert all(watched.fixes(5, 5, 19))


@pytest.mark.parametrize("is_locked_anew", [False, True])
def test_back_on_the_earlier_prism_the_fixes_count_again(is_locked_anew: bool) -> None:
    watched = Watched()
    watched.fixes(0, 5, 10)
    watched.fixes(0.5, 5, 20)
    if is_locked_anew:
        watched.no_prism(1.0)
    assert all(watched.fixes(600, 5, 10.3))
    assert watched.guard.suspicion is None
    assert watched.told(EventKind.LOCK_ACQUIRED) == ["the target is the earlier prism again; its fixes are used again"]


def test_another_prism_that_passes_the_place_of_the_earlier_one_stays_another() -> None:
    watched = Watched()
    watched.fixes(0, 5, 10)
    assert not any(watched.fixes(0.5, 200, 11.5, -0.02))  # through 10 m and beyond, without a break


def test_near_each_other_two_prisms_are_told_apart() -> None:
    watched = Watched()
    watched.fixes(0, 5, 10)
    watched.fixes(0.5, 5, 11)
    watched.no_prism(1.0)
    assert not any(watched.fixes(2, 5, 10.6))  # nearer to the other one
    watched.no_prism(3.0)
    assert all(watched.fixes(4, 5, 10.4))


def test_a_jump_on_to_a_third_prism_stays_in_doubt() -> None:
    watched = Watched()
    watched.fixes(0, 5, 10)
    assert not any(watched.fixes(0.5, 5, 11.5) + watched.fixes(1.0, 5, 13.5))
    assert watched.told(EventKind.PRISM_JUMP)[1].startswith("the target jumped again 3.50 m from the prism")
    assert watched.guard.suspicion is not None
    assert watched.guard.suspicion.distance_m == pytest.approx(3.5)


def test_a_single_wrong_fix_costs_itself_alone() -> None:
    watched = Watched()
    assert (
        watched.fixes(0, 3, 10) + watched.fixes(0.3, 1, 14) + watched.fixes(0.4, 3, 10)
        == [True] * 3 + [False] + [True] * 3
    )


def test_an_operator_s_word_ends_the_suspicion_from_then_on_and_not_before() -> None:
    watched = Watched()
    watched.fixes(0, 5, 10)
    watched.fixes(0.5, 5, 20)
    watched.say(2.0)
    assert watched.guard.suspicion is None  # at once for whoever looks
    assert watched.fixes(1.0, 20, 20) == [False] * 10 + [True] * 10
    assert not any(watched.fixes(3.0, 5, 10))  # what was the prism before is another one now


def test_a_word_given_while_nothing_is_suspected_lets_the_next_target_be_any() -> None:
    watched = Watched()
    watched.fixes(0, 5, 10)
    watched.say(1.0)
    assert all(watched.fixes(1.1, 5, 20))


def test_a_station_that_was_told_to_turn_may_still_measure_its_earlier_target() -> None:
    for record_tells in (True, False):
        watched = Watched()
        watched.say(0.0, is_turning=True)
        watched.fixes(0.01, 2, 30)
        if record_tells:
            watched.no_prism(0.5)
        assert all(watched.fixes(1.5, 5, 10))
        assert not any(watched.fixes(2.0, 5, 30))  # the turn is over


def test_a_lock_that_is_lost_after_the_turn_and_found_on_another_prism_is_no_turn() -> None:
    watched = Watched()
    watched.fixes(-2.0, 20, 10)
    watched.say(0.0, is_turning=True)
    assert all(watched.fixes(0.1, 5, 14)), "the station has turned before its first fix"
    watched.no_prism(0.8)
    assert not any(watched.fixes(1.2, 10, 22)), "its own search has found another prism"
    assert len(watched.told(EventKind.PRISM_JUMP)) == 1


def test_a_station_that_had_no_prism_before_it_was_told_to_turn_may_lock_on_any() -> None:
    watched = Watched()
    watched.fixes(-2.0, 10, 10)
    watched.no_prism(-0.5)
    watched.say(0.0, is_turning=True)
    watched.no_prism(0.2)
    assert all(watched.fixes(0.5, 10, 22))


def test_a_station_that_measures_its_earlier_target_after_a_pause_may_still_turn() -> None:
    watched = Watched()
    watched.fixes(-5.0, 10, 10)
    watched.say(0.0, is_turning=True)
    assert all(watched.fixes(0.2, 3, 10.2))
    assert all(watched.fixes(0.9, 10, 22))
    assert watched.told(EventKind.PRISM_JUMP) == []


def test_after_something_else_on_purpose_the_prism_is_expected_near_its_place() -> None:
    watched = Watched()
    watched.fixes(0, 5, 10)
    watched.guard.look_away()
    assert all(watched.fixes(60, 5, 10.5))
    watched.guard.look_away()
    assert not any(watched.fixes(120, 5, 13))


def test_a_reboot_ends_no_suspicion_and_hides_no_jump() -> None:
    watched = Watched()
    watched.fixes(0, 5, 10)
    watched.guard.look_away()
    later = Stamp(START.utc_ns + 10**12, 5, "next boot")
    watched.guard.see(Fix("station", later, later, Status.OK, LockState.LOCKED, 0.0, math.pi / 2, 20.0))
    assert watched.guard.doubt(later) is not None


def test_a_boot_whose_clock_was_set_back_ends_no_suspicion_and_forgets_no_word() -> None:
    watched = Watched()
    watched.fixes(0, 5, 10)
    assert not any(watched.fixes(0.5, 5, 20))
    later = Stamp(START.utc_ns - 10**15, 5, "next boot")
    again = Fix("station", later, later, Status.OK, LockState.LOCKED, 0.0, math.pi / 2, 20.0)
    watched.guard.see(again)
    assert watched.guard.doubt(later) is not None
    assert watched.guard.suspicion is not None
    watched.say(1)
    watched.guard.see(again)
    assert watched.guard.doubt(later) is None


def test_shots_of_a_station_that_is_aimed_by_hand_are_judged_by_speed_alone() -> None:
    watched = Watched(says_lock=False)
    for k, slope_m in enumerate((10, 15, 9)):
        watched.no_prism(20.0 * k - 5)
        assert watched.fixes(20.0 * k, 1, slope_m) == [True]
    assert watched.fixes(40.1, 1, 15) == [False]
    assert watched.fixes(60.0, 1, 9.5) == [True]


def test_a_station_that_tracks_without_saying_so_has_lost_its_prism_where_it_has_no_distance() -> None:
    config = StationConfig.model_validate({"serial": {"path": "x"}, "profile": "sokkia_set", "init": ["Xe"]})
    watched = Watched(MotionLimit.of_station(config), says_lock=False)
    watched.fixes(0, 5, 10)
    watched.no_prism(1)
    assert not any(watched.fixes(30, 5, 15))


def test_coordinates_and_circles_are_never_compared_and_end_no_suspicion() -> None:
    watched = Watched()
    watched.fixes(0, 5, 10)
    assert watched.coordinates(0.5, 500.0)
    assert watched.fixes(0.6, 2, 10) == [True, True]
    watched.fixes(0.8, 2, 20)
    assert not watched.coordinates(1.0, 500.0)
    assert not any(watched.fixes(1.1, 2, 20))


def test_a_jump_long_after_the_station_was_told_to_turn_is_another_prism() -> None:
    watched = Watched(says_lock=False)
    watched.say(0.0, is_turning=True)
    assert watched.fixes(30.0, 10, 10.0) == [True] * 10
    assert watched.fixes(31.0, 10, 13.0) == [False] * 10


def test_the_turns_of_a_station_divide_its_fixes_by_target() -> None:
    watched = Watched()
    watched.fixes(0, 5, 10)
    watched.no_prism(0.5)
    watched.fixes(1.0, 5, 10.2)
    watched.say(1.6)
    watched.fixes(2.0, 5, 10.2)
    assert [(turn.at, turn.is_believed) for turn in watched.guard.turns] == [
        (at(0), False),
        (at(1), False),
        (at(2), True),
    ]
    assert watched.guard.turn(at(1.2)) == watched.guard.turns[1]
    assert watched.guard.turn(START.shifted(-1)) is None


def test_only_the_fixes_between_two_turns_are_suspected_and_cleared_by_other_evidence() -> None:
    watched = Watched()
    watched.fixes(0, 5, 10)
    watched.no_prism(0.5)
    watched.fixes(1.0, 5, 10.2)
    first, second = watched.guard.turns
    watched.guard.suspect(first, 3.0, "3 m off")
    assert watched.guard.doubt(at(0.2)) is not None
    assert watched.guard.doubt(at(1.0)) is None
    watched.guard.suspect(second, 3.0, "3 m off")
    assert watched.guard.suspicion is not None
    watched.guard.clear(first)
    assert watched.guard.doubt(at(0.2)) is None
    assert watched.guard.doubt(at(1.2)) is not None
    watched.guard.clear(second)
    assert watched.guard.suspicion is None
