"""Realistic machines: ten effects of six families at once, in addition to smooth structure that is in no library.

The unknown structure consists of joint errors and displacements of the last frame that depend on pairs of joints, a
carrier that leans on its jacks, and a wandering error of the fixes. Effects are drawn so that no hidden effect can be
imitated by the others together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from simulators.blind.cells import LEAST_IN_MACHINE
from simulators.blind.effect_draws import Bounded
from simulators.blind.hiding import HiddenEffect, UnreachableError
from simulators.blind.machine_basis import MachineBasis
from simulators.blind.scene import Scene
from simulators.blind.visibility import Visibility
from simulators.effects.base import Effect
from simulators.effects.library import LIBRARY
from simulators.effects.unknown import JackLean, JointPairError, PlacePairError

SIZES = LEAST_IN_MACHINE, 15.0  # limits of the visible size of each effect, in units of the noise
UNKNOWN = 3.0, 8.0  # limits of the visible size of the whole unknown structure, in units of the noise
WANDER_SHARE = 0.05, 0.2  # share of the wandering error in the square of that size
WANDER_POSES = 10.0, 40.0  # correlation length of the wandering error in poses
# Number of places of each of six families, ten effects in total
_PLACES = ((5, 1, 1, 1, 1, 1), (4, 2, 1, 1, 1, 1), (3, 3, 1, 1, 1, 1), (3, 2, 2, 1, 1, 1), (2, 2, 2, 2, 1, 1))
_UNEVEN = 1.0  # standard deviation of the logarithm of the jacks' softness, about each axis
_PAIR_ERRORS = 2, 4  # number of joints with an error that depends on a pair of joints: minimum, and maximum + 1
_TRIALS = 20  # attempts to draw a structure that no effect of the library describes, and to draw a set of effects
_DESCRIBED = 0.5  # an effect describes a structure if it explains more than this share of its squared visible part


@dataclass(frozen=True)
class UnknownDraw:
    """Sizes of the unknown structure of a machine, in units of the noise.

    Attributes:
        size: size of the whole structure.
        wander: size of the wandering error of the fixes.
        wander_poses: correlation length of the wandering error in poses.
    """

    size: float
    wander: float
    wander_poses: float

    @property
    def structure(self) -> float:
        """Size of the part that depends on the machine's joints."""
        return float(np.sqrt(self.size**2 - self.wander**2))


def draw_unknown(rng: np.random.Generator) -> UnknownDraw:
    """Draw the sizes of a machine's unknown structure."""
    size = float(rng.uniform(*UNKNOWN))
    wander = size * float(np.sqrt(rng.uniform(*WANDER_SHARE)))
    return UnknownDraw(size, wander, float(rng.uniform(*WANDER_POSES)))


def draw_machine(
    scene: Scene, visibility: Visibility, sizes: UnknownDraw, seed: int
) -> tuple[tuple[HiddenEffect, ...], tuple[Effect, ...]]:
    """Draw the hidden effects and the unknown structure of a scene.

    Args:
        scene: the scene, with the wandering error in its noise.
        visibility: visible part of displacements in the scene.
        sizes: sizes of the unknown structure.
        seed: the same seed gives the same result.

    Returns:
        The hidden effects, each with the visible size that it has alone, and the effects that form the unknown
        structure.

    Raises:
        UnreachableError: the rig does not have six families with ten effects that are visible together.
    """
    rng = np.random.default_rng([seed, 60])
    basis = MachineBasis(scene, visibility)
    unknown = _unknown(scene, visibility, basis, sizes.structure, rng)
    hidden = _effects(scene, visibility, basis, rng)
    separable = basis.separable([h.effect for h in hidden], sizes.structure)
    return tuple(replace(h, separable=told) for h, told in zip(hidden, separable, strict=True)), unknown


