"""Public robots, from the package example-robot-data, and their forward kinematics by pinocchio."""

from __future__ import annotations

import sysconfig
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio

from calibration.rig.description import Joint
from calibration.rig.exchange.draft import Draft
from calibration.rig.exchange.from_urdf import draft_of_urdf
from calibration.rig.exchange.urdf import parse_urdf

_DIRECTORY = Path(sysconfig.get_path("purelib"), "cmeel.prefix/share/example-robot-data/robots")


@dataclass(frozen=True)
class Robot:
    """A URDF of the package, and what of it is imported.

    Attributes:
        file: below the package's directory of robots.
        base: link that the rig stands on; the root by default.
        tips: links that carry a prism; the ends of all chains by default.
    """

    file: str
    base: str | None = None
    tips: tuple[str, ...] = ()

    @property
    def path(self) -> Path:
        """The file."""
        return _DIRECTORY / self.file

    @property
    def text(self) -> str:
        """The URDF."""
        return self.path.read_text(encoding="utf-8")

    def draft(self) -> Draft:
        """The rig file made from it."""
        return draft_of_urdf(parse_urdf(self.text, self.path.name), self.path.name, self.base, self.tips)

    @property
    def options(self) -> list[str]:
        """Options of `rigcal rig import`."""
        base = ["--base", self.base] if self.base else []
        return [*base, *(word for tip in self.tips for word in ("--tip", tip))]


ROBOTS: Mapping[str, Robot] = {
    "ur5": Robot("ur_description/urdf/ur5_robot.urdf"),
    "ur10": Robot("ur_description/urdf/ur10_robot.urdf"),
    "panda": Robot("panda_description/urdf/panda.urdf"),  # one finger mimics the other
    "kinova": Robot("kinova_description/robots/kinova.urdf"),
    "baxter": Robot("baxter_description/urdf/baxter.urdf", None, ("left_gripper", "right_gripper")),
    "talos_arm": Robot("talos_data/robots/talos_left_arm.urdf"),
    "talos": Robot(
        "talos_data/robots/talos_reduced.urdf",
        "torso_2_link",
        ("gripper_left_base_link", "gripper_right_base_link"),
    ),
    "tiago": Robot("tiago_description/robots/tiago.urdf", None, ("arm_tool_link",)),
}


class Pinocchio:
    """Forward kinematics of a URDF.

    Args:
        text: the document.
        joints: of the rig, whose names are those of the URDF.
    """

    def __init__(self, text: str, joints: Sequence[Joint]) -> None:
        self._model = pinocchio.buildModelFromXML(text, mimic=True)
        self._data = self._model.createData()
        self._joints = joints

    def place_mm(self, link: str, values: Sequence[float], base: str | None = None) -> np.ndarray:
        """(3,) origin of a link in the frame of another one (the root by default) at joint values, deg and mm."""
        model, q = self._model, pinocchio.neutral(self._model)
        for joint, value in zip(self._joints, values, strict=True):
            number = model.getJointId(joint.name)
            at, own = model.idx_qs[number], np.radians(value) if joint.kind == "revolute" else value / 1e3
            if model.nqs[number] == 2:  # a continuous joint: cosine and sine
                q[at : at + 2] = np.cos(own), np.sin(own)
            else:
                q[at] = own
        pinocchio.framesForwardKinematics(model, self._data, q)
        place = self._data.oMf[model.getFrameId(link)]
        if base is not None:
            place = self._data.oMf[model.getFrameId(base)].actInv(place)
        return np.asarray(place.translation * 1e3)

    def places_mm(self, links: Sequence[str], poses: np.ndarray, base: str | None = None) -> np.ndarray:
        """(n, links, 3) likewise for poses (n, joints)."""
        return np.array([[self.place_mm(link, pose.tolist(), base) for link in links] for pose in poses])
