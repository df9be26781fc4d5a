"""Captures of a simulated rig without ports, threads or waiting: what a listener on both links would have recorded.

The same arguments give the same captures, byte by byte: golden logs are made this way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.clock import NS_PER_S, ManualClock
from drivers.readings import CanCapture, Capture, SerialCapture
from simulators.devices.can.bus import Frame
from simulators.rig_simulator import Event, RigSimulator
from tests.simulated.scripted_host import ScriptedHost

_STUFFED_BITS = 1.1  # stuff bits lengthen an average frame by a tenth


@dataclass(frozen=True)
class Step:
    """Something that whoever drives the rig does.

    Attributes:
        at_s: when.
        aim: target to point the station at, if any.
        pose: pose to move to, if any.
        speed: of the move.
    """

    at_s: float
    aim: str | None = None
    pose: Mapping[str, float] | None = None
    speed: float = 0.25


@dataclass(frozen=True)
class Generated:
    """What was recorded, and what happened meanwhile.

    Attributes:
        captures: in the order of time.
        events: (simulated seconds, event).
    """

    captures: tuple[Capture, ...]
    events: tuple[tuple[float, Event], ...]


def generate(
    simulator: RigSimulator,
    host: ScriptedHost,
    duration_s: float,
    clock: ManualClock,
    *,
    plan: Sequence[Step] = (),
    can_link: str = "boom",
    station_link: str = "station",
    bit_rate: int = 500_000,
) -> Generated:
    """Run a rig against a scripted host.

    Args:
        simulator: the rig, fresh.
        host: the other end.
        duration_s: how long.
        clock: gives the stamps; it is advanced.
        plan: aims and moves, in the order of time.
        can_link, station_link: names for the captures.
        bit_rate: of the bus; frames follow each other at its pace.
    """
    return _Recording(simulator, host, clock, can_link, station_link, bit_rate).run(duration_s, plan)


class _Recording:
    def __init__(
        self,
        simulator: RigSimulator,
        host: ScriptedHost,
        clock: ManualClock,
        can_link: str,
        station_link: str,
        bit_rate: int,
    ) -> None:
        self._simulator, self._host, self._clock = simulator, host, clock
        self._can_link, self._station_link, self._bit_rate = can_link, station_link, bit_rate
        self._begin = clock.now()
        self._bus_free_s = 0.0
        self._captures: list[Capture] = []
        self._events: list[tuple[float, Event]] = []

    def run(self, duration_s: float, plan: Sequence[Step]) -> Generated:
        steps = sorted(plan, key=lambda step: step.at_s)
        now_s = 0.0
        while True:
            now_s = max(now_s, self._next_s(steps))
            if now_s > duration_s:
                break
            self._clock.set(self._begin.shifted(round(now_s * NS_PER_S)))
            while steps and steps[0].at_s <= now_s:
                self._take(steps.pop(0), now_s)
            self._exchange(now_s)
        self._captures.sort(key=lambda capture: capture.stamp.monotonic_ns)
        return Generated(tuple(self._captures), tuple(self._events))

    def _next_s(self, steps: Sequence[Step]) -> float:
        own = [steps[0].at_s] if steps else []
        return min([self._simulator.next_deadline(), self._host.next_deadline(), *own])

    def _take(self, step: Step, now_s: float) -> None:
        if step.aim is not None:
            self._simulator.aim(step.aim, now_s)
        if step.pose is not None:
            self._simulator.move(step.pose, now_s, speed=step.speed)

    def _exchange(self, now_s: float) -> None:
        frames, command = self._host.poll(now_s)
        for frame in frames:
            self._record(frame, now_s, is_transmitted=True)
            self._simulator.receive_can(frame, now_s)
        if command:
            stamp = self._clock.now()
            self._captures.append(SerialCapture(self._station_link, stamp, command, is_transmitted=True))
            self._simulator.receive_station(command, now_s)
        output = self._simulator.poll(now_s)
        for frame in output.frames:
            self._record(frame, now_s, is_transmitted=False)
            self._host.hear_can(frame, now_s)
        if output.station:
            self._captures.append(SerialCapture(self._station_link, self._clock.now(), output.station))
            self._host.hear_station(output.station, now_s)
        self._events += [(now_s, event) for event in output.events]

    def _record(self, frame: Frame, now_s: float, *, is_transmitted: bool) -> None:
        overhead, per_byte = (67, 8) if frame.is_extended else (47, 8)
        bits = overhead + (0 if frame.is_remote else per_byte * len(frame.data))
        self._bus_free_s = max(self._bus_free_s, now_s) + bits * _STUFFED_BITS / self._bit_rate
        self._captures.append(
            CanCapture(
                link=self._can_link,
                stamp=self._begin.shifted(round(self._bus_free_s * NS_PER_S)),
                arbitration_id=frame.arbitration_id,
                data=frame.data,
                is_extended=frame.is_extended,
                is_remote=frame.is_remote,
                is_error=frame.is_error,
                is_transmitted=is_transmitted,
            )
        )