def _unknown(
    scene: Scene, visibility: Visibility, basis: MachineBasis, size: float, rng: np.random.Generator
) -> tuple[Effect, ...]:
    """Draw a structure with this total visible size, split at random between its parts."""

    def seed() -> int:
        return int(rng.integers(1 << 31))

    def joint_error(joint: str) -> Callable[[], Effect]:
        return lambda: JointPairError(joint, seed=seed())

    def lean() -> Effect:
        x, y = (5e-9 * np.exp(rng.normal(0.0, _UNEVEN, 2))).tolist()
        return JackLean(x_rad_per_Nm=x, y_rad_per_Nm=y, softer=float(rng.uniform(-0.8, 0.8)))

    joints = rng.permutation(np.array(scene.truth.rig.joint_names))[: int(rng.integers(*_PAIR_ERRORS))].tolist()
    kinds = [*(joint_error(joint) for joint in joints), lambda: PlacePairError(seed=seed())]
    kinds += [lean] if scene.truth.rig.masses else []
    parts = [_undescribed(scene, basis, draw) for draw in kinds]
    shares = rng.dirichlet(np.full(len(parts), 4.0))
    parts = [
        _sized(scene, visibility, part, size * float(np.sqrt(share))) for part, share in zip(parts, shares, strict=True)
    ]
    together = visibility.size(scene.displacement_mm(parts))
    return tuple(_scaled(part, size / together) for part in parts)


def _undescribed(scene: Scene, basis: MachineBasis, draw: Callable[[], Effect]) -> Effect:
    """Draw a part of the unknown structure that no single effect of the library describes."""
    for _ in range(_TRIALS):
        drawn = draw()
        if basis.described(scene.displacement_mm([drawn])) <= _DESCRIBED:
            return drawn
    raise UnreachableError(f"{drawn.family}: every draw is described by an effect of the library")


def _sized(scene: Scene, visibility: Visibility, part: Effect, size: float) -> Effect:
    return _scaled(part, size / visibility.size(scene.displacement_mm([part])))


def _scaled(part: Effect, factor: float) -> Effect:
    return Bounded(part, np.inf).scaled(factor)


def _effects(
    scene: Scene, visibility: Visibility, basis: MachineBasis, rng: np.random.Generator
) -> tuple[HiddenEffect, ...]:
    """Draw ten effects of six families, each visible in the presence of the others."""
    known = np.array([name for name in LIBRARY if scene.draws.places(name)])
    for _ in range(_TRIALS):
        hidden: list[HiddenEffect] = []
        for count in _PLACES[int(rng.integers(len(_PLACES)))]:
            taken = {h.effect.family for h in hidden}
            for family in rng.permutation(known).tolist():
                if family in taken or len(scene.draws.places(family)) < count:
                    continue
                further = _of_family(scene, visibility, basis, family, count, hidden, rng)
                if len(further) == count:
                    hidden += further
                    break
            else:
                break
        else:
            return tuple(hidden)
    raise UnreachableError("found no ten effects of six families that are visible together")


def _of_family(
    scene: Scene,
    visibility: Visibility,
    basis: MachineBasis,
    family: str,
    count: int,
    before: Sequence[HiddenEffect],
    rng: np.random.Generator,
) -> list[HiddenEffect]:
    """Draw effects of one family at `count` places, or fewer if not all are visible in addition to `before`."""
    found: list[HiddenEffect] = []
    for place in rng.permutation(np.array(scene.draws.places(family))).tolist():
        if len(found) == count:
            break
        size = float(np.exp(rng.uniform(*np.log(SIZES))))
        drawn = _reached(size, scene, scene.draws.draw(family, place, rng), visibility)
        if drawn.size < SIZES[0]:
            continue
        beside = basis.beside([h.effect for h in (*before, *found, drawn)])
        if min(beside) >= SIZES[0]:
            found.append(drawn)
    return found


def _reached(size: float, scene: Scene, drawn: Bounded, visibility: Visibility) -> HiddenEffect:
    """Return an effect of the given visible size, or as close to it as its hard bounds allow."""
    plausible = visibility.size(scene.displacement_mm([drawn.effect]))
    effect = drawn.scaled(min(size / plausible, drawn.most) if plausible > 0.0 else drawn.most)
    return HiddenEffect(effect, visibility.size(scene.displacement_mm([effect])))
