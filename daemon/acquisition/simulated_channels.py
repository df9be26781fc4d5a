"""Devices for joints without a channel in the rig file, so that the rig can be simulated with real protocols."""

from __future__ import annotations

import math

from calibration.errors import RigError
from calibration.rig.channels import CanopenChannel
from calibration.rig.description import Joint, Rig

_NODES = range(1, 128)
_COUNTS_PER_TURN = 1 << 20  # 0.0003 deg
_STEP_NM = 1000
_NM_PER_MM = 1_000_000


def with_simulated_channels(rig: Rig, text: str) -> str:
    """Return a rig file with a CANopen encoder or transducer for each joint that has no channel.

    Args:
        rig: the machine.
        text: text of its rig file.

    Raises:
        RigError: there are more joints than CANopen nodes.
    """
    read = {channel.name for channel in rig.channels}
    taken = {channel.node for channel in rig.channels if isinstance(channel, CanopenChannel)}
    free = iter([node for node in _NODES if node not in taken])
    lines = [text.rstrip("\n")]
    for joint in rig.joints:
        if joint.name not in read:
            node = next(free, None)
            if node is None:
                raise RigError(rig.name, "joint", f"more joints than the {len(_NODES)} nodes of a CANopen bus")
            lines += ["", *_channel(joint, node)]
    return "\n".join(lines) + "\n" if len(lines) > 1 else text


def _channel(joint: Joint, node: int) -> list[str]:
    head = ["[[channel]]  # simulated", f'name = "{joint.name}"']
    if joint.kind == "revolute":
        turns = 2 ** max(0, math.ceil(math.log2(max(map(abs, joint.limits)) / 180.0 * 1.01)))
        own = ['device = "cia406_encoder"', f"units_per_revolution = {_COUNTS_PER_TURN}"]
        own.append(f"total_units = {_COUNTS_PER_TURN * turns}")
    else:
        below = max(0, math.ceil(-joint.limits[0] + 1.0))
        own = ['device = "cia406_linear"', 'unit = "mm"', f"step_nm = {_STEP_NM}"]
        own.append(f"zero_counts = {below * _NM_PER_MM // _STEP_NM}")
    return [*head, *own, f"node = {node}", 'mode = "sync"']
