"""model.urdf: the identified kinematics as URDF, for ROS, pinocchio, MoveIt and others; lengths m, angles rad.

Couplings are mimic joints, prisms are links.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from calibration.export.model_export import kinematics_format, shortest
from calibration.export.motions import Motion, MotionTree, motion_tree
from calibration.kinematics.chain import Chain
from calibration.observations import Floats
from calibration.rig.description import Joint, Rig
from calibration.rig.exchange.frames import angles_zyx

BASE = "base"
_AXES = ("1 0 0", "0 1 0", "0 0 1")
_OWN = 1e-12  # a motion whose coefficient is 1 within this tolerance can be the joint itself


def urdf_text(chain: Chain, x: Floats, remarks: Sequence[str]) -> str:
    """Return a rig with parameters `x` (p,) as a URDF document, with remarks in a comment at its head."""
    body = "\n".join(f"  {line}" for line in urdf_elements(chain, x))
    return f'<?xml version="1.0"?>\n{xml_comment(remarks)}<robot name={quoteattr(chain.rig.name)}>\n{body}\n</robot>\n'


def urdf_elements(chain: Chain, x: Floats, prefix: str = "") -> Iterator[str]:
    """Yield the links and joints of a rig, one element per line.

    Args:
        chain: kinematics of the rig.
        x: (p,) parameters, mm and rad.
        prefix: prefix of every name.
    """
    return iter(_Elements(chain.rig, motion_tree(chain, x), prefix).lines)


def xml_comment(remarks: Sequence[str]) -> str:
    """Return remarks as an XML comment; "" if there are none."""
    text = "\n".join(remarks).replace("--", "- -")  # "--" is not allowed in a comment
    return f"<!--\n{text}\n-->\n" if remarks else ""


class _Elements:
    """Collects the elements; every term of a drive becomes a URDF joint.

    A joint of the rig becomes a URDF joint of the same name at a motion that it drives one to one. If there is no such
    motion, the URDF joint moves an empty link. All other motions follow it as mimic joints.
    """

    def __init__(self, rig: Rig, tree: MotionTree, prefix: str) -> None:
        self._rig, self._prefix = rig, prefix
        self.lines: list[str] = []
        self._owners = self._first_motions(tree)
        self._link(BASE)
        for joint in range(len(rig.joints)):
            if joint not in self._owners:
                self._empty_joint(joint)
        links = {-1: BASE}
        for index, motion in enumerate(tree.motions):
            links[index] = self._add(motion, index, links[motion.parent])
        for name, (frame, place_mm) in tree.prisms.items():
            self._fixed(f"prism_{name}", links[tree.frames[frame]], name, _at(place_mm))
            self._link(name)
        self._masses(tree, links)

    def _first_motions(self, tree: MotionTree) -> dict[int, tuple[int, int]]:
        """Return the first motion that each joint drives one to one: joint -> (motion, term of its drive)."""
        found: dict[int, tuple[int, int]] = {}
        for index, motion in enumerate(tree.motions):
            for term, (joint, _) in enumerate(motion.drive):
                rated = self._ratio(motion, term)
                same_kind = motion.rotates == (self._rig.joints[joint].kind == "revolute")
                if joint not in found and same_kind and abs(abs(rated) - 1.0) < _OWN:
                    found[joint] = (index, term)
        return found

    def _ratio(self, motion: Motion, term: int) -> float:
        """Return m or rad of a motion per m or rad of the joint in term `term` of its drive."""
        joint, coefficient = motion.drive[term]
        own = math.degrees(1.0) if self._rig.joints[joint].kind == "revolute" else 1e3
        return coefficient * own * (1.0 if motion.rotates else 1e-3)

    def _add(self, motion: Motion, index: int, parent: str) -> str:
        """Add a motion; return the name of the link after it."""
        name = motion.name.replace(".", "_")
        if not motion.drive:
            self._fixed(f"to_{name}", parent, name, motion.fixed)
            self._link(name)
            return name
        for term, (joint, _) in enumerate(motion.drive):
            link = name if len(motion.drive) == 1 else f"{name}_{self._rig.joints[joint].name}"
            origin = motion.fixed if term == 0 else np.eye(4)
            ratio = self._ratio(motion, term)
            own = self._owners.get(joint) == (index, term)
            axis = _AXES[motion.axis]
            if own:
                axis = axis.replace("1", "-1") if ratio < 0.0 else axis
            self._moving(joint, parent, link, origin, axis, motion.rotates, None if own else ratio, name)
            self._link(link)
            parent = link
        return parent

    def _empty_joint(self, joint: int) -> None:
        """Add a joint that moves only an empty link, so that mimic joints can follow it."""
        own = self._rig.joints[joint]
        self._moving(joint, BASE, f"{own.name}_alone", np.eye(4), _AXES[2], own.kind == "revolute", None, "")
        self._link(f"{own.name}_alone")

    def _moving(
        self,
        joint: int,
        parent: str,
        child: str,
        origin: Floats,
        axis: str,
        rotates: bool,
        ratio: float | None,
        place: str,
    ) -> None:
        own: Joint = self._rig.joints[joint]
        name = own.name if ratio is None else f"{own.name}_at_{place}"
        low, high = sorted((1.0 if ratio is None else ratio) * _si(own, limit) for limit in own.limits)
        rate = abs(1.0 if ratio is None else ratio) * _si(own, own.max_rate)
        kind = "revolute" if rotates else "prismatic"
        follows = ""
        if ratio is not None:
            follows = f'<mimic joint="{self._prefix}{own.name}" multiplier="{shortest(ratio)}" offset="0"/>'
        self.lines.append(
            f'<joint name="{self._prefix}{name}" type="{kind}">{self._between(parent, child)}{_origin(origin)}'
            f'<axis xyz="{axis}"/><limit lower="{shortest(low)}" upper="{shortest(high)}" effort="0" '
            f'velocity="{shortest(rate)}"/>{follows}</joint>'
        )

    def _fixed(self, name: str, parent: str, child: str, origin: Floats) -> None:
        self.lines.append(
            f'<joint name="{self._prefix}{name}" type="fixed">{self._between(parent, child)}{_origin(origin)}</joint>'
        )

    def _between(self, parent: str, child: str) -> str:
        return f'<parent link="{self._prefix}{parent}"/><child link="{self._prefix}{child}"/>'

    def _link(self, name: str, inside: str = "") -> None:
        self.lines.append(f'<link name="{self._prefix}{name}">{inside}</link>')

    def _masses(self, tree: MotionTree, links: dict[int, str]) -> None:
        for number, mass in enumerate(self._rig.masses, 1):
            shares = [(mass.frame, np.array(mass.centre_mm or (0.0, 0.0, 0.0)), mass.kg)]
            if mass.midway:  # half of the mass at each end has the same weight and moment
                shares = [(frame, np.zeros(3), mass.kg / 2.0) for frame in (mass.frame, mass.frame + 1)]
            for part, (frame, centre_mm, kg) in enumerate(shares):
                if kg == 0.0:
                    continue
                name = f"mass{number}" + (f"_{part + 1}" if mass.midway else "")
                tensor = mass.inertia_kg_m2 or (0.0,) * 6
                keys = zip(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), tensor, strict=True)
                inertia = " ".join(f'{key}="{shortest(value)}"' for key, value in keys)
                self.lines.append(f"<!-- {name}: {escape(mass.name.replace('--', '- -'))} -->")
                self._fixed(f"to_{name}", links[tree.frames[frame]], name, np.eye(4))
                self._link(
                    name,
                    f'<inertial>{_origin(_at(centre_mm))}<mass value="{shortest(kg)}"/><inertia {inertia}/></inertial>',
                )


def _si(joint: Joint, value: float) -> float:
    """Return a value of a joint, deg or mm, in rad or m."""
    return math.radians(value) if joint.kind == "revolute" else value / 1e3


def _at(place_mm: Floats) -> Floats:
    out = np.eye(4)
    out[:3, 3] = place_mm
    return out


def _origin(transform: Floats) -> str:
    yaw, pitch, roll = angles_zyx(transform[:3, :3])
    xyz = " ".join(shortest(x / 1e3) for x in transform[:3, 3].tolist())
    return f'<origin xyz="{xyz}" rpy="{shortest(roll)} {shortest(pitch)} {shortest(yaw)}"/>'


FORMAT = kinematics_format("urdf", "model.urdf", "the identified kinematics for ROS, pinocchio and others", urdf_text)
