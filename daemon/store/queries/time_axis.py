"""A single time axis for all observations of a store, independent of settings of the computer's clock.

Within a boot, time follows the monotonic clock. From the last observation of a boot to the first of the next boot it
follows the computer's clock, and stands still if that shows an earlier time.

Any clock may be wrong. A boot is dated by the clock at its first observation and at its last one; the end of a boot is
also dated by the latest time of earlier boots. The shortest time between two boots by any of these is used, so that a
clock that is wrong during part of a boot does not move later boots far.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from daemon.store.queries.observations import first_observation
from daemon.store.rows import RowSource
from drivers.clock import NS_PER_S, Stamp

SET_SINCE_NS = 1_577_836_800 * NS_PER_S  # 2020: a clock that shows an earlier time is not set

# With min() or max() SQLite takes the other columns from the row of the smallest or largest value.
_BOOTS = """WITH firsts AS (SELECT boot_id, min(monotonic_ns) AS first_ns, utc_ns AS first_utc_ns FROM observations
            GROUP BY boot_id),
        lasts AS (SELECT boot_id, max(monotonic_ns) AS last_ns, utc_ns AS last_utc_ns FROM observations
            GROUP BY boot_id)
    SELECT kernel_boot_id, first_ns, first_utc_ns, last_ns, last_utc_ns FROM firsts JOIN lasts USING (boot_id)
        JOIN boots ON boots.id = boot_id ORDER BY boot_id"""


@dataclass(frozen=True)
class TimeAxis:
    """The axis of `time_s` of observations: seconds since the first observation that calibration may use.

    Attributes:
        offsets_ns: boot -> offset to add to its monotonic clock.
        end_ns: instant of the newest observation on the axis.
        ends_utc_ns: UTC at that instant, by each clock that may be right.
        shown_ns: UTC that the computer's clock showed at that instant.
    """

    offsets_ns: dict[str, int]
    end_ns: int = 0
    ends_utc_ns: tuple[int, ...] = ()
    shown_ns: int = 0

    def observed(self, stamp: Stamp) -> float:
        """Return the time on the axis, s, of an instant in a boot with observations."""
        return (stamp.monotonic_ns + self.offsets_ns[stamp.boot_id]) / NS_PER_S

    def present(self, stamp: Stamp) -> float | None:
        """Return the time on the axis, s, of an instant that is not before the newest observation.

        In a boot without observations the computer's clock is used; None if it shows an earlier time than at the newest
        observation, and so is wrong.
        """
        if stamp.boot_id in self.offsets_ns:
            return self.observed(stamp)
        passed_ns = _least_ns([stamp.utc_ns], self.ends_utc_ns, self.shown_ns)
        return None if passed_ns is None else (self.end_ns + passed_ns) / NS_PER_S


def time_axis(source: RowSource) -> TimeAxis:
    """Return the axis of all observations of a store, used or not, so that it does not depend on the sessions read."""
    offsets_ns: dict[str, int] = {}
    end_ns = 0
    ends_utc_ns: tuple[int, ...] = ()
    shown_last_ns = 0
    for boot in source.rows(_BOOTS):
        span_ns = boot["last_ns"] - boot["first_ns"]
        shown_ns = boot["first_utc_ns"], boot["last_utc_ns"] - span_ns
        begins_utc_ns = [utc_ns for utc_ns in shown_ns if utc_ns >= SET_SINCE_NS]
        passed_ns = _least_ns(begins_utc_ns, ends_utc_ns, shown_last_ns) or 0
        begin_ns = end_ns + passed_ns
        offsets_ns[boot["kernel_boot_id"]] = offset_ns = begin_ns - boot["first_ns"]
        end_ns = boot["last_ns"] + offset_ns
        # The latest time of earlier boots may be right if this boot's clock is behind.
        begins_utc_ns += [ns + passed_ns for ns in ends_utc_ns[-1:]]
        ends_utc_ns = tuple(sorted({ns + span_ns for ns in begins_utc_ns}))
        shown_last_ns = boot["last_utc_ns"]
    first = first_observation(source)
    zero_ns = 0 if first is None else first["monotonic_ns"] + offsets_ns[first["kernel_boot_id"]]
    offsets_ns = {boot: ns - zero_ns for boot, ns in offsets_ns.items()}
    return TimeAxis(offsets_ns, end_ns - zero_ns, ends_utc_ns, shown_last_ns)


def _least_ns(begins_utc_ns: Sequence[int], ends_utc_ns: Sequence[int], shown_ns: int) -> int | None:
    """Return the shortest time from an end to a begin that is not before it; None if there is none.

    None is also returned if the clock is behind: all begins are before the UTC that the clock last showed, and the pair
    of begin and end that is nearest has the begin first. No earlier end is right then.

    Args:
        begins_utc_ns: possible UTC of the begin of a boot.
        ends_utc_ns: possible UTC of the end of the previous boot.
        shown_ns: UTC that the clock last showed.
    """
    passed_ns = [begin - end for begin in begins_utc_ns for end in ends_utc_ns]
    is_behind = all(begin < shown_ns for begin in begins_utc_ns) and min(passed_ns, key=abs, default=0) < 0
    return None if is_behind else min((ns for ns in passed_ns if ns >= 0), default=None)
