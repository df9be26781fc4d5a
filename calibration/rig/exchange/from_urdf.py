"""A rig from a URDF: the joints between base and tips as modified Denavit-Hartenberg rows.

The rows have exactly the constants that a calibration can identify: four from axis to axis, and beta where the axes are
nearly parallel. A branch from a link starts with a row without drive, so that its mounting can be corrected. Joints
that move no tip are kept at zero, and the masses of their links at the resulting places.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.errors import RigError
from calibration.rig.exchange.draft import LIMITS_ASSUMED, SIGMA, Draft, free_name
from calibration.rig.exchange.frames import (
    Floats,
    Line,
    Link,
    angles_zyx,
    end_frame,
    link_frame,
    moved,
    step_along,
    tidy,
    turned,
)
from calibration.rig.exchange.urdf import Mimic, Urdf, UrdfJoint

_TURN_DEG = 180.0
_TRAVEL_MM = 1000.0  # assumed limit of a slide for which the URDF gives none
_SAME = 1e-12  # tolerance of a matrix that should be the identity; mm and plain numbers
_IDENTIFIED = ("alpha", "a", "d", "theta")


@dataclass
class _Node:
    """The base, or a joint that moves a tip: its axis, its link's frame, and its row.

    Attributes:
        joint: the joint; None for the base.
        line: axis of the joint; for the base, the z axis of its frame.
        link: (4, 4) frame of the joint's link at zero.
        children: the next joints.
        row: number of the joint's row; 0 for the base.
        frame: (4, 4) frame after the row, computed from its constants as written to the file.
    """

    joint: UrdfJoint | None
    line: Line
    link: Floats
    children: list[_Node]
    row: int = 0
    frame: Floats | None = None


def draft_of_urdf(urdf: Urdf, source: str, base: str | None = None, tips: Sequence[str] = ()) -> Draft:
    """Make a rig file from a URDF.

    Args:
        urdf: the description.
        source: name of its file.
        base: link that is the base of the rig; the root by default.
        tips: links that carry a prism; by default every link at the end of a chain.

    Raises:
        RigError: unknown links, a tip that no joint moves, a joint that moves in several directions.
    """
    return _Import(urdf, source, base or urdf.root, tips).run()


class _Import:
    def __init__(self, urdf: Urdf, source: str, base: str, tips: Sequence[str]) -> None:
        self._urdf, self._source, self._base = urdf, source, base
        for link in (base, *tips):
            if link not in urdf.links:
                raise RigError(source, "", f"there is no link {link!r}; the links are {', '.join(urdf.links)}")
        self._tips = tuple(dict.fromkeys(tips)) or self._ends()
        self._draft = Draft(urdf.name, "mdh_beta_after", source)
        self._out_of_base = np.linalg.inv(urdf.place(base))
        self._root = _Node(None, Line(np.array([0.0, 0.0, 1.0]), np.zeros(3)), np.eye(4), [])
        self._nodes: dict[str, _Node] = {}
        self._names: dict[str, str] = {}
        self._frames: dict[int, Floats] = {0: np.eye(4)}

    def run(self) -> Draft:
        for tip in self._tips:
            self._add_way(tip)
        self._name_joints()
        self._root.frame = np.eye(4)
        self._add_rows(self._root)
        self._add_prisms()
        self._add_masses()
        still = [j.name for j in self._urdf.joints.values() if j.moves and j.name not in self._nodes]
        self._draft.notes += [
            self._draft.assumed,
            "Left out: shapes, efforts, friction and transmissions, which rigcal does not use.",
            *([f"Joints kept at zero, because they move no tip: {', '.join(still)}."] if still else []),
        ]
        return self._draft

    def _ends(self) -> tuple[str, ...]:
        """Return the end links: for the last moving joint of every chain, the last link along its fixed joints."""
        below: dict[str, list[UrdfJoint]] = {}
        moving: set[str] = set()  # links with a moving joint further along the chain
        for joint in self._urdf.joints.values():
            below.setdefault(joint.parent, []).append(joint)
            link: str | None = joint.parent if joint.moves else None
            while link is not None and link not in moving:
                moving.add(link)
                link = self._urdf.joints[link].parent if link in self._urdf.joints else None
        ends = []
        for joint in self._urdf.joints.values():
            if joint.moves and self._is_inside(joint.child) and joint.child not in moving:
                end = joint.child
                while below.get(end):
                    end = below[end][0].child
                ends.append(end)
        if not ends:
            raise RigError(self._source, "", f"no joint moves anything on link {self._base!r}; choose another base")
        return tuple(ends)

    def _is_inside(self, link: str) -> bool:
        return link == self._base or any(joint.parent == self._base for joint in self._urdf.way(link))

    def _way(self, link: str) -> list[UrdfJoint]:
        """Return the joints from the rig's base to a link."""
        way = self._urdf.way(link)
        if link == self._base:
            return []
        first = next((i for i, joint in enumerate(way) if joint.parent == self._base), None)
        if first is None:
            raise RigError(self._source, f"link {link!r}", f"not connected to the base {self._base!r}; leave it out")
        return way[first:]

    def _place(self, link: str) -> Floats:
        out: Floats = self._out_of_base @ self._urdf.place(link)
        return out

    def _add_way(self, tip: str) -> None:
        node, moving = self._root, [joint for joint in self._way(tip) if joint.moves or joint.kind is None]
        if not moving:
            raise RigError(self._source, f"link {tip!r}", f"no joint moves it relative to the base {self._base!r}")
        for joint in moving:
            if joint.kind is None:
                raise RigError(
                    self._source,
                    f"joint {joint.name!r}",
                    "it moves in several directions (floating or planar), which a row of a rig cannot describe; give a "
                    "link beyond it as --base",
                )
            if joint.name not in self._nodes:
                link = self._place(joint.child)
                new = _Node(joint, Line(link[:3, :3] @ joint.axis, link[:3, 3]), link, [])
                self._nodes[joint.name] = new
                node.children.append(new)
            node = self._nodes[joint.name]

    # -- joints --------------------------------------------------------------------------------------------------------

    def _source_of(self, joint: UrdfJoint) -> tuple[UrdfJoint, Mimic]:
        """Return the joint whose reading moves `joint`, and the linear relation between the two."""
        named = {j.name: j for j in self._urdf.joints.values()}
        how, seen = Mimic(joint.name, 1.0, 0.0), {joint.name}
        while joint.mimic is not None:
            further = joint.mimic
            how = Mimic(
                further.joint, how.multiplier * further.multiplier, how.multiplier * further.offset + how.offset
            )
            joint = named[further.joint]
            if joint.name in seen:
                raise RigError(self._source, f"joint {joint.name!r}", "it mimics itself, through other joints")
            seen.add(joint.name)
        if joint.kind not in ("revolute", "prismatic"):
            raise RigError(self._source, f"joint {joint.name!r}", "another joint mimics it, but it does not move")
        return joint, how

    def _name_joints(self) -> None:
        for node in self._nodes.values():
            assert node.joint is not None
            joint, _ = self._source_of(node.joint)
            if joint.name not in self._names:
                self._names[joint.name] = free_name(joint.name, self._names.values())
                self._add_joint(joint)

    def _add_joint(self, joint: UrdfJoint) -> None:
        assert joint.kind is not None
        turns = joint.kind == "revolute"
        unit, assumed = (math.degrees(1.0), _TURN_DEG) if turns else (1.0, _TRAVEL_MM)
        limits, remark = joint.limits, "" if self._names[joint.name] == joint.name else joint.name
        if limits is None or limits[0] == limits[1]:
            limits = (-assumed / unit, assumed / unit)
            remark = "; ".join(filter(None, (remark, f"{LIMITS_ASSUMED}: the URDF gives none")))
        name = self._names[joint.name]
        if limits == joint.limits and joint.missing_limit:
            given = "upper" if joint.missing_limit == "lower" else "lower"
            self._draft.values_assumed.append(
                f"the {joint.missing_limit} limit 0 of {name}: the URDF gives only the {given} one"
            )
            remark = "; ".join(filter(None, (remark, f"{joint.missing_limit} limit assumed")))
        keys: dict[str, object] = {"name": name, "kind": joint.kind, "limits": [tidy(x * unit) for x in limits]}
        keys["sigma"] = SIGMA[joint.kind]
        if joint.max_rate is not None:
            keys["max_rate"] = tidy(joint.max_rate * unit)
        self._draft.add("joint", keys, remark)

    # -- rows ----------------------------------------------------------------------------------------------------------

    def _add_rows(self, node: _Node) -> None:
        """Add the rows of all joints after a joint, depth first."""
        for number, child in enumerate(node.children):
            if node.joint is None and number == 0:
                self._add_first(child)
            elif number == 0:
                self._add_row(child, node.row, self._link(node), node.frame)
            else:
                self._add_branch(node, child)
            self._add_rows(child)

    def _link(self, node: _Node, number: int = 0) -> Link | None:
        """Return the step from a joint to its child `number`; None if it has no children."""
        if not node.children:
            return None
        return link_frame(node.line, node.children[number].line, node.link[:3, 0])

    def _goal(self, child: _Node) -> Floats:
        """Return the frame after a joint's row, before the rotation by beta."""
        link = self._link(child)
        return end_frame(child.line, child.link) if link is None else link.before_beta

    def _add_first(self, child: _Node) -> None:
        """Add the row of the first joint; its mounting is part of the base transform, which is always estimated."""
        self._append(child, 0, self._goal(child), 0.0, 0.0, (), fixed=True)

    def _add_row(self, child: _Node, after: int, link: Link | None, frame: Floats | None) -> None:
        assert link is not None
        assert frame is not None
        self._append(child, after, turned(moved(frame, 0, link.a), "x", link.alpha), link.a, link.alpha, _IDENTIFIED)

    def _add_branch(self, node: _Node, child: _Node) -> None:
        """Add the rows of a further joint on a link: first a row without drive, about and along the link's own axis."""
        link = link_frame(node.line if node.joint else self._root.line, child.line, node.link[:3, 0])
        assert node.frame is not None
        d, theta = step_along(node.frame, link.before_beta)
        identify = ("theta", "beta") if link.is_parallel else ("d", "theta")
        name = child.joint.name if child.joint else ""
        keys = {"d": d, "theta": theta, "beta": link.beta}
        number, frame = self._row(node.row, node.frame, keys, {}, identify, f"mounting of {name}")
        self._add_row(child, number, link, frame)

    def _append(
        self,
        child: _Node,
        after: int,
        start: Floats,
        a: float,
        alpha: float,
        identify: tuple[str, ...],
        *,
        fixed: bool = False,
    ) -> None:
        """Add the row of a joint whose axis is the z axis of the frame `start`."""
        joint = child.joint
        assert joint is not None
        link, goal = self._link(child), self._goal(child)
        d, theta = step_along(start, goal)
        source, how = self._source_of(joint)
        turns = joint.kind == "revolute"
        keys = {"a": a, "alpha": alpha, "d": d, "theta": theta, "beta": 0.0 if link is None else link.beta}
        unit = {"revolute": math.degrees(1.0), "prismatic": 1.0}
        coefficient = how.multiplier * unit[joint.kind or ""] / unit[source.kind or ""]
        drive = {"theta" if turns else "d": {self._names[source.name]: tidy(coefficient)}}
        if link is not None and link.is_parallel:
            identify = (*identify, "beta")
        remark = joint.name if source is joint else f"{joint.name}, which follows {source.name}"
        offset = how.offset  # part of the row's constant, but not of the frames at zero joint values
        before = start if fixed else None
        child.row, child.frame = self._row(after, start, keys, drive, identify, remark, before, offset)

    def _row(
        self,
        after: int,
        start: Floats,
        keys: dict[str, float],
        drive: dict[str, dict[str, float]],
        identify: tuple[str, ...],
        remark: str,
        before: Floats | None = None,
        offset: float = 0.0,
    ) -> tuple[int, Floats]:
        """Add a row; return its number and the (4, 4) frame after it, computed from the constants as written."""
        rows = self._draft.sections["row"]
        table: dict[str, object] = {}
        if after != len(rows):
            table["after"] = after
        frame = start
        if before is not None:
            table["before"], frame = _transform(before)
        elif after:
            frame = self._frames[after]
        else:
            frame = np.eye(4)
        written = {
            key: tidy(math.degrees(value)) if key in ("alpha", "theta", "beta") else tidy(value)
            for key, value in keys.items()
        }
        frame = moved(frame, 0, written.get("a", 0.0))
        frame = turned(frame, "x", math.radians(written.get("alpha", 0.0)))
        frame = moved(frame, 2, written["d"])
        frame = turned(turned(frame, "z", math.radians(written["theta"])), "y", math.radians(written["beta"]))
        if offset:
            key = next(iter(drive))
            written[key] = tidy(written[key] + (math.degrees(offset) if key == "theta" else offset))
        table |= {f"{k}_{'deg' if k in ('alpha', 'theta', 'beta') else 'mm'}": v for k, v in written.items() if v}
        if drive:
            table["drive"] = drive
        table["identify"] = list(identify)
        self._draft.add("row", table, remark)
        self._frames[len(rows)] = frame
        return len(rows), frame

    # -- prisms and masses ---------------------------------------------------------------------------------------------

    def _carrier(self, link: str) -> _Node:
        """Return the joint that moves a link, or the base."""
        kept = [joint for joint in self._way(link) if joint.name in self._nodes]
        return self._nodes[kept[-1].name] if kept else self._root

    def _add_prisms(self) -> None:
        taken: set[str] = set(self._names.values())
        for tip in self._tips:
            carrier = self._carrier(tip)
            assert carrier.frame is not None
            frame, transform = carrier.row, np.linalg.inv(carrier.frame) @ self._place(tip)
            if np.abs(transform - np.eye(4)).max() > _SAME:
                before, _ = _transform(transform)
                table: dict[str, object] = {"before": before, "identify": []}
                if frame != len(self._draft.sections["row"]):
                    table = {"after": frame, **table}
                self._draft.add("row", table, f"link {tip}")
                frame = len(self._draft.sections["row"])
            name = free_name(tip, taken)
            taken.add(name)
            self._draft.add(
                "prism",
                {"name": name, "frame": frame, "offset_mm": [0.0, 0.0, 0.0], "offset_known": False},
                f"link {tip}; the position of the reflector on it is not known",
            )

    def _add_masses(self) -> None:
        for link, inertial in self._urdf.links.items():
            if inertial is None or inertial.kg == 0.0 or not self._is_inside(link):
                continue
            carrier = self._carrier(link)
            assert carrier.frame is not None
            place = np.linalg.inv(carrier.frame) @ self._place(link)
            rotation, centre = place[:3, :3], place[:3, :3] @ inertial.centre_mm + place[:3, 3]
            tensor = rotation @ inertial.inertia_kg_m2 @ rotation.T
            table: dict[str, object] = {"name": link, "frame": carrier.row, "kg": inertial.kg}
            table["centre_mm"] = [tidy(x) for x in centre]
            if tensor.any():
                rounding = _SAME * np.abs(tensor).max()
                entries = [float(tensor[at]) for at in INERTIA_ORDER]
                table["inertia_kg_m2"] = [0.0 if abs(entry) <= rounding else entry for entry in entries]
            self._draft.add("mass", table | {"assumed": False})


INERTIA_ORDER = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def _transform(matrix: Floats) -> tuple[dict[str, float], Floats]:
    """Return the keys of `before` for a transform (4, 4), and the transform that these keys describe."""
    turns = [tidy(math.degrees(angle)) for angle in angles_zyx(matrix[:3, :3])]
    shifts = [tidy(length) for length in matrix[:3, 3]]
    frame = np.eye(4)
    frame[:3, 3] = shifts
    for axis, angle in zip("zyx", turns, strict=True):
        frame = turned(frame, axis, math.radians(angle))
    keys = dict(zip(("x_mm", "y_mm", "z_mm", "rz_deg", "ry_deg", "rx_deg"), (*shifts, *turns), strict=True))
    return {key: value for key, value in keys.items() if value}, frame
