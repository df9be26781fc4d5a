"""A linkage that turns a second row by slightly more or less than its nominal ratio."""

from __future__ import annotations

from collections import Counter

from calibration.effects.base import Coefficient, PrismFamily, Settings
from calibration.effects.context import EffectContext
from calibration.observations import Floats
from calibration.rig.description import Rig


class LinkageCoupling(PrismFamily):
    """One joint drives several rows, and the rows after the first follow it with a wrong ratio.

    The first row is the joint's own and follows its encoder.
    """

    name = "linkage_coupling"
    equation = "value of the coupled row = (1 + coupling) * its nominal value, for example theta2 = -(1+k) theta1"
    source = "a parallel linkage whose opposite links differ in length, first order"
    confused_with = ("angle_scale", "joint_compliance")
    revealed_by = (
        "the whole range of the driving joint, at long and short reach, with joints beyond it at several values"
    )
    fixed = (Coefficient("coupling", "1", 2e-3, -1e-2, 1e-2),)

    def places(self, rig: Rig) -> tuple[str, ...]:
        driven = Counter(name for _, _, name, _ in rig.couplings())
        return tuple(name for name in rig.joint_names if driven[name] > 1)

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del settings
        joint = context.chain.joint_index[where]
        _, *coupled = (i for i, (_, driving) in enumerate(context.machine.drives) if driving == joint)
        by_reading = context.facing.by_drive[:, :, coupled].sum(axis=2)
        return context.to_station((by_reading * context.reading(where)[:, None])[:, :, None])


FAMILY = LinkageCoupling()
