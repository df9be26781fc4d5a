"""Faults of a simulated rig: a scripted or random schedule, and the effect of each fault on the devices.

As text: `KIND@SECONDS[:NAME=VALUE...]`, separated by commas: `lock_loss@30:seconds=4,node_reboot@45:node=33`.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from simulators.devices.can.bus import Frame
from simulators.devices.can.machine_signals import MachineSignals
from simulators.devices.can.node import CanopenNode
from simulators.devices.can.profiles import PositionNode
from simulators.devices.machine import Machine
from simulators.devices.stations.total_station import TotalStation

Parameter = str | float

# kind -> its parameters with their defaults; numbers are counts, seconds, or codes
KINDS: Mapping[str, Mapping[str, Parameter]] = {
    "lock_loss": {"seconds": 3.0},  # the line of sight is blocked
    "prism_jump": {"to": ""},  # the station follows a different prism without reporting it; "": any other prism
    "bad_check": {"count": 1},  # records with a wrong block check
    "dropped_ack": {"count": 1},
    "joined_buffers": {"count": 1},  # acknowledgement, without its first byte, and record in one buffer
    "clutter": {"count": 12},  # random bytes before the next record
    "station_silent": {"seconds": 5.0},
    "node_silent": {"node": 0, "seconds": 3.0},  # node 0: the first one
    "node_reboot": {"node": 0},
    "emergency": {"node": 0, "code": 0x5000, "register": 0x81},
    "emergency_clear": {"node": 0},
    "alarm": {"node": 0, "bits": 1, "seconds": 2.0},  # 0 s: until an alarm with bits 0
    "warning": {"node": 0, "bits": 0x10},  # bits 0: ends all warnings
    "preset_jump": {"node": 0, "counts": 1000},
    "counter_gap": {"count": 3},  # machine frames that never arrive
    "not_available": {"seconds": 1.0},  # machine signals all ones
    "bus_error": {"state": "passive"},  # warning, passive, bus_off, active, acknowledge
    "unplug": {"link": "can", "seconds": 2.0},  # can or station
}
_CHOICES: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("bus_error", "state"): ("warning", "passive", "bus_off", "active", "acknowledge"),
    ("unplug", "link"): ("can", "station"),
}

# SocketCAN error frames (linux/can/error.h): class bits, and the eight data bytes
_BUS_ERRORS = {
    "warning": (0x004, bytes([0, 0x04, 0, 0, 0, 0, 0, 0])),
    "passive": (0x004, bytes([0, 0x10, 0, 0, 0, 0, 0, 0])),
    "active": (0x004, bytes([0, 0x40, 0, 0, 0, 0, 0, 0])),
    "bus_off": (0x040, bytes(8)),
    "acknowledge": (0x020, bytes(8)),
}


@dataclass(frozen=True)
class Fault:
    """A fault at an instant.

    Attributes:
        at_s: time in simulated seconds.
        kind: one of KINDS.
        parameters: values of all parameters of the kind.
    """

    at_s: float
    kind: str
    parameters: Mapping[str, Parameter]

    def number(self, name: str) -> float:
        """Return the value of a numeric parameter."""
        return float(self.parameters[name])

    def count(self, name: str) -> int:
        """Return the value of an integer parameter."""
        return int(float(self.parameters[name]))

    def text(self, name: str) -> str:
        """Return the value of a text parameter."""
        return str(self.parameters[name])


def make_fault(kind: str, at_s: float, given: Mapping[str, object]) -> Fault:
    """Check a fault's parameters and add the defaults of the others.

    Args:
        kind: one of KINDS.
        at_s: time in simulated seconds.
        given: parameter name -> value.

    Raises:
        ValueError: the kind or a parameter is unknown (the message lists the known ones), or a value is invalid.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown fault {kind!r}; known: {', '.join(KINDS)}")
    if not math.isfinite(at_s) or at_s < 0:
        raise ValueError(f"fault {kind}: {at_s} is not a valid time; give seconds from the start")
    known = KINDS[kind]
    parameters: dict[str, Parameter] = dict(known)
    for name, value in given.items():
        if name not in known:
            raise ValueError(f"fault {kind} has no parameter {name!r}; known: {', '.join(known)}")
        parameters[name] = _checked(kind, name, value, known[name])
    return Fault(at_s, kind, parameters)


def _checked(kind: str, name: str, value: object, default: Parameter) -> Parameter:
    if isinstance(default, str):
        allowed = _CHOICES.get((kind, name))
        if not isinstance(value, str) or (allowed and value not in allowed):
            raise ValueError(f"fault {kind}: {name} = {value!r}; allowed: {', '.join(allowed or ('a name',))}")
        return value
    try:
        number = float(int(value, 0)) if isinstance(value, str) and value.startswith("0x") else float(str(value))
    except ValueError:
        raise ValueError(f"fault {kind}: {name} = {value!r} is not a number") from None
    whole = isinstance(default, int)
    if not math.isfinite(number) or (whole and number != int(number)) or (number < 0 and name != "counts"):
        raise ValueError(f"fault {kind}: {name} = {value!r} is not a {'whole ' if whole else ''}number of 0 or more")
    return int(number) if whole else number


def parse_faults(text: str) -> tuple[Fault, ...]:
    """Parse a schedule (see the module docstring); ValueError if it is invalid, with the wrong part."""
    faults = []
    for part in (p.strip() for p in text.split(",")):
        if not part:
            continue
        head, *settings = part.split(":")
        kind, at, seconds = head.partition("@")
        try:
            at_s = float(seconds)
        except ValueError:
            raise ValueError(f"{part!r}: give the time in seconds, as in {kind or 'lock_loss'}@30") from None
        pairs = [setting.partition("=") for setting in settings]
        if not at or any(not sign for _, sign, _ in pairs):
            raise ValueError(f"{part!r}: expected KIND@SECONDS[:NAME=VALUE...]")
        faults.append(make_fault(kind, at_s, {name: value for name, _, value in pairs}))
    return tuple(faults)


