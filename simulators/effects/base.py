"""What an effect may see of the machine, and what it may do to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.rig import Rig

Floats = NDArray[np.float64]


class Body(Protocol):
    """A machine under load at n instants, as effects see it."""

    @property
    def rig(self) -> Rig:
        """The rig description (names, limits)."""

    @property
    def read(self) -> Mapping[str, Floats]:
        """Joint name -> (n,) what its encoder or transducer says, rad or mm."""

    @property
    def gravity(self) -> Floats:
        """(3,) acceleration of gravity in the base frame, m/s^2."""

    def column(self, name: str) -> Floats:
        """(n,) of an observation column (`theta4_dir`, ...); ValueError when the caller did not give it."""

    def torque(self, joint: str) -> Floats:
        """(n,) generalised force of gravity on a joint: N m for a revolute, N for a prismatic one."""

    def beam(self, row: int) -> Beam:
        """The beam that row's driven length `a` is, and what hangs on it."""


@dataclass(frozen=True)
class Beam:
    """A telescoping beam from its root to its tip, at n instants; lengths m, forces N, in the base frame.

    Attributes:
        axis: (n, 3) unit vector from root to tip.
        length_m: (n,).
        tip_mm: (n, 3).
        force_newton: (n, 3) weight of everything beyond the tip.
        moment_newton_m: (n, 3) its moment about the tip.
        own_weight_newton: weight of what is fixed to the root section, spread evenly over the length.
    """

    axis: Floats
    length_m: Floats
    tip_mm: Floats
    force_newton: Floats
    moment_newton_m: Floats
    own_weight_newton: Floats


@dataclass(frozen=True)
class Bend:
    """Everything at and beyond frame `frame` moves as one: it turns about `about_mm` and then shifts.

    Attributes:
        frame: first frame that moves.
        about_mm: (n, 3).
        rotation_vector: (n, 3) rad.
        shift_mm: (n, 3).
    """

    frame: int
    about_mm: Floats
    rotation_vector: Floats
    shift_mm: Floats


@dataclass(frozen=True)
class Effect:
    """A hidden imperfection.

    Attributes:
        where: the joint value's name, or `boom`.
    """

    family: ClassVar[str]
    where: str

    def check(self, rig: Rig) -> None:
        """ValueError when the rig has no such place."""
        if self.where not in rig.joint_names:
            raise ValueError(f"{self.family}@{self.where}: rig {rig.name!r} has joints {', '.join(rig.joint_names)}")

    def joint_change(self, body: Body) -> Floats | None:
        """(n,) true joint value minus read joint value, rad or mm; None when the effect is elsewhere."""
        del body
        return None

    def bends(self, body: Body) -> Sequence[Bend]:
        """Elastic displacements that are no joint's."""
        del body
        return ()


def check_kind(effect: Effect, rig: Rig, kind: str) -> None:
    """ValueError unless the effect sits at a joint of the given kind."""
    if rig.joint(effect.where).kind != kind:
        raise ValueError(f"{effect.family}@{effect.where}: {effect.where} is not a {kind} joint")
