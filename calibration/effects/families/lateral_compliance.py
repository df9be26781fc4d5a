"""A link that deflects sideways: it bends out of its joint's plane, and its bearing tilts."""

from __future__ import annotations

import numpy as np

from calibration.effects.links import LinkFamily, own_rows, turning_rows
from calibration.observations import Floats
from calibration.rig.description import Rig


class LateralCompliance(LinkFamily):
    """A link turns about the two axes perpendicular to its joint's axis, in proportion to the moments about them.

    About the joint's own axis the link is taken as stiff; that deflection is `joint_compliance`. The bearing of a
    slewing boom tilts with the full moment of the boom. A lifting boom twists under loads off its axis, and leans where
    the machine stands on a slope. The first turning joint is not a place: a tilt there is that of the base
    (`base_compliance`).
    """

    name = "lateral_compliance"
    equation = (
        "turn about the joint's place = compliance * (M - (M z) z), M the moment of all weights beyond, z the axis"
    )
    source = "bearing and link as a linear spring against tilting, equal about both axes perpendicular to the joint's"
    secondary_to = ("joint_compliance",)
    confused_with = ("joint_compliance", "base_compliance", "boom_droop")
    revealed_by = "loads far to the side of the link: the head turned to either side, or the machine on a slope"

    def places(self, rig: Rig) -> tuple[str, ...]:
        turning = set(turning_rows(rig)) if rig.masses else set()
        return tuple(name for name, row in own_rows(rig).items() if turning & set(rig.path(row)[:-1]))

    def row(self, rig: Rig, where: str) -> int:
        return own_rows(rig)[where]

    def deflecting_moment(self, axis: Floats, moments: Floats) -> Floats:
        about = np.einsum("ni,nik->nk", axis, moments)
        across: Floats = moments - axis[:, :, None] * about[:, None]
        return across


FAMILY = LateralCompliance()
