"""Reading of URDF documents into links and joints; lengths mm, angles rad, transforms at zero joint values.

Source: the URDF specification of ROS (wiki.ros.org/urdf/XML). Geometry, transmissions, friction and safety limits are
ignored.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.errors import RigError

Floats = NDArray[np.float64]

LONGEST = 1 << 24  # characters; a humanoid with the names of its meshes has some 200,000
_MOST_ELEMENTS = 20_000
_MOST_TAGS = 3 * _MOST_ELEMENTS  # an element has two, and may have a comment
_LARGEST = 1e9  # largest number of metres or radians, and largest component of a direction
_XACRO = "xacro that is not expanded; run `xacro FILE > ROBOT.urdf`, and import that"
_EXPRESSION = re.compile(r"\$\{|\$\((?:arg|find|eval|env|optenv|dirname|anon)\b")
_TURNING, _SLIDING, _FREE = ("revolute", "continuous"), ("prismatic",), ("floating", "planar")


@dataclass(frozen=True)
class Inertial:
    """A link's mass.

    Attributes:
        kg: the mass.
        centre_mm: (3,) centre of gravity in the link's frame.
        inertia_kg_m2: (3, 3) inertia tensor about the centre, along the link's axes.
    """

    kg: float
    centre_mm: Floats
    inertia_kg_m2: Floats


@dataclass(frozen=True)
class Mimic:
    """How a joint follows another: value = multiplier * value of `joint` + offset, rad or mm."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class UrdfJoint:
    """A joint.

    Attributes:
        name: name of the joint.
        kind: `revolute`, `prismatic` or `fixed`; None if it moves in several directions (floating, planar).
        parent, child: names of links.
        origin: (4, 4) frame of the child in the frame of the parent, at zero.
        axis: (3,) unit vector in the child's frame.
        limits: lowest and highest value, rad or mm; None if continuous or not in the file.
        missing_limit: `lower` or `upper` if the file gives only the other limit, so that this one is 0.
        max_rate: fastest motion, rad/s or mm/s; None if not in the file.
        mimic: the relation to the joint that it follows; None if it does not follow one.
    """

    name: str
    kind: str | None
    parent: str
    child: str
    origin: Floats
    axis: Floats
    limits: tuple[float, float] | None
    max_rate: float | None
    mimic: Mimic | None
    missing_limit: str = ""

    @property
    def moves(self) -> bool:
        """True if the joint is revolute or prismatic and is not locked by equal limits."""
        return self.kind in ("revolute", "prismatic") and (self.limits is None or self.limits[0] < self.limits[1])


@dataclass(frozen=True)
class Urdf:
    """A robot description.

    Attributes:
        name: name of the robot.
        links: name -> inertial; None for a link without one.
        joints: name of the child link -> joint.
    """

    name: str
    links: Mapping[str, Inertial | None]
    joints: Mapping[str, UrdfJoint]

    @property
    def root(self) -> str:
        """The link that is not the child of any joint."""
        return next(link for link in self.links if link not in self.joints)

    def way(self, link: str) -> list[UrdfJoint]:
        """Return the joints from the root to a link."""
        way: list[UrdfJoint] = []
        while link in self.joints:
            way.append(self.joints[link])
            link = self.joints[link].parent
        return way[::-1]

    def place(self, link: str) -> Floats:
        """Return the (4, 4) frame of a link in the frame of the root, at zero joint values."""
        out = np.eye(4)
        for joint in self.way(link):
            out = out @ joint.origin
        return out


def parse_urdf(text: str, source: str) -> Urdf:
    """Read a URDF document.

    Args:
        text: XML.
        source: file name for messages.

    Raises:
        RigError: malformed XML, xacro that was not expanded, invalid numbers, links that do not form a tree.
    """
    if len(text) > LONGEST:
        raise RigError(source, "", f"the text has {len(text):,} characters; the maximum is {LONGEST:,}")
    if (tags := text.count("<")) > _MOST_TAGS:  # parsed elements would take hundreds of times the memory of their text
        raise RigError(source, "", f"it has {tags:,} tags and comments; the maximum is {_MOST_TAGS:,}")
    if "<!DOCTYPE" in text:
        raise RigError(source, "", "it declares a document type, which rigcal does not read; remove <!DOCTYPE ...>")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        if "<xacro:" in text:
            raise RigError(source, "", _XACRO) from error
        raise RigError(source, f"line {error.position[0]}", f"not valid XML: {error}") from error
    return _Reader(source).robot(root)


