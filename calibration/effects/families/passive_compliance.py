"""A passive row that deflects: the link of a parallel linkage that is turned only through other joints."""

from __future__ import annotations

import numpy as np

from calibration.effects.links import LinkFamily, own_rows, turning_rows
from calibration.observations import Floats
from calibration.rig.description import Rig

_PLACE = "row"


class PassiveCompliance(LinkFamily):
    """A row that is turned through a coupling and has no encoder of its own turns further in proportion to its load.

    Its place is the row's number in the rig file: `row2`. The first row that a joint turns is its own and belongs to
    `joint_compliance`. A row that a cylinder turns belongs here, as no encoder measures its angle.
    """

    name = "passive_compliance"
    equation = "d_theta of the row = compliance * moment of all weights beyond about the row's axis"
    source = "rods and pins of a linkage as a linear spring: deflection = torque / stiffness"
    confused_with = ("joint_compliance", "base_compliance", "linkage_coupling")
    revealed_by = "a prism on the link that the linkage holds, at low and at high load"

    def places(self, rig: Rig) -> tuple[str, ...]:
        own = own_rows(rig).values()
        return tuple(f"{_PLACE}{row}" for row in turning_rows(rig) if row not in own) if rig.masses else ()

    def row(self, rig: Rig, where: str) -> int:
        del rig
        return int(where.removeprefix(_PLACE))

    def deflecting_moment(self, axis: Floats, moments: Floats) -> Floats:
        about: Floats = axis[:, :, None] * np.einsum("ni,nik->nk", axis, moments)[:, None]
        return about


FAMILY = PassiveCompliance()
