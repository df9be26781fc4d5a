"""Effects that a plan is to distinguish, each reduced to the few coefficients that matter."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.design.conditions import Conditions, changed, kinds_of, needed
from calibration.design.knowledge import Knowledge
from calibration.effects.columns import EffectColumns, joined
from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice, FittedEffect
from calibration.effects.library import library
from calibration.errors import DataError
from calibration.observations import Floats

_LEFT = 1e-3  # share of an effect's mean square that may be dropped; fixes cannot resolve so small a part
_MOST = 12  # largest number of coefficients; the first ones describe the broad features of a curve
_CHANGES = 0.05  # relative RMS change of the displacement from which on an effect counts as changed
_ROWS = 1000  # rows from which the reduced coefficients are computed
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True)
class Alternative:
    """One effect at one place.

    Attributes:
        name: `family@where`.
        choices: the possible variants, with c coefficients in total.
        weights: prior probabilities of the variants, with sum 1.
        mixing: (c, k) reduction to k <= c independent coefficients of unit prior sigma. Each column is the direction of
            one of them in the c original coefficients, in their prior sigmas.
        found: (k,) fitted values of the reduced coefficients; zero where there is no fit.
    """

    name: str
    choices: tuple[Choice, ...]
    weights: tuple[float, ...]
    mixing: Floats
    found: Floats

    @classmethod
    def of(
        cls, name: str, choices: tuple[Choice, ...], context: EffectContext, found: Floats | None = None
    ) -> Alternative:
        """Reduce an effect to the coefficients that matter in some observations, as its variants overlap.

        Args:
            name: `family@where`.
            choices: the possible variants.
            context: the observations.
            found: (c,) fitted values of the coefficients; None where there is no fit.

        Raises:
            DataError: the effect is zero in all observations.
        """
        odds = [library()[choice.family].odds(choice.settings) for choice in choices]
        weights = tuple(value / sum(odds) for value in odds)
        few = replace(context, observations=context.observations.select(_spread(len(context))))
        parts = [_scaled(choice, few, weight) for choice, weight in zip(choices, weights, strict=True)]
        rows = np.hstack([np.concatenate([part.column, _flat(part)]) for part in parts])
        _, size, directions = np.linalg.svd(np.linalg.qr(rows, mode="r"), full_matrices=False)
        if not size.max(initial=0.0) > 0.0:
            raise DataError(name, f"does nothing in any pose of rig {context.rig.name!r}")
        left = 1.0 - np.cumsum(size**2) / (size**2).sum()
        mixing = directions[: min(_MOST, int((left > _LEFT).sum()) + 1)].T
        values = np.zeros(len(mixing)) if found is None else found / choices[0].columns(few).prior_sigma
        return cls(name, choices, weights, mixing, mixing.T @ values)

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return int(self.mixing.shape[1])

    @property
    def depends_on_travel(self) -> bool:
        """True if the effect grows with the path that its joint travels."""
        return library()[self.choices[0].family].depends_on_travel

    def moved_mm(self, context: EffectContext) -> Floats:
        """(n, 3, k) displacements due to the fitted coefficients, or to unit coefficients where there is no fit."""
        moved = self.columns(context).moved_mm(context.to_station(context.located.joint_jacobian))
        return moved * (self.found if self.found.any() else 1.0)

    def columns(self, context: EffectContext) -> EffectColumns:
        """Return the effect's columns for the observations of a context, one for each of the k coefficients."""
        column, shift = np.zeros((len(context), self.size)), np.zeros((0, self.size))
        first = 0
        for choice, weight in zip(self.choices, self.weights, strict=True):
            part = _scaled(choice, context, weight)
            own = self.mixing[first : first + len(part)]
            first += len(part)
            column += part.column @ own
            if part.shift_mm is not None:
                shift = part.shift_mm @ own if len(shift) == 0 else shift + part.shift_mm @ own
        names = tuple(f"{self.name}:{i}" for i in range(self.size))
        joint = np.repeat(part.joint[:1], self.size)
        return EffectColumns(names, joint, column, np.ones(self.size), shift if len(shift) else None)


def name_of(effect: str | FittedEffect) -> str:
    """Return the name `family@where` of an effect."""
    return effect if isinstance(effect, str) else f"{effect.family}@{effect.where}"


