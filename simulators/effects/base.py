"""Base of hidden effects: the machine's quantities on which they depend, and the displacements that they cause."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import Rig

Floats = NDArray[np.float64]


class Body(Protocol):
    """A machine under load at n instants, the input of effects."""

    @property
    def rig(self) -> Rig:
        """Rig description (names, limits)."""

    @property
    def read(self) -> Mapping[str, Floats]:
        """Joint name -> (n,) reading of its encoder or transducer, rad or mm."""

    @property
    def gravity(self) -> Floats:
        """(3,) acceleration of gravity in the base frame, m/s^2."""

    def column(self, name: str) -> Floats:
        """Return an (n,) observation column (`theta4_dir`, ...); ValueError if the caller did not provide it."""

    def has(self, name: str) -> bool:
        """Return True if the caller provided an observation column."""

    @property
    def true(self) -> Mapping[str, Floats]:
        """Joint name -> (n,) true value of the joint, rad or mm."""

    def torque(self, joint: str) -> Floats:
        """Return the (n,) generalised force of gravity on a joint: N m if revolute, N if prismatic."""

    def payload_torque(self, joint: str) -> Floats:
        """Return the (n,) part of `torque` that is due to the payload."""

    def origin_mm(self, frame: int) -> Floats:
        """Return the (n, 3) origin of a frame in the base frame."""

    def overturning_newton_m(self) -> Floats:
        """Return the (n, 3) moment of all weights about the base's origin, in the base frame."""

    def beam(self, row: int) -> Beam:
        """Return the beam of a row's driven length `a`, with the loads on it."""

    def turning(self, row: int) -> Turning:
        """Return the axis of a row's driven angle `theta`, with the moment on it."""


@dataclass(frozen=True)
class Beam:
    """A telescoping beam from its root to its tip, at n instants; lengths m, forces N, in the base frame.

    Attributes:
        axis: (n, 3) unit vector from root to tip.
        length_m: (n,) length.
        tip_mm: (n, 3) position of the tip.
        force_newton: (n, 3) weight of everything beyond the tip.
        moment_newton_m: (n, 3) moment of this weight about the tip.
        own_weight_newton: weight of the masses on the root section, spread evenly over the length.
    """

    axis: Floats
    length_m: Floats
    tip_mm: Floats
    force_newton: Floats
    moment_newton_m: Floats
    own_weight_newton: Floats


@dataclass(frozen=True)
class Turning:
    """The axis about which a row turns, at n instants, in the base frame.

    Attributes:
        axis: (n, 3) unit vector along the axis.
        straight_mm: (n, 3) point on the axis where the row turns, for a machine without bends.
        moment_newton_m: (n, 3) moment about that point, with bends, of all weights that turn with the row.
    """

    axis: Floats
    straight_mm: Floats
    moment_newton_m: Floats


@dataclass(frozen=True)
class Bend:
    """Rigid motion of everything at and beyond a frame: a rotation about `about_mm`, and then a shift.

    Attributes:
        frame: first frame that moves; 0 is the base.
        about_mm: (n, 3) centre of the rotation.
        rotation_vector: (n, 3) rotation, rad.
        shift_mm: (n, 3) shift.
    """

    frame: int
    about_mm: Floats
    rotation_vector: Floats
    shift_mm: Floats


@dataclass(frozen=True)
class Sight:
    """A prism as the station sees it at n instants, in the station's frame.

    Attributes:
        prism: name of the prism.
        place_mm: (n, 3) position of the prism.
        axes: (n, 3, 3) axes of the frame to which it is fixed, as columns.
        column: function that returns an (n,) observation column by name; ValueError if the caller did not provide it.
    """

    prism: str
    place_mm: Floats
    axes: Floats
    column: Callable[[str], Floats]


class DrawContext(Protocol):
    """Machine and time span for which an effect is drawn at random."""

    @property
    def rig(self) -> Rig:
        """Rig description."""

    @property
    def first_s(self) -> float:
        """Time at which the data begin, s."""

    @property
    def last_s(self) -> float:
        """Time at which the data end, s."""

    def largest_load(self, joint: str) -> float:
        """Return the largest load of the rig's own weights on a revolute joint in the work volume, N m."""


