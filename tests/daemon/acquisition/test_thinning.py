"""Outside sessions one reading a second is stored, and whatever changes its status; in sessions everything is."""

from __future__ import annotations

from daemon.acquisition.thinning import Thinning
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import DecodeFailure, Reading, Record, Status
from tests.daemon.support.store import at, fix, reading


def outside(_: Stamp) -> bool:
    return False


def seconds_of(records: list[Record]) -> list[int]:
    """Into which second of the test each reading falls."""
    start_ns = at(0.0).monotonic_ns
    return [(r.stamp.monotonic_ns - start_ns) // NS_PER_S for r in records if isinstance(r, Reading)]


def test_one_reading_of_each_channel_and_one_fix_a_second_are_kept() -> None:
    records: list[Record] = []
    for n in range(500):
        records += [reading("theta1", n / 100, 1.0), reading("theta2", n / 100, 2.0)]
        records += [fix(n / 100)] if n % 10 == 0 else []
    kept = Thinning(outside).kept(records)
    assert seconds_of(kept) == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    assert len(kept) == 15


def test_in_a_session_and_only_there_all_are_kept() -> None:
    records = [reading("theta1", n / 100, 1.0) for n in range(500)]
    kept = Thinning(lambda stamp: at(2.0).monotonic_ns <= stamp.monotonic_ns < at(3.0).monotonic_ns).kept(records)
    seconds = seconds_of(kept)
    assert [seconds.count(second) for second in range(5)] == [1, 1, 100, 1, 1]


def test_a_change_of_status_another_boot_and_all_that_is_no_reading_are_kept() -> None:
    alarm = reading("theta1", 0.02, None, status=Status.DEVICE_ALARM)
    failure = DecodeFailure("theta1", at(0.03), "cut off", b"1")
    again = reading("theta1", 0.04, 1.0)
    rebooted = Reading("theta1", Stamp(1, 1, "another"), 1.0, "deg")
    records = [reading("theta1", 0.0, 1.0), reading("theta1", 0.01, 1.0), alarm, failure, again, rebooted]
    assert Thinning(outside).kept(records) == [records[0], alarm, failure, again, rebooted]
