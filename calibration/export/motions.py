"""A kinematic chain as fixed transforms and single motions, the common form for URDF, C and MATLAB."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from calibration.kinematics.chain import Chain, Op, rotation_about
from calibration.observations import Floats


@dataclass(frozen=True)
class Motion:
    """A fixed transform, followed by at most one motion.

    Attributes:
        name: name of the frame after it: `row3.theta`, or `frame3` at the end of a row.
        parent: index of the previous motion; -1 for the base.
        fixed: (4, 4) fixed transform, mm.
        rotates: True if it rotates about its axis, False if it slides along it.
        axis: 0, 1, 2 for x, y, z.
        drive: pairs of joint index and rad or mm per deg or mm of the joint's reading; empty if nothing moves.
    """

    name: str
    parent: int
    fixed: Floats
    rotates: bool = False
    axis: int = 2
    drive: tuple[tuple[int, float], ...] = ()


@dataclass(frozen=True)
class MotionTree:
    """Motions of a rig as a tree, with its frames and prisms.

    Attributes:
        motions: the motions, parents first.
        frames: index of the motion that ends in frame 0, 1, ...; -1 for frame 0.
        turning: row number -> index of the motion of its driven theta.
        prisms: name -> (frame, (3,) position in it, mm).
    """

    motions: tuple[Motion, ...]
    frames: tuple[int, ...]
    turning: dict[int, int]
    prisms: dict[str, tuple[int, Floats]]


@dataclass(frozen=True)
class Carriers:
    """The driven motions of a tree, with everything else fixed to them.

    Attributes:
        motions: the motions, parents first; each has a drive.
        frames: by frame number: the motion that carries it (-1 for the base), and its (4, 4) transform after that
            motion, mm.
        turning: row number -> index of the motion of its driven theta.
        prisms: name -> (motion that carries it, (3,) position after that motion, mm).
    """

    motions: tuple[Motion, ...]
    frames: tuple[tuple[int, Floats], ...]
    turning: dict[int, int]
    prisms: dict[str, tuple[int, Floats]]

    def beyond(self, motion: int) -> list[bool]:
        """Return for each motion whether `motion` carries it; a motion also carries itself."""
        found: list[bool] = []
        for index, one in enumerate(self.motions):
            found.append(index == motion or (one.parent >= 0 and found[one.parent]))
        return found


def carriers(tree: MotionTree) -> Carriers:
    """Return a tree without undriven motions; each is merged into the parts after it."""
    motions: list[Motion] = []
    placed: dict[int, tuple[int, Floats]] = {-1: (-1, np.eye(4))}
    for index, motion in enumerate(tree.motions):
        parent, before = placed[motion.parent]
        fixed = before @ motion.fixed
        if motion.drive:
            placed[index] = len(motions), np.eye(4)
            motions.append(replace(motion, parent=parent, fixed=fixed))
        else:
            placed[index] = parent, fixed
    frames = tuple(placed[index] for index in tree.frames)
    turning = {row: placed[index][0] for row, index in tree.turning.items()}
    prisms = {name: (frames[frame][0], _moved(frames[frame][1], at)) for name, (frame, at) in tree.prisms.items()}
    return Carriers(tuple(motions), frames, turning, prisms)


def _moved(transform: Floats, place: Floats) -> Floats:
    return np.asarray(transform[:3, :3] @ place + transform[:3, 3])


def motion_tree(chain: Chain, x: Floats) -> MotionTree:
    """Return a chain with parameters `x` (p,), mm and rad, as a tree of motions."""
    motions: list[Motion] = []
    frames, turning = [-1], dict[int, int]()
    for number, ops in enumerate(chain.row_ops, 1):
        at = frames[(0, *chain.rig.path(number))[-2]]
        for motion in _of_row(number, ops, x, at, len(motions)):
            if motion.rotates and motion.drive:
                turning[number] = len(motions)
            motions.append(motion)
        frames.append(len(motions) - 1)
    prisms = {
        prism.name: (prism.frame, np.array([op.constant + _at(x, op) for op in ops]))
        for prism, ops in zip(chain.rig.prisms, chain.prism_ops, strict=True)
    }
    return MotionTree(tuple(motions), tuple(frames), turning, prisms)


def _of_row(number: int, ops: list[Op], x: Floats, parent: int, count: int) -> Iterator[Motion]:
    fixed = np.eye(4)
    for op in ops:
        fixed = fixed @ _elementary(op, op.constant + _at(x, op))
        if op.drive:
            kind = "theta" if op.rotates else "xyz"[op.axis]
            yield Motion(f"row{number}.{kind}", parent, fixed, op.rotates, op.axis, op.drive)
            parent, fixed, count = count, np.eye(4), count + 1
    yield Motion(f"frame{number}", parent, fixed)


def _at(x: Floats, op: Op) -> float:
    return float(x[op.parameter]) if op.parameter >= 0 else 0.0


def _elementary(op: Op, size: float) -> Floats:
    out = np.eye(4)
    if op.rotates:
        out[:3, :3] = rotation_about(op.axis, size)
    else:
        out[op.axis, 3] = size
    return out