@dataclass(frozen=True)
class Effect:
    """A hidden imperfection of the machine.

    A subclass sets the class attributes and overrides the methods by which it acts.

    Attributes:
        family: name of the effect, derived from the class name: `joint_compliance` for JointCompliance.
        amplitudes: coefficients that scale the effect (doubling all of them doubles the effect) -> hard bound of
            plausible values.
        bounded_at: the quantity that the bounds limit: the coefficient itself, the angle (rad) at the largest load of
            the rig's own weights on the joint, the angle at their largest moment on the row `moment_row`, or the
            displacement (mm) of the last prism in the work volume.
        has_either_sign: drawn amplitudes may be negative.
        needs_load: the effect acts only on joints that carry a noticeable part of the rig's weight.
        acts_at: kinds of places: `joint`, `revolute`, `prismatic`, `prism`, or `boom`, `base`, `clock`, `station`.
        positive: further coefficients that must be above 0.
        where: name of the joint value or prism, or `boom`, `base`, `clock`, `station`.
    """

    family: ClassVar[str]
    amplitudes: ClassVar[Mapping[str, float]]
    bounded_at: ClassVar[Literal["coefficient", "largest_load", "largest_moment", "full_reach"]] = "coefficient"
    has_either_sign: ClassVar[bool] = False
    needs_load: ClassVar[bool] = False
    acts_at: ClassVar[tuple[str, ...]] = ("joint",)
    positive: ClassVar[tuple[str, ...]] = ()
    where: str

    def __init_subclass__(cls) -> None:
        cls.family = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", cls.__name__).lower()

    def check(self, rig: Rig) -> None:
        """Raise ValueError if the rig has no such place, or a coefficient is impossible."""
        kinds = {"joint": rig.joint_names, "prism": rig.prism_names}
        kinds |= {kind: tuple(j.name for j in rig.joints if j.kind == kind) for kind in ("revolute", "prismatic")}
        places = [place for kind in self.acts_at for place in kinds.get(kind, (kind,))]
        if self.where not in places:
            raise ValueError(f"{self.family}@{self.where}: possible at {', '.join(places) or 'no place of this rig'}")
        for name in self.positive:
            if getattr(self, name) <= 0.0:
                raise ValueError(f"{self.family}@{self.where}: {name} must be positive, not {getattr(self, name):g}")

    def moment_row(self, rig: Rig) -> int:
        """Return the number of the row whose moment bounds the effect; ValueError if a different quantity does."""
        raise ValueError(f"{self.family}: no moment bounds this effect on rig {rig.name!r}")

    def draw_shape(self, data: DrawContext, rng: np.random.Generator) -> Effect:
        """Return the effect with random values of its coefficients other than the amplitudes."""
        del data, rng
        return self

    def anchored(self, first_s: float, mean_degC: float) -> Effect:
        """Return the effect with its reference time and temperature set, if they were left open.

        Open references are taken from the rows of each call: the earliest time and the mean temperature.
        """
        origins = {"first_s": first_s, "at_degC": mean_degC}
        left_open: dict[str, Any] = {name: at for name, at in origins.items() if getattr(self, name, at) is None}
        return replace(self, **left_open) if left_open else self

    def delay_s(self, body: Body) -> Floats | None:
        """Return the (n,) time by which the fix is earlier than the readings; None if they are simultaneous."""
        del body
        return None

    def joint_change(self, body: Body) -> Floats | None:
        """Return the (n,) true joint value minus read joint value, rad or mm; None if the effect acts elsewhere."""
        del body
        return None

    def row_turns(self, body: Body) -> Mapping[int, Floats]:
        """Return row number -> (n,) angle by which the row turns farther than its joints, rad."""
        del body
        return {}

    def growth(self, body: Body) -> Floats | None:
        """Return the (n,) relative increase of all lengths of the machine; None if there is none."""
        del body
        return None

    def bends(self, body: Body) -> Sequence[Bend]:
        """Return the displacements that do not belong to a joint."""
        del body
        return ()

    def fix_shift_mm(self, sight: Sight) -> Floats | None:
        """Return the (n, 3) displacement of the fix from the prism, in the station's frame; None if there is none."""
        del sight
        return None


@dataclass(frozen=True)
class BoomEffect(Effect):
    """An effect of the telescoping boom."""

    acts_at = ("boom",)
    where: str = "boom"

    def check(self, rig: Rig) -> None:
        super().check(rig)
        boom_row(rig)


def boom_row(rig: Rig) -> int:
    """Return the row whose length `a` a transducer drives (the telescoping boom); ValueError if there is none."""
    row = next((n for n, driven, _, _ in rig.couplings() if driven == "a"), None)
    if row is None:
        raise ValueError(f"rig {rig.name!r} has no row with a driven length a")
    return row


def boom_stroke(rig: Rig) -> str:
    """Return the name of the first prismatic joint; ValueError if there is none."""
    stroke = next((joint.name for joint in rig.joints if joint.kind == "prismatic"), None)
    if stroke is None:
        raise ValueError(f"rig {rig.name!r} has no prismatic joint")
    return stroke


def first_turned(rig: Rig) -> dict[str, int]:
    """Return revolute joint -> number of the first row that it turns; joints that turn no row are omitted."""
    rows = {(number, joint) for number, what, joint, _ in rig.couplings() if what == "theta"}
    of_joint = {joint.name: [n for n, name in rows if name == joint.name] for joint in rig.joints}
    return {j.name: min(of_joint[j.name]) for j in rig.joints if j.kind == "revolute" and of_joint[j.name]}


def step_time_s(data: DrawContext, rng: np.random.Generator) -> float:
    """Draw the time of a step, in the middle half of the data."""
    return data.first_s + (data.last_s - data.first_s) * float(rng.uniform(0.25, 0.75))


def hours_since(body: Body, first_s: float | None) -> Floats:
    """Return the (n,) hours of the column `time_s` since `first_s`; None: since the earliest row."""
    time_s = body.column("time_s")
    hours: Floats = (time_s - (np.min(time_s) if first_s is None else first_s)) / 3600.0
    return hours


def warming(body: Body, at_degC: float | None) -> Floats:
    """Return the (n,) kelvin of the column `temperature_degC` above `at_degC`; None: above the mean of the rows."""
    temperature = body.column("temperature_degC")
    warmer: Floats = temperature - (np.mean(temperature) if at_degC is None else at_degC)
    return warmer