def conditions_of(knowledge: Knowledge, effect: str, readings: Floats, conditions: Conditions) -> tuple[str, ...]:
    """Return the names of the conditions that an effect requires as inputs.

    Args:
        knowledge: knowledge of the rig.
        effect: `family@where`.
        readings: (n, joints) poses.
        conditions: all conditions that may be chosen for the poses.

    Raises:
        DataError: the effect needs an input that no condition provides.
    """
    name, _, where = effect.partition("@")
    family = library()[name]

    def is_known(names: Collection[str]) -> bool:
        context = knowledge.context(readings, {key: conditions[key] for key in names})
        return bool(family.known(context, where).all())

    found = needed(knowledge.chain.rig, is_known)
    if found is None:
        raise DataError(effect, f"needs {family.needs(where)}, which poses alone do not give")
    return found


def alternative_of(
    knowledge: Knowledge, effect: str | FittedEffect, readings: Floats, conditions: Conditions
) -> Alternative:
    """Prepare an effect for poses: all variants of a named effect, or the fitted form of a fitted one.

    Args:
        knowledge: knowledge of the rig.
        effect: `family@where`, or a fitted effect.
        readings: (n, joints) poses, deg or mm.
        conditions: conditions of the poses.

    Raises:
        DataError: the effect is zero in all poses.
    """
    context = knowledge.context(readings, conditions)
    if isinstance(effect, FittedEffect):
        choice = Choice(effect.family, effect.where, effect.settings, regime=effect.regime)
        return Alternative.of(name_of(effect), (choice,), context, np.array([c.value for c in effect.coefficients]))
    name, _, where = effect.partition("@")
    variants = library()[name].variants(context, where)
    if not variants:
        raise DataError(effect, f"does nothing at {where} of rig {knowledge.chain.rig.name!r} in any pose")
    return Alternative.of(effect, tuple(Choice(name, where, settings) for settings in variants), context)


def changing(
    knowledge: Knowledge, effects: Sequence[str | FittedEffect], readings: Floats, conditions: Conditions
) -> Mapping[tuple[str, ...], tuple[str, ...]]:
    """Find which effects change with each kind of condition, by computing their displacements.

    Args:
        knowledge: knowledge of the rig.
        effects: effects that are not zero in these poses.
        readings: (n, joints) poses.
        conditions: all conditions that may be chosen for the poses.

    Returns:
        Names of conditions that change together -> `family@where` of the effects that change with them.
    """
    alternatives = [alternative_of(knowledge, effect, readings, conditions) for effect in effects]
    before, found = knowledge.context(readings, conditions), {}

    def is_changed(alternative: Alternative, after: EffectContext) -> bool:
        was, is_now = alternative.moved_mm(before), alternative.moved_mm(after)
        return float(np.linalg.norm(is_now - was)) > _CHANGES * float(np.linalg.norm(was))

    for kind in kinds_of(knowledge.chain.rig):
        after = knowledge.context(readings, changed(conditions, kind))
        # A joint's path grows with the poses and not with the time between them.
        asked = [
            alternative for alternative in alternatives if kind != ("time_s",) or not alternative.depends_on_travel
        ]
        found[kind] = tuple(alternative.name for alternative in asked if is_changed(alternative, after))
    return found


def joined_columns(alternatives: tuple[Alternative, ...], context: EffectContext) -> EffectColumns:
    """Concatenate the columns of all alternatives, in order."""
    return joined([alternative.columns(context) for alternative in alternatives], len(context))


def _scaled(choice: Choice, context: EffectContext, weight: float) -> EffectColumns:
    """Return a variant's columns in units of the prior sigma, scaled by the root of its prior probability."""
    raw = choice.columns(context)
    sigma = raw.prior_sigma * math.sqrt(weight)
    shift = None if raw.shift_mm is None else raw.shift_mm * sigma
    return replace(raw, column=raw.column * sigma, prior_sigma=np.ones(len(raw)), shift_mm=shift)


def _spread(rows: int) -> NDArray[np.intp]:
    """Return evenly spread row indices in rising order, not in step with the prisms."""
    if rows <= _ROWS:
        return np.arange(rows)
    return np.unique((rows * (np.arange(_ROWS) * _GOLDEN % 1.0)).astype(np.intp))


def _flat(columns: EffectColumns) -> Floats:
    """(3 n, k) displacements of the prisms; no rows where the effect moves joints only."""
    if columns.shift_mm is None:
        return np.empty((0, len(columns)))
    return columns.shift_mm.reshape(-1, len(columns))
