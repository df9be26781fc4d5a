"""Joins each fix with the joints at its own instant: a pure state machine over records.

A fix was measured `link_delay_s` before the first byte of its record arrived. Every joint is interpolated linearly
between the two samples around that instant, on the monotonic clock. A fix therefore waits until every joint has been
sampled shortly after it, or some joint `deadline_s` after it. Time is taken from the records: links may be read late,
one later than another, and a log is joined like live data. In addition to the joints' values a joined fix has the
quantities on which effects depend: direction of approach, rate, dwell, and the latest signals.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from calibration.rig.channels import Cia406Encoder, Cia406Linear
from calibration.rig.description import Rig
from daemon.acquisition.tracks import (
    HISTORY_NS,
    MAX_GAP_S,
    STILL_AFTER_NS,
    JointInput,
    JointTrack,
    Motion,
    SignalInput,
    SignalTrack,
)
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import DeviceEvent, EventKind, Fix, Reading, Record, Status


@dataclass(frozen=True)
class JoinedFix:
    """A fix with the state of the machine at its instant.

    Attributes:
        fix: the fix as measured by the station.
        stamp: when it was measured: the fix's stamp minus the link delay.
        values: observations CSV column -> number (`theta1_deg`, `theta1_dir`, `theta1_rate`, `boom_valve_mA`, ...).
            Whatever is unknown is left out: `theta1_dir` until theta1 is seen to move.
        dwell_s: time since the last motion of any joint; None until one is seen, since joints may have moved unseen
            before their first readings, before a preset, and between readings that are too far apart.
        standstill: number of the standstill, increasing; None while the boom moves or has not yet settled.
        refused: why calibration must not use it, a clause; "" if it may.
    """

    fix: Fix
    stamp: Stamp
    values: Mapping[str, float]
    dwell_s: float | None
    standstill: int | None
    refused: str = ""

    def columns(self) -> dict[str, float]:
        """Return `values` with `dwell_s`: the numeric columns of the observations CSV without the position."""
        return {**self.values, **({} if self.dwell_s is None else {"dwell_s": self.dwell_s})}


@dataclass(frozen=True)
class MachineState:
    """State of the machine at the newest instant at which every joint is known.

    Attributes:
        monotonic_ns: that instant.
        boot_id: boot to which `monotonic_ns` belongs.
        oldest: joint whose newest reading is oldest; the others were read at that instant or later.
        values: observations CSV column -> number, as in a JoinedFix.
        dwell_s: as in a JoinedFix.
        stands_s: time since a motion was last seen, or since the joints' first readings.
    """

    monotonic_ns: int
    boot_id: str
    oldest: str
    values: Mapping[str, float]
    dwell_s: float | None
    stands_s: float | None


def joint_inputs(rig: Rig) -> list[JointInput]:
    """Return the joints of a rig, for an ObservationJoiner.

    A joint counts as moving when it changes by at least six standard deviations and three steps of its reading. Around
    a fix two of three samples may be missing, and for a fast channel a quarter of a second.
    """
    period_s = {c.name: c.period_ms / 1000 for c in rig.channels if isinstance(c, Cia406Encoder | Cia406Linear)}
    return [
        JointInput(j.name, j.unit, max(6 * j.sigma, 3 * j.resolution), max(MAX_GAP_S, 3 * period_s.get(j.name, 0.0)))
        for j in rig.joints
    ]


def signal_inputs(rig: Rig) -> list[SignalInput]:
    """Return the signals of a rig: its channels that are not joints. A value is used until its channel is silent."""
    return [SignalInput(c.name, c.column, c.timeout_s) for c in rig.channels if c.name not in rig.joint_names]


class ObservationJoiner:
    """Joins fixes with joints and signals.

    Args:
        joints: all joints that a fix needs.
        signals: signals that are added to a fix if they are fresh.
        link_delay_s: station -> time from a measurement to the first byte of its record; 0 where not given.
        settle_s: how long the boom must have been still for a fix to belong to a standstill.
        deadline_s: how long a fix waits for joints that have fallen silent; if all are silent, it waits as long as
            samples are kept.

    Attributes:
        refusals: reason -> number of fixes refused for it.
    """

    def __init__(
        self,
        joints: Sequence[JointInput],
        signals: Sequence[SignalInput] = (),
        *,
        link_delay_s: Mapping[str, float] | None = None,
        settle_s: float = 1.0,
        deadline_s: float = 2.0,
    ) -> None:
        self.refusals: Counter[str] = Counter()
        self._delay_ns = {name: round(delay * NS_PER_S) for name, delay in (link_delay_s or {}).items()}
        self._deadline_ns = round(deadline_s * NS_PER_S)
        self._motion = Motion(round(settle_s * NS_PER_S))
        self._joints = {joint.name: JointTrack(joint, self._motion) for joint in joints}
        self._signals = {signal.name: SignalTrack(signal) for signal in signals}
        self._pending: deque[tuple[Fix, Stamp]] = deque()
        self._boot_id = ""
        self._newest_ns = 0

    def feed(self, records: Iterable[Record]) -> list[JoinedFix]:
        """Add records and return the fixes that they complete, refused fixes included.

        The records of one call may be in any order, and records of one link may be given several calls later than those
        of another. Fixes whose own status is not OK are skipped, and so are readings of doubtful time, which belong to
        no known instant. Records of a new boot complete all pending fixes.
        """
        done: list[JoinedFix] = []
        timed = [(r.stamp, r) for r in records if isinstance(r, Reading | Fix | DeviceEvent)]
        for boot_id in dict.fromkeys(stamp.boot_id for stamp, _ in timed):
            if boot_id != self._boot_id:
                done += self._restart(boot_id)
            of_boot = [(stamp.monotonic_ns, r) for stamp, r in timed if stamp.boot_id == boot_id]
            # A preset jump comes before the reading that shows it.
            of_boot.sort(key=lambda item: (item[0], not isinstance(item[1], DeviceEvent)))
            for at_ns, record in of_boot:
                self._newest_ns = max(self._newest_ns, at_ns)
                self._take(record, at_ns)
                if self._pending:
                    done += self._release()
        return done

    def measured(self, fix: Fix) -> Stamp:
        """Return when a fix was measured: its stamp minus the link delay of its station."""
        return fix.stamp.shifted(-self._delay_ns.get(fix.station, 0))

    def latest(self) -> MachineState | str:
        """Return the machine's state at the newest instant at which every joint is known, or why there is none."""
        last = min(self._joints.values(), key=lambda joint: joint.newest_ns)
        if last.newest_ns < 0:
            return f"{last.name}: no reading yet"
        values, missing = self._values(last.newest_ns, "the newest instant that all joints were read")
        if missing:
            return missing
        at_ns = last.newest_ns
        stands_s = self._motion.stands_s(at_ns)
        return MachineState(at_ns, self._boot_id, last.name, values, self._motion.at(at_ns)[0], stands_s)

    def _restart(self, boot_id: str) -> list[JoinedFix]:
        """Discard all samples for a new boot, whose monotonic clock cannot be compared with the previous one's."""
        ended = [self._join(fix, stamp) for fix, stamp in self._pending]
        self._pending.clear()
        for joint in self._joints.values():
            joint.clear()
        for signal in self._signals.values():
            signal.clear()
        self._motion.restart()
        self._boot_id, self._newest_ns = boot_id, 0
        return ended

    def _take(self, record: Reading | Fix | DeviceEvent, at_ns: int) -> None:
        if isinstance(record, Reading):
            if record.status is Status.TIME_DOUBTFUL:
                return
            joint = self._joints.get(record.channel)
            if joint is not None:
                joint.add(at_ns, record)
            elif (signal := self._signals.get(record.channel)) is not None:
                signal.add(at_ns, record.value)
        elif isinstance(record, Fix):
            if record.status is Status.OK:
                self._pending.append((record, self.measured(record)))
        elif record.kind is EventKind.PRESET_JUMP and record.device in self._joints:
            self._joints[record.device].jumped(at_ns)

    def _release(self) -> list[JoinedFix]:
        done: list[JoinedFix] = []
        while self._pending:
            fix, stamp = self._pending[0]
            wanted_ns = stamp.monotonic_ns + STILL_AFTER_NS
            sampled_ns = [joint.newest_ns for joint in self._joints.values()]
            is_in_time = max(sampled_ns) - wanted_ns <= self._deadline_ns and self._newest_ns - wanted_ns <= HISTORY_NS
            if is_in_time and min(sampled_ns) < wanted_ns:
                break
            self._pending.popleft()
            done.append(self._join(fix, stamp))
        return done

    def _join(self, fix: Fix, stamp: Stamp) -> JoinedFix:
        values, refused = self._values(stamp.monotonic_ns, "the fix")
        if refused:
            self.refusals[refused] += 1
        dwell_s, standstill = self._motion.at(stamp.monotonic_ns)
        return JoinedFix(fix, stamp, values, dwell_s, standstill, refused)

    def _values(self, at_ns: int, of: str) -> tuple[dict[str, float], str]:
        """Return the columns of joints and signals at an instant, and why a joint is missing; "" if none is."""
        values: dict[str, float] = {}
        missing = ""
        for joint in self._joints.values():
            found = joint.at(at_ns, of)
            if isinstance(found, str):
                missing = missing or f"{joint.name}: {found}"
                continue
            values[f"{joint.name}_{joint.unit}"] = found.value
            if found.direction is not None:
                values[f"{joint.name}_dir"] = float(found.direction)
            if found.rate is not None:
                values[f"{joint.name}_rate"] = found.rate
        for signal in self._signals.values():
            value = signal.at(at_ns)
            if value is not None:
                values[signal.column] = value
        return values, missing
