"""Effects hidden in a scene, each as large as the caller wants to see it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulators.effect_draws import Bounded
from simulators.effects.base import Effect
from simulators.scene import Scene

Floats = NDArray[np.float64]

_CLOSE = 0.01  # of the size asked for
_TRIALS = 4


@dataclass(frozen=True)
class Hidden:
    """An effect that was hidden, and how large it shows.

    Attributes:
        effect: it.
        size: by the caller's measure.
    """

    effect: Effect
    size: float


class UnreachableError(ValueError):
    """An effect cannot be seen as large as asked for within its hard bounds, or has no place."""


def hide(
    scene: Scene,
    families: Sequence[str],
    size: float,
    visible: Callable[[Floats], float],
    seed: int,
    *,
    where: Sequence[str | None] = (),
) -> tuple[Hidden, ...]:
    """Draw effects, at places that show them, each as large as the caller wants to see it.

    Args:
        scene: the data to be.
        families: what to hide; the same family twice is at two places.
        size: of each by `visible`.
        visible: what shows of a shift (n, 3) of the training's fixes in mm, as one number that grows with it; whoever
            calls decides what calibration would absorb.
        seed: the same seed draws the same effects.
        where: fixed places, one for each family, None for a random one.

    Raises:
        UnreachableError: no place where the effect could be seen so large within its hard bounds.
        KeyError: no such family.
    """
    rng = np.random.default_rng([seed, 42])
    hidden: list[Hidden] = []
    for number, family in enumerate(families):
        fixed = where[number] if number < len(where) else None
        taken = {h.effect.where for h in hidden if h.effect.family == family}
        places = [p for p in scene.draws.places(family) if p not in taken and fixed in (None, p)]
        if not places:
            raise UnreachableError(f"{family}: this rig has no place for it" + (f" at {fixed}" if fixed else ""))
        for place in rng.permutation(places):
            found = _as_large(scene, scene.draws.draw(family, str(place), rng), size, visible)
            if found is not None:
                hidden.append(found)
                break
        else:
            raise UnreachableError(f"{family}: nowhere is it seen at {size:g} within its hard bounds")
    return tuple(hidden)


def _as_large(scene: Scene, drawn: Bounded, size: float, visible: Callable[[Floats], float]) -> Hidden | None:
    """The effect at the amplitude that shows as `size`; None where that is beyond its bound."""
    factor = 1.0
    for _ in range(_TRIALS):
        effect = drawn.scaled(factor)
        seen = visible(scene.shift_mm([effect]))
        if abs(seen - size) <= _CLOSE * size:
            return Hidden(effect, seen)
        if seen <= 0.0 or (factor == drawn.most and seen < size):
            return None
        factor = min(factor * size / seen, drawn.most)
    return None
