"""Machines as they are met: ten effects of six families at once, beside smooth structure that no library names.

The unknown structure is errors of joints and displacements of the last frame that pairs of joints decide, a carrier
that leans on its jacks, and an error of the fixes that wanders. Effects are drawn so that no hidden effect is one that
the others together imitate.
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

SIZES = LEAST_IN_MACHINE, 15.0  # visible size of each effect, in units of the noise
UNKNOWN = 3.0, 8.0  # visible size of the unknown structure together, likewise
WANDER_SHARE = 0.05, 0.2  # of the square of that, in the error that wanders
WANDER_POSES = 10.0, 40.0  # over which it forgets
# Places of each of six families: ten effects.
_PLACES = ((5, 1, 1, 1, 1, 1), (4, 2, 1, 1, 1, 1), (3, 3, 1, 1, 1, 1), (3, 2, 2, 1, 1, 1), (2, 2, 2, 2, 1, 1))
_UNEVEN = 1.0  # spread of the logarithm of the softness of the jacks, about either axis
_PAIR_ERRORS = 2, 4  # joints that err with a pair of joints, from and below
_TRIALS = 20  # of a structure, until no effect of the library describes it, and of a set of effects
_DESCRIBED = 0.5  # of the square of what shows of a structure: an effect that takes more describes it


@dataclass(frozen=True)
class UnknownDraw:
    """Sizes of the unknown structure of a machine, in units of the noise.

    Attributes:
        size: of all together.
        wander: of the part that is an error of the fixes.
        wander_poses: over which that forgets.
    """

    size: float
    wander: float
    wander_poses: float

    @property
    def structure(self) -> float:
        """Size of the part that the machine's joints decide."""
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
        scene: the data, with the error that wanders in its noise.
        visibility: of displacements in it.
        sizes: of the unknown structure.
        seed: the same seed draws the same.

    Returns:
        The hidden effects, each with its visible size on its own, and the effects that make up the unknown structure.

    Raises:
        UnreachableError: the rig has no six families of which ten effects can be seen beside each other.
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
    """Draw structure of this visible size together, each part of some share of it."""

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
    raise UnreachableError(f"{drawn.family}: an effect of the library describes it")


def _sized(scene: Scene, visibility: Visibility, part: Effect, size: float) -> Effect:
    return _scaled(part, size / visibility.size(scene.displacement_mm([part])))


def _scaled(part: Effect, factor: float) -> Effect:
    return Bounded(part, np.inf).scaled(factor)


def _effects(
    scene: Scene, visibility: Visibility, basis: MachineBasis, rng: np.random.Generator
) -> tuple[HiddenEffect, ...]:
    """Draw ten effects of six families, each seen beside the others."""
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
    raise UnreachableError("no ten effects of six families are seen beside each other")


def _of_family(
    scene: Scene,
    visibility: Visibility,
    basis: MachineBasis,
    family: str,
    count: int,
    before: Sequence[HiddenEffect],
    rng: np.random.Generator,
) -> list[HiddenEffect]:
    """Draw effects of one family at `count` places, fewer where not so many are seen beside those before."""
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
    """Return an effect of a visible size, or as near to it as its hard bounds allow."""
    plausible = visibility.size(scene.displacement_mm([drawn.effect]))
    effect = drawn.scaled(min(size / plausible, drawn.most) if plausible > 0.0 else drawn.most)
    return HiddenEffect(effect, visibility.size(scene.displacement_mm([effect])))