class _Reader:
    def __init__(self, source: str) -> None:
        self._source = source

    def robot(self, root: ET.Element) -> Urdf:
        elements = list(root.iter())
        if _plain(root.tag) != "robot":
            raise self._fault("", f"not a URDF: the outermost element is <{_plain(root.tag)}>, not <robot>")
        if len(elements) > _MOST_ELEMENTS:
            raise self._fault("", f"it has {len(elements):,} elements; the maximum is {_MOST_ELEMENTS:,}")
        raw = next((e for e in elements if "xacro" in e.tag), None)
        if raw is not None:
            raise self._fault(f"<{_plain(raw.tag)}>", _XACRO)
        if any(_EXPRESSION.search(value) for element in elements for value in element.attrib.values()):
            raise self._fault("", _XACRO)
        for element in elements:  # a namespace of the whole document has no meaning here
            element.tag = _plain(element.tag)
        links = self._links(root)
        stated = [self._joint(e) for e in root.findall("joint")]
        slides = {joint.name: joint.kind == "prismatic" for joint in stated}
        joints = [_in_own_units(joint, slides) for joint in stated]
        by_child = {joint.child: joint for joint in joints}
        self._check_tree(links, joints, by_child)
        return Urdf(root.get("name") or "robot", links, by_child)

    def _links(self, root: ET.Element) -> dict[str, Inertial | None]:
        links: dict[str, Inertial | None] = {}
        for element in root.findall("link"):
            name = self._name(element)
            if name in links:
                raise self._fault(f"link {name!r}", "two links have this name")
            links[name] = self._inertial(element)
        return links

    def _check_tree(self, links: Iterable[str], joints: list[UrdfJoint], by_child: Mapping[str, UrdfJoint]) -> None:
        known, names = set(links), {joint.name: joint for joint in joints}
        for joint in joints:
            if names[joint.name] is not joint:
                raise self._fault(f"joint {joint.name!r}", "two joints have this name")
        for joint in joints:
            for link in (joint.parent, joint.child):
                if link not in known:
                    raise self._fault(f"joint {joint.name!r}", f"there is no link {link!r}")
            if by_child[joint.child] is not joint:
                raise self._fault(f"link {joint.child!r}", "it is the child of two joints; a rig is a tree")
            if joint.mimic is not None and joint.mimic.joint not in names:
                reason = f"it mimics {joint.mimic.joint!r}, but there is no joint of that name"
                raise self._fault(f"joint {joint.name!r}", reason)
        roots = [link for link in links if link not in by_child]
        if len(roots) != 1:
            said = f" ({', '.join(roots[:5])}{', ...' if len(roots) > 5 else ''})" if roots else ""
            raise self._fault(
                "link", f"{len(roots)} links are not the child of a joint{said}; a rig has one such, its base"
            )
        for start in by_child:
            link, steps = start, 0
            while link in by_child:
                link, steps = by_child[link].parent, steps + 1
                if steps > len(by_child):
                    raise self._fault(f"link {start!r}", "its joints form a loop; a rig is a tree")

    def _joint(self, element: ET.Element) -> UrdfJoint:
        name = self._name(element)
        where = f"joint {name!r}"
        kind = element.get("type", "")
        if kind not in (*_TURNING, *_SLIDING, *_FREE, "fixed"):
            types = ", ".join((*_TURNING, *_SLIDING, *_FREE, "fixed"))
            raise self._fault(where, f"unknown type of joint {kind!r}; possible types: {types}")
        slides = kind in _SLIDING
        axis = self._vector(element.find("axis"), "xyz", where, (1.0, 0.0, 0.0))
        length = float(np.linalg.norm(axis))
        if length == 0.0 and kind in (*_TURNING, *_SLIDING):
            raise self._fault(where, "its axis is zero")
        limit = element.find("limit")
        scale = 1e3 if slides else 1.0
        limits = max_rate = None
        missing: list[str] = []
        if limit is not None and kind != "continuous":
            low, high = (self._number(limit, key, where, 0.0) * scale for key in ("lower", "upper"))
            if low > high:
                raise self._fault(where, f"its lower limit {low:g} is greater than its upper limit {high:g}")
            missing = [key for key in ("lower", "upper") if key not in limit.attrib]
            limits = (low, high) if len(missing) < 2 else None
        if limit is not None and (rate := self._number(limit, "velocity", where, 0.0)) > 0.0:
            max_rate = rate * scale
        return UrdfJoint(
            name,
            "revolute" if kind in _TURNING else "prismatic" if slides else "fixed" if kind == "fixed" else None,
            self._link_of(element, "parent", where),
            self._link_of(element, "child", where),
            self._origin(element.find("origin"), where),
            axis / (length or 1.0),
            limits,
            max_rate,
            self._mimic(element, where, scale),
            missing[0] if len(missing) == 1 else "",
        )

    def _mimic(self, element: ET.Element, where: str, scale: float) -> Mimic | None:
        found = element.find("mimic")
        if found is None:
            return None
        multiplier = self._number(found, "multiplier", where, 1.0)
        return Mimic(found.get("joint", ""), multiplier, self._number(found, "offset", where, 0.0) * scale)

    def _inertial(self, element: ET.Element) -> Inertial | None:
        found, where = element.find("inertial"), f"link {element.get('name')!r}"
        mass = None if found is None else found.find("mass")
        if found is None or mass is None:
            return None
        kg = self._number(mass, "value", where, 0.0)
        if kg < 0.0:
            raise self._fault(where, f"its mass is {kg:g} kg; it must not be negative")
        origin = self._origin(found.find("origin"), where)
        tensor, inertia = found.find("inertia"), np.zeros((3, 3))
        if tensor is not None:
            for i, j, key in ((0, 0, "ixx"), (1, 1, "iyy"), (2, 2, "izz"), (0, 1, "ixy"), (0, 2, "ixz"), (1, 2, "iyz")):
                inertia[i, j] = inertia[j, i] = self._number(tensor, key, where, 0.0)
        turned: Floats = origin[:3, :3] @ inertia @ origin[:3, :3].T
        return Inertial(kg, origin[:3, 3], turned)

    def _origin(self, element: ET.Element | None, where: str) -> Floats:
        out = np.eye(4)
        out[:3, 3] = 1e3 * self._vector(element, "xyz", where, (0.0, 0.0, 0.0))
        out[:3, :3] = rotation_of_rpy(*self._vector(element, "rpy", where, (0.0, 0.0, 0.0)))
        return out

    def _vector(self, element: ET.Element | None, key: str, where: str, default: tuple[float, float, float]) -> Floats:
        text = None if element is None else element.get(key)
        if text is None:
            return np.array(default)
        try:
            numbers = [float(part) for part in text.split()]
        except ValueError:
            numbers = []
        if len(numbers) != 3 or not all(abs(number) < _LARGEST for number in numbers):
            raise self._fault(where, f"{key}={text!r} is not three numbers below {_LARGEST:g}")
        return np.array(numbers)

    def _number(self, element: ET.Element, key: str, where: str, default: float) -> float:
        text = element.get(key)
        try:
            number = default if text is None else float(text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise self._fault(where, f"{key}={text!r} is not a number")
        return number

    def _link_of(self, element: ET.Element, role: str, where: str) -> str:
        found = element.find(role)
        link = None if found is None else found.get("link")
        if not link:
            raise self._fault(where, f"it has no <{role} link=...>")
        return link

    def _name(self, element: ET.Element) -> str:
        name = element.get("name")
        if not name:
            raise self._fault(f"<{element.tag}>", "it has no name")
        return name

    def _fault(self, where: str, reason: str) -> RigError:
        return RigError(self._source, where, reason)


def rotation_of_rpy(roll: float, pitch: float, yaw: float) -> Floats:
    """Return Rot(z, yaw) Rot(y, pitch) Rot(x, roll), (3, 3)."""
    (a, b, c), (x, y, z) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    return np.array(
        [
            [a * b, a * y * z - x * c, a * y * c + x * z],
            [x * b, x * y * z + a * c, x * y * c - a * z],
            [-y, b * z, b * c],
        ]
    )


def _plain(tag: str) -> str:
    """Return the name of an element without its namespace."""
    return tag.rpartition("}")[2]


def _in_own_units(joint: UrdfJoint, slides: Mapping[str, bool]) -> UrdfJoint:
    """Return a joint with the multiplier of its mimic converted from rad and m to rad and mm.

    Args:
        joint: the joint as read.
        slides: name of each joint -> True if it is prismatic.
    """
    mimic, own = joint.mimic, joint.kind == "prismatic"
    if mimic is None or slides.get(mimic.joint, own) == own:
        return joint
    return replace(joint, mimic=replace(mimic, multiplier=mimic.multiplier * (1e3 if own else 1e-3)))
