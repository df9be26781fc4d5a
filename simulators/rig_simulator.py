"""A whole rig: machine, encoder nodes, machine controller, bus master and total station on one time line.

It does no I/O: it takes frames, bytes and the time, and returns frames, bytes and events. `live.py` connects it to
links in real or scaled time. Times are simulated seconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np

from calibration.rig.channels import Cia404Analogue, Cia406Encoder, Cia406Linear, DbcSignal, RawSignal
from calibration.rig.description import Rig
from simulators.devices.can.bus import BusController, BusDevice, Frame
from simulators.devices.can.machine_signals import MachineSignals
from simulators.devices.can.node import CanopenNode
from simulators.devices.can.profiles import Source, encoder_of, linear_of, pressure_of
from simulators.devices.can.raw_signals import RawSignals
from simulators.devices.machine import Floats, Machine
from simulators.devices.stations.sokkia import SokkiaStation
from simulators.devices.stations.topcon import TopconStation
from simulators.devices.stations.total_station import StationSettings, TotalStation
from simulators.devices.stations.tracker import Tracker
from simulators.faults import Fault, FaultSchedule, apply_fault, check_fault
from simulators.rig.motion import BoomMotion
from simulators.rig.truth import RigTruth

Event = Mapping[str, object]


@dataclass(frozen=True)
class SimulatorSettings:
    """Settings of a simulated rig.

    Attributes:
        bus_master: `machine`: the machine's controller has commissioned the nodes, starts them and sends SYNC, so a
            host can just listen. `host`: the nodes have factory settings and are silent until a host sets them up.
        sync_period_s: SYNC interval of the machine.
        signal_period_s: cycle time of the machine controller's signals; machine.dbc states 10 ms.
        station: settings of the instrument.
        setup: name of the station set-up, which determines where the machine stands.
        mappings: node -> words of object 1A00h, if the machine has commissioned the node's TPDO with a mapping
            different from the factory's.
    """

    bus_master: Literal["machine", "host"] = "machine"
    sync_period_s: float = 0.05
    signal_period_s: float = 0.01
    station: StationSettings = field(default_factory=StationSettings)
    setup: str = ""
    mappings: Mapping[int, Sequence[int]] = field(default_factory=dict)


@dataclass
class Output:
    """Output of the rig, in order.

    Attributes:
        frames: frames on the bus, except the host's own.
        station: bytes from the total station.
        events: `arrived` and `fault` events, for the process that drives the rig.
    """

    frames: list[Frame] = field(default_factory=list)
    station: bytes = b""
    events: list[Event] = field(default_factory=list)


class RigSimulator:
    """The rig.

    Attributes:
        machine, nodes, signals, station, faults: its parts, for faults and tests.

    Args:
        truth: the true machine.
        seed: seed of the noise.
        settings: see SimulatorSettings.
        faults: scheduled faults.
        start: joint name -> initial value; missing joints start in the middle of their limits.

    Raises:
        ValueError: the start pose is beyond the limits, DBC signals belong to a different machine than the simulated
            one, or a fault concerns a part that the rig does not have.
    """

    def __init__(
        self,
        truth: RigTruth,
        seed: int,
        settings: SimulatorSettings | None = None,
        *,
        faults: Iterable[Fault] = (),
        start: Mapping[str, float] | None = None,
    ) -> None:
        self.settings = settings = settings or SimulatorSettings()
        rig = truth.rig
        self.machine = Machine(truth, seed, BoomMotion(rig, start), setup=settings.setup)
        self.nodes = _nodes(rig, self.machine, seed, settings.mappings if settings.bus_master == "machine" else None)
        self.station = _station(rig, self.machine, seed, settings.station)
        self.signals = _signals(rig, self.machine, seed, settings.signal_period_s)
        self.faults = FaultSchedule()
        self._controller = (
            BusController(settings.sync_period_s) if self.nodes and settings.bus_master == "machine" else None
        )
        self._arrivals: list[tuple[float, Mapping[str, float]]] = []
        self._output = Output()
        raw = [c for c in rig.channels if isinstance(c, RawSignal)]
        self._devices: tuple[BusDevice, ...] = (
            *((self._controller,) if self._controller else ()),
            *self.nodes,
            *((self.signals,) if self.signals else ()),
            *((RawSignals(raw, {c.name: _source(rig, self.machine, c.name) for c in raw}),) if raw else ()),
        )
        for node in self.nodes:
            node.power_on(0.0)
        self._due = [device.next_deadline() for device in self._devices]
        for fault in faults:
            self.inject(fault)

    # Commands

    def aim(self, target: str, now_s: float) -> None:
        """Point the station at a prism or control point; ValueError if it is unknown."""
        self.station.aim_at(target, now_s)

    def move(self, pose: Mapping[str, float], now_s: float, *, speed: float = 0.25, dwell_s: float = 0.0) -> float:
        """Append a move to the plan and return its arrival time; an `arrived` event follows.

        See `BoomMotion.move` for the arguments.
        """
        arrival_s = self.machine.motion.move(now_s, pose, speed=speed, dwell_s=dwell_s)
        self._arrivals.append((arrival_s, dict(pose)))
        return arrival_s

    def inject(self, fault: Fault) -> None:
        """Add a fault to the schedule; ValueError if this rig has no such part."""
        check_fault(self, fault)
        self.faults.add(fault)

    def in_instrument_frame_mm(self, place_mm: Floats) -> Floats:
        """Return a (3,) position in the instrument's frame, which follows the current zero of the horizontal circle."""
        zero = math.radians(self.station.circle_zero_deg)
        east, north, up = place_mm
        turned = (east * math.cos(zero) - north * math.sin(zero), north * math.cos(zero) + east * math.sin(zero), up)
        return np.array(turned)

    # The links

    def receive_can(self, frame: Frame, now_s: float) -> None:
        """Process a frame sent by the host."""
        self._spread(frame, now_s)

    def receive_station(self, data: bytes, now_s: float) -> None:
        """Process bytes that the host wrote to the station."""
        self.station.receive(data, now_s)

    def put(self, frame: Frame) -> None:
        """Put a frame on the bus that no node processes (an error frame)."""
        self._output.frames.append(frame)

    def tell(self, event: Event) -> None:
        """Report an event to the process that drives the rig."""
        self._output.events.append(event)

    def _spread(self, frame: Frame, now_s: float) -> None:
        """Deliver a frame to every node; nodes answer in the order of their numbers."""
        for index, node in enumerate(self.nodes, 1 if self._controller else 0):
            answers = node.receive(frame, now_s)
            if answers:
                self._emit(answers, now_s)
            self._due[index] = node.next_deadline()

    def _emit(self, frames: Sequence[Frame], now_s: float) -> None:
        """Deliver frames from a device to the host and to the bus master."""
        self._output.frames.extend(frames)
        if self._controller is not None:
            for frame in frames:
                self._controller.receive(frame, now_s)
            self._due[0] = self._controller.next_deadline()

    # Time

    def poll(self, now_s: float) -> Output:
        """Simulate up to `now_s`; return the output since the last call."""
        for fault in self.faults.due(now_s):
            apply_fault(self, fault, now_s)
            self._due = [device.next_deadline() for device in self._devices]
            self.tell({"event": "fault", "kind": fault.kind, **fault.parameters})
        while self._devices:
            index = min(range(len(self._due)), key=self._due.__getitem__)
            if self._due[index] > now_s:
                break
            self._poll_device(index, now_s)
        while self._arrivals and self._arrivals[0][0] <= now_s:
            _, pose = self._arrivals.pop(0)
            self.tell({"event": "arrived", "pose": pose})
            self.machine.motion.forget_before(now_s - 10.0)
        self._output.station += self.station.poll(now_s)
        output, self._output = self._output, Output()
        return output

    def _poll_device(self, index: int, now_s: float) -> None:
        device = self._devices[index]
        frames = device.poll(now_s)
        if device is self._controller:
            for frame in frames:
                self._output.frames.append(frame)
                self._spread(frame, now_s)
        elif frames:
            self._emit(frames, now_s)
        self._due[index] = device.next_deadline()

    def next_deadline(self) -> float:
        """Return the instant at which `poll` is due."""
        arrival = self._arrivals[0][0] if self._arrivals else math.inf
        return min([*self._due, arrival, self.station.next_deadline(), self.faults.next_deadline()])


