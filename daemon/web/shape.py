"""The boom for drawings: elementary transforms from the base to every prism, from the rig file."""

from __future__ import annotations

from typing import Any

from calibration.rig.description import parse_rig


def shape(text: str) -> dict[str, Any]:
    """Return the data for drawing a rig at any joint values.

    Args:
        text: the rig file.

    Returns:
        `name`; `joints`: name, unit, low and high of each, in the rig's order; `chains`: prism -> its transforms,
        starting at the base, each `[rotates, axis, constant, [[joint, coefficient], ...]]`, axis 0 to 2 for x to z. A
        rotation is about the axis (rad), a translation along it (mm); its size is the constant plus the sum of
        coefficient times the joint's value (deg or mm). `down`: direction of gravity in the base frame.
    """
    from calibration.kinematics.chain import Chain, Placement

    rig = parse_rig(text, "rig file")
    chain = Chain(rig, {"": Placement.identity()})
    return {
        "name": rig.name,
        "joints": [
            {"name": joint.name, "unit": joint.unit, "low": joint.limits[0], "high": joint.limits[1]}
            for joint in rig.joints
        ],
        "chains": {
            name: [
                [op.rotates, op.axis, op.constant, [list(drive) for drive in op.drive]]
                for op in chain.prism_chain(index)
                if op.constant or op.drive
            ]
            for index, name in enumerate(rig.prism_names)
        },
        "down": list(rig.gravity),
    }
