"""What an effect may see of the machine, and what it may do to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol

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

    def has(self, name: str) -> bool:
        """Whether the caller gave an observation column."""

    @property
    def true(self) -> Mapping[str, Floats]:
        """Joint name -> (n,) the joint's own value, rad or mm."""

    def torque(self, joint: str) -> Floats:
        """(n,) generalised force of gravity on a joint: N m for a revolute, N for a prismatic one."""

    def payload_torque(self, joint: str) -> Floats:
        """(n,) the part of `torque` that the payload makes."""

    def origin_mm(self, frame: int) -> Floats:
        """(n, 3) origin of a frame, in the base frame."""

    def overturning_newton_m(self) -> Floats:
        """(n, 3) moment of all weights about the base's origin, in the base frame."""

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
        frame: first frame that moves; 0 is the base.
        about_mm: (n, 3).
        rotation_vector: (n, 3) rad.
        shift_mm: (n, 3).
    """

    frame: int
    about_mm: Floats
    rotation_vector: Floats
    shift_mm: Floats


@dataclass(frozen=True)
class Sight:
    """A prism as the station sees it at n instants, in the station's frame.

    Attributes:
        prism: its name.
        place_mm: (n, 3) where it is.
        axes: (n, 3, 3) the axes of the frame that it is fixed to, as columns.
    """

    prism: str
    place_mm: Floats
    axes: Floats


@dataclass(frozen=True)
class Effect:
    """A hidden imperfection.

    Attributes:
        family: its name.
        size: names of the coefficients that are its amplitude: twice of each is twice the effect.
        where: the joint value's name, a prism's, or `boom`, `base`, `clock`, `station`.
    """

    family: ClassVar[str]
    size: ClassVar[tuple[str, ...]]
    where: str

    def check(self, rig: Rig) -> None:
        """ValueError when the rig has no such place."""
        if self.where not in rig.joint_names:
            raise ValueError(f"{self.family}@{self.where}: rig {rig.name!r} has joints {', '.join(rig.joint_names)}")

    def anchored(self, first_s: float, mean_degC: float) -> Effect:
        """The same effect with the instant and the temperature from which it counts fixed, where they were left open.

        Left open, they are those of the rows that a call gives: the earliest time and the mean temperature.
        """
        origins = {"first_s": first_s, "at_degC": mean_degC}
        left_open: dict[str, Any] = {name: at for name, at in origins.items() if getattr(self, name, at) is None}
        return replace(self, **left_open) if left_open else self

    def delay_s(self, body: Body) -> Floats | None:
        """(n,) how much earlier than the readings the fix was; None when it is of their instant."""
        del body
        return None

    def joint_change(self, body: Body) -> Floats | None:
        """(n,) true joint value minus read joint value, rad or mm; None when the effect is elsewhere."""
        del body
        return None

    def row_turns(self, body: Body) -> Mapping[int, Floats]:
        """Row number -> (n,) by how much it turns further than its joints say, rad."""
        del body
        return {}

    def growth(self, body: Body) -> Floats | None:
        """(n,) by what share all lengths of the machine are longer; None when they are not."""
        del body
        return None

    def bends(self, body: Body) -> Sequence[Bend]:
        """Displacements that are no joint's."""
        del body
        return ()

    def fix_shift_mm(self, sight: Sight) -> Floats | None:
        """(n, 3) by what the fix lies beside the prism, in the station's frame; None when it does not."""
        del sight
        return None


def check_kind(effect: Effect, rig: Rig, kind: str) -> None:
    """ValueError unless the effect sits at a joint of the given kind."""
    if rig.joint(effect.where).kind != kind:
        raise ValueError(f"{effect.family}@{effect.where}: {effect.where} is not a {kind} joint")


def check_place(effect: Effect, *places: str) -> None:
    """ValueError unless the effect is at one of these."""
    if effect.where not in places:
        raise ValueError(f"{effect.family}@{effect.where}: it acts at {', '.join(places)}")


def hours_since(body: Body, first_s: float | None) -> Floats:
    """(n,) hours since an instant of the column `time_s`; None: since the earliest row's."""
    time_s = body.column("time_s")
    hours: Floats = (time_s - (np.min(time_s) if first_s is None else first_s)) / 3600.0
    return hours


def warming(body: Body, at_degC: float | None) -> Floats:
    """(n,) kelvin above a temperature of the column `temperature_degC`; None: above the rows' mean."""
    temperature = body.column("temperature_degC")
    warmer: Floats = temperature - (np.mean(temperature) if at_degC is None else at_degC)
    return warmer
