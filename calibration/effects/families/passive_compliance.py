"""A passive row that gives way: the link of a parallel linkage that nothing but other joints turns."""

from __future__ import annotations

import numpy as np

from calibration.effects.links import LinkFamily, own_rows, turning_rows
from calibration.observations import Floats
from calibration.rig.description import Rig

_PLACE = "row"


class PassiveCompliance(LinkFamily):
    """A row that turns by a coupling, and is no encoder's own, turns further in proportion to its load.

    Its place is the row's number in the rig file: `row2`. Own rows of a joint, the first that it turns, are in
    `joint_compliance`; a row that a cylinder turns is here, as no encoder reads its angle.
    """

    name = "passive_compliance"
    equation = "d_theta of the row = compliance * moment of all weights beyond about the row's axis"
    source = "a linkage's rods and pins as a linear spring: deflection = torque / stiffness"
    confused_with = ("joint_compliance", "base_compliance", "linkage_coupling")
    revealed_by = "a prism on the link that the linkage holds, under little load and under much"

    def places(self, rig: Rig) -> tuple[str, ...]:
        own = own_rows(rig).values()
        return tuple(f"{_PLACE}{row}" for row in turning_rows(rig) if row not in own) if rig.masses else ()

    def row(self, rig: Rig, where: str) -> int:
        del rig
        return int(where.removeprefix(_PLACE))

    def given_way_to(self, axis: Floats, moments: Floats) -> Floats:
        about: Floats = axis[:, :, None] * np.einsum("ni,nik->nk", axis, moments)[:, None]
        return about


FAMILY = PassiveCompliance()