def _nodes(
    rig: Rig, machine: Machine, seed: int, mappings: Mapping[int, Sequence[int]] | None
) -> tuple[CanopenNode, ...]:
    """Build the nodes, with factory settings if `mappings` is None, else commissioned with the mappings."""
    nodes: list[CanopenNode] = []
    for number, channel in enumerate(rig.channels):
        serial = 100_000 + 1000 * (seed % 1000) + number
        if not isinstance(channel, Cia406Encoder | Cia406Linear | Cia404Analogue):
            continue
        source = _source(rig, machine, channel.name)
        node: CanopenNode
        if isinstance(channel, Cia406Encoder):
            node = encoder_of(channel, source, serial)
        elif isinstance(channel, Cia406Linear):
            node = linear_of(channel, source, serial)
        else:
            node = pressure_of(channel, source, serial)
        if mappings is not None:
            node.commission(
                sync=channel.mode == "sync",
                pdo=channel.pdo,
                period_ms=channel.period_ms,
                heartbeat_ms=channel.heartbeat_ms,
                mapping=mappings.get(channel.node, ()),
            )
        nodes.append(node)
    return tuple(sorted(nodes, key=lambda n: n.node))


def _source(rig: Rig, machine: Machine, name: str) -> Source:
    """Return the source of a channel: its joint, or a plausible signal unrelated to any joint."""
    if name in rig.joint_names:
        return partial(machine.joint, name)
    channel = next(c for c in rig.channels if c.name == name)
    if channel.unit == "mm":  # an extra stroke, such as a rod feed, with slow independent motion
        return lambda t_s: (600.0 + 400.0 * math.sin(t_s / 20.0), 20.0 * math.cos(t_s / 20.0))
    return lambda t_s: (machine.boom_load_bar(t_s) + 0.3 * float(machine.rng.standard_normal()), 0.0)


def _station(rig: Rig, machine: Machine, seed: int, settings: StationSettings) -> TotalStation:
    rng = np.random.default_rng([seed, 33])
    names = (*rig.prism_names, *machine.control_points_mm)
    tracker = Tracker(names, machine.place_mm, rig.station, rng, settings.tracker)
    kind = SokkiaStation if settings.profile == "sokkia_set" else TopconStation
    return kind(settings, tracker, rng)


def _signals(rig: Rig, machine: Machine, seed: int, period_s: float) -> MachineSignals | None:
    described = [c for c in rig.channels if isinstance(c, DbcSignal)]
    foreign = next((c for c in described if c.dbc.rpartition("/")[2] != "machine.dbc"), None)
    if foreign is not None:
        raise ValueError(f"channel {foreign.name}: the simulated machine only sends machine.dbc, not {foreign.dbc}")
    if not described:
        return None
    return MachineSignals(machine.state, np.random.default_rng([seed, 34]), period_s=period_s)