def random_faults(
    seed: int, duration_s: float, mean_interval_s: float, kinds: Iterable[str] = tuple(KINDS)
) -> tuple[Fault, ...]:
    """Draw faults of the given kinds with default parameters at random times with exponential intervals."""
    rng = np.random.default_rng([seed, 20])
    names = tuple(kinds)
    faults, at_s = [], float(rng.exponential(mean_interval_s))
    while at_s < duration_s:
        faults.append(make_fault(names[int(rng.integers(len(names)))], at_s, {}))
        at_s += float(rng.exponential(mean_interval_s))
    return tuple(faults)


class FaultSchedule:
    """Faults ordered by time; faults at the same time are in the order in which they were added."""

    def __init__(self, faults: Iterable[Fault] = ()) -> None:
        self._waiting: list[tuple[float, int, Fault]] = []
        self._number = 0
        for fault in faults:
            self.add(fault)

    def add(self, fault: Fault) -> None:
        """Add a fault."""
        self._number += 1
        heapq.heappush(self._waiting, (fault.at_s, self._number, fault))

    def due(self, now_s: float) -> list[Fault]:
        """Return the faults that are due; each is returned once."""
        out = []
        while self._waiting and self._waiting[0][0] <= now_s:
            out.append(heapq.heappop(self._waiting)[2])
        return out

    def next_deadline(self) -> float:
        """Return the instant at which the next fault is due."""
        return self._waiting[0][0] if self._waiting else math.inf


class FaultyRig(Protocol):
    """The parts of a rig that faults affect."""

    machine: Machine
    nodes: tuple[CanopenNode, ...]
    signals: MachineSignals | None
    station: TotalStation

    def put(self, frame: Frame) -> None:
        """Put a frame on the bus."""

    def inject(self, fault: Fault) -> None:
        """Add a fault to the schedule."""


def check_fault(rig: FaultyRig, fault: Fault) -> None:
    """Raise ValueError if the rig has no such node, prism or signals."""
    prisms = rig.machine.truth.rig.prism_names
    if fault.kind == "prism_jump" and fault.text("to") not in ("", *prisms, *rig.machine.control_points_mm):
        raise ValueError(f"fault prism_jump: no prism {fault.text('to')!r}; this rig has {', '.join(prisms)}")
    if fault.kind in ("counter_gap", "not_available") and rig.signals is None:
        raise ValueError(f"fault {fault.kind}: this rig has no machine signals")
    if "node" in fault.parameters:
        node = _node(rig, fault)
        if fault.kind in ("alarm", "warning", "preset_jump") and not isinstance(node, PositionNode):
            raise ValueError(f"fault {fault.kind}: node {node.node} is not an encoder or length transducer")


def apply_fault(rig: FaultyRig, fault: Fault, now_s: float) -> None:
    """Apply a fault that `check_fault` has accepted."""
    station, tracker = rig.station, rig.station.tracker
    match fault.kind:
        case "lock_loss":
            tracker.block(now_s, now_s + fault.number("seconds"))
        case "prism_jump":
            tracker.jump(fault.text("to") or _another_prism(rig, now_s), now_s)
        case "bad_check":
            station.faults.bad_checks += fault.count("count")
        case "dropped_ack":
            station.faults.dropped_acks += fault.count("count")
        case "joined_buffers":
            station.faults.joined += fault.count("count")
        case "clutter":
            station.faults.clutter += fault.count("count")
        case "station_silent":
            station.faults.silent_until = now_s + fault.number("seconds")
        case "counter_gap" if rig.signals is not None:
            rig.signals.skip_frames(fault.count("count"))
        case "not_available" if rig.signals is not None:
            rig.signals.void(now_s + fault.number("seconds"))
        case "bus_error":
            identifier, data = _BUS_ERRORS[fault.text("state")]
            rig.put(Frame(identifier, data, is_error=True))
        case "unplug":
            pass  # the owner of the port does this on the fault's event
        case _:
            _node_fault(rig, fault, now_s)


def _node_fault(rig: FaultyRig, fault: Fault, now_s: float) -> None:
    node = _node(rig, fault)
    match fault.kind:
        case "node_silent":
            node.mute(now_s + fault.number("seconds"))
        case "node_reboot":
            node.power_on(now_s)
        case "emergency":
            node.emergency(fault.count("code"), fault.count("register"))
        case "emergency_clear":
            node.emergency(0, 0)
        case "alarm" if isinstance(node, PositionNode):
            node.set_alarm(fault.count("bits"))
            if fault.number("seconds"):
                end_s = now_s + fault.number("seconds")
                rig.inject(make_fault("alarm", end_s, {"node": node.node, "bits": 0, "seconds": 0}))
        case "warning" if isinstance(node, PositionNode):
            node.set_warning(fault.count("bits"))
        case "preset_jump" if isinstance(node, PositionNode):
            node.jump(fault.count("counts"))


def _node(rig: FaultyRig, fault: Fault) -> CanopenNode:
    number = fault.count("node")
    for node in rig.nodes:
        if number in (0, node.node):
            return node
    have = ", ".join(str(node.node) for node in rig.nodes) or "none"
    raise ValueError(f"fault {fault.kind}: this rig has no node {number}; nodes: {have}")


def _another_prism(rig: FaultyRig, now_s: float) -> str:
    names = rig.machine.truth.rig.prism_names
    now = rig.station.tracker.target(now_s)
    return next((name for name in names if name != now), names[0])
