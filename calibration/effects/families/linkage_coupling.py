"""A linkage that turns a second row by a little more, or less, than it should."""

from __future__ import annotations

from collections import Counter
from typing import ClassVar

from calibration.effects.base import Coefficient, PrismFamily, Settings, Situation, refuse_settings
from calibration.observations import Floats
from calibration.rig import Rig


class LinkageCoupling(PrismFamily):
    """One joint drives several rows; those after the first follow it with a ratio that is off.

    The joint's own row, the first, does as its encoder says.
    """

    name: ClassVar[str] = "linkage_coupling"
    equation: ClassVar[str] = "value of the coupled row = (1 + coupling) * its nominal one, as theta2 = -(1+k) theta1"
    source: ClassVar[str] = "a parallel linkage whose opposite links differ in length, first order"
    confused_with: ClassVar[tuple[str, ...]] = ("angle_scale", "joint_compliance")
    revealed_by: ClassVar[str] = (
        "the whole range of the driving joint, far out and near, at several of the joints beyond"
    )

    def places(self, rig: Rig) -> tuple[str, ...]:
        driven = Counter(name for _, _, name, _ in rig.couplings())
        return tuple(name for name in rig.joint_names if driven[name] > 1)

    def names(self, settings: Settings) -> tuple[str, ...]:
        refuse_settings(settings)
        return ("coupling",)

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        return (Coefficient("coupling", "1", 2e-3, -1e-2, 1e-2),)

    def shift_mm(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del settings
        joint = situation.chain.joint_index[where]
        _, *coupled = (i for i, (_, driving) in enumerate(situation.machine.drives) if driving == joint)
        by_reading = situation.facing.by_drive[:, :, coupled].sum(axis=2)
        return situation.to_station((by_reading * situation.reading(where)[:, None])[:, :, None])


FAMILY = LinkageCoupling()
