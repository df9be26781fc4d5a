"""Structure that is in no library: smooth functions of two joints, and a carrier on a soft jack."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig.description import Rig
from simulators.effects.base import Bend, Body, Effect, Floats

LENGTH = 0.8  # correlation length, in units of half a joint's range
_TERMS = 2  # number of products of one curve of each joint
_WAVES = 40
_EVEN_POINTS = 81


@dataclass(frozen=True)
class PairSurface:
    """A sum of products of centred smooth curves of two joints; its RMS over their ranges is 1.

    As each curve has mean 0 over its joint's range, the mean over either joint is 0 at any value of the other joint.
    Therefore no error of a single joint's own angle describes a part of the sum.

    Attributes:
        first, second: names of the joints.
        seed: the same seed draws the same function.
    """

    first: str
    second: str
    seed: int

    def values(self, rig: Rig, read: Mapping[str, Floats]) -> Floats:
        """Return the (n,) values at readings, joint name -> (n,) rad or mm."""
        rng = np.random.default_rng([self.seed, 73])
        even = np.linspace(-1.0, 1.0, _EVEN_POINTS)
        at = scaled_reading(rig, self.first, read), scaled_reading(rig, self.second, read)
        grid, out = np.zeros((_EVEN_POINTS, _EVEN_POINTS)), np.zeros(len(at[0]))
        for _ in range(_TERMS):
            (grid_first, first), (grid_second, second) = (_curve(rng, even, values) for values in at)
            grid += np.outer(grid_first, grid_second)
            out += first * second
        return out / float(np.sqrt(np.mean(grid**2)))


def draw_surface(rig: Rig, seed: int) -> PairSurface:
    """Draw a function of two joints of a rig from a seed."""
    first, second = np.random.default_rng([seed, 72]).choice(np.array(rig.joint_names), 2, replace=False)
    return PairSurface(str(first), str(second), seed)


def scaled_reading(rig: Rig, joint: str, read: Mapping[str, Floats]) -> Floats:
    """Return the (n,) readings of a joint (rad or mm) scaled to -1 to 1 between its limits."""
    description = rig.joint(joint)
    low, high = np.deg2rad(description.limits) if description.kind == "revolute" else description.limits
    scaled: Floats = 2.0 * (read[joint] - low) / (high - low) - 1.0
    return scaled


def _curve(rng: np.random.Generator, even: Floats, at: Floats) -> tuple[Floats, Floats]:
    """Draw a curve with Gaussian correlation; return its values, minus its mean, at `even` and at `at`."""
    cycles, phase = rng.normal(0.0, 1.0 / LENGTH, _WAVES), rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    on_even, values = (np.cos(np.outer(points, cycles) + phase).sum(axis=1) for points in (even, at))
    return on_even - on_even.mean(), values - on_even.mean()


@dataclass(frozen=True)
class JointPairError(Effect):
    """An error of a joint that depends on two joints together: hoses, cable trays and castings pull on each other.

    True value - read value = a smooth function of two joints as read, drawn once from `seed`.

    Attributes:
        rms_rad: root mean square over the joints' ranges; for a prismatic joint `mm_per_rad` times as much, in mm.
        seed: the same seed draws the same function of the same two joints.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rms_rad": 10e-3}
    acts_at = ("joint",)
    mm_per_rad: ClassVar[float] = 5e3
    rms_rad: float = 1.0e-3
    seed: int = 0

    def joint_change(self, body: Body) -> Floats:
        unit = 1.0 if body.rig.joint(self.where).kind == "revolute" else self.mm_per_rad
        return self.rms_rad * unit * draw_surface(body.rig, self.seed).values(body.rig, body.read)


@dataclass(frozen=True)
class PlacePairError(Effect):
    """A displacement of the machine's last frame that depends on two joints together: frames bend and warp.

    The last frame is displaced by a smooth function of two joints along each axis of the base's frame.

    Attributes:
        rms_mm: root mean square of each component over the ranges of its two joints.
        seed: the same seed draws the same functions.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rms_mm": 50.0}
    acts_at = ("boom",)
    where: str = "boom"
    rms_mm: float = 5.0
    seed: int = 0

    def bends(self, body: Body) -> Sequence[Bend]:
        axes = [draw_surface(body.rig, 3 * self.seed + axis).values(body.rig, body.read) for axis in range(3)]
        shift = self.rms_mm * np.stack(axes, axis=1)
        return (Bend(len(body.rig.rows), np.zeros_like(shift), np.zeros_like(shift), shift),)


@dataclass(frozen=True)
class JackLean(Effect):
    """A carrier on jacks that are softer on one side: it leans to the side that its boom loads.

    Tilt about the base's origin: about its x axis by c_x (M_x + s |M_x|), likewise about y; M is the weights' moment.

    Attributes:
        x_rad_per_Nm, y_rad_per_Nm: c.
        softer: s, from -1 to 1.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"x_rad_per_Nm": 5e-3, "y_rad_per_Nm": 5e-3}
    bounded_at = "largest_load"
    acts_at = ("base",)
    where: str = "base"
    x_rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m
    y_rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m
    softer: float = 0.5

    def bends(self, body: Body) -> Sequence[Bend]:
        moment = body.overturning_newton_m()
        tilt = np.array([self.x_rad_per_Nm, self.y_rad_per_Nm, 0.0]) * (moment + self.softer * np.abs(moment))
        return (Bend(0, np.zeros_like(tilt), tilt, np.zeros_like(tilt)),)
