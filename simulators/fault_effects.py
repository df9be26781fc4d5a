"""What each fault does to the rig's devices."""

from __future__ import annotations

from typing import TYPE_CHECKING

from simulators.canopen_node import CanopenNode
from simulators.canopen_nodes import PositionNode
from simulators.faults import Fault, make_fault
from simulators.frame import Frame

if TYPE_CHECKING:
    from simulators.rig_simulator import RigSimulator

# SocketCAN error frames (linux/can/error.h): class bits, and the eight data bytes
_BUS_ERRORS = {
    "warning": (0x004, bytes([0, 0x04, 0, 0, 0, 0, 0, 0])),
    "passive": (0x004, bytes([0, 0x10, 0, 0, 0, 0, 0, 0])),
    "active": (0x004, bytes([0, 0x40, 0, 0, 0, 0, 0, 0])),
    "bus_off": (0x040, bytes(8)),
    "acknowledge": (0x020, bytes(8)),
}


def check_fault(rig: RigSimulator, fault: Fault) -> None:
    """ValueError when this rig has no such node, prism or signals."""
    prisms = rig.machine.truth.rig.prism_names
    if fault.kind == "prism_jump" and fault.text("to") not in ("", *prisms, *rig.machine.control_points_mm):
        raise ValueError(f"fault prism_jump: no prism {fault.text('to')!r}; this rig has {', '.join(prisms)}")
    if fault.kind in ("counter_gap", "not_available") and rig.signals is None:
        raise ValueError(f"fault {fault.kind}: this rig has no machine signals")
    if "node" in fault.parameters:
        node = _node(rig, fault)
        if fault.kind in ("alarm", "warning", "preset_jump") and not isinstance(node, PositionNode):
            raise ValueError(f"fault {fault.kind}: node {node.node} is no encoder or length transducer")


def apply_fault(rig: RigSimulator, fault: Fault, now_s: float) -> None:
    """Let a fault happen that `check_fault` has passed."""
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
            pass  # the port's owner does it when it is told of the fault
        case _:
            _node_fault(rig, fault, now_s)
    rig.refresh()


def _node_fault(rig: RigSimulator, fault: Fault, now_s: float) -> None:
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


def _node(rig: RigSimulator, fault: Fault) -> CanopenNode:
    number = fault.count("node")
    for node in rig.nodes:
        if number in (0, node.node):
            return node
    have = ", ".join(str(node.node) for node in rig.nodes) or "none"
    raise ValueError(f"fault {fault.kind}: this rig has no node {number}; it has {have}")


def _another_prism(rig: RigSimulator, now_s: float) -> str:
    names = rig.machine.truth.rig.prism_names
    now = rig.station.tracker.target(now_s)
    return next((name for name in names if name != now), names[0])
