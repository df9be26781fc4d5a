"""Effects that a plan is to tell apart, each reduced to the few coefficients that matter."""

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

_LEFT = 1e-3  # of the mean square of what an effect may do; no fix shows the curves that make up less
_MOST = 12  # coefficients: a curve of many has its broad features in the first
_CHANGES = 0.05  # of what an effect moves, RMS
_ROWS = 1000  # that its coefficients are found from
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True)
class Alternative:
    """One effect at one place.

    Attributes:
        name: `family@where`.
        choices: the variants that it may take; they have c coefficients together.
        weights: of the variants beforehand, their sum 1.
        mixing: (c, k) what these do is that of k <= c coefficients, independent and of size 1: `mixing` takes unit
            directions of the c in prior sigmas onto them.
        found: (k,) their values; zero where none were found.
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
        """Reduce an effect to the coefficients that matter in some observations: its variants repeat each other.

        Args:
            name: `family@where`.
            choices: the variants that it may take.
            context: the observations.
            found: (c,) values of the coefficients, where there are any.

        Raises:
            DataError: it does nothing in any of them.
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
    def goes_by_travel(self) -> bool:
        """True if it grows with the path of its joint."""
        return library()[self.choices[0].family].goes_by_travel

    def moved_mm(self, context: EffectContext) -> Floats:
        """(n, 3, k) displacements by its coefficients: as found, or each of unit size where none were found."""
        moved = self.columns(context).moved_mm(context.to_station(context.located.joint_jacobian))
        return moved * (self.found if self.found.any() else 1.0)

    def columns(self, context: EffectContext) -> EffectColumns:
        """Return the effect's columns for the observations of a context, one for each of its k coefficients."""
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
    """`family@where`."""
    return effect if isinstance(effect, str) else f"{effect.family}@{effect.where}"


def conditions_of(knowledge: Knowledge, effect: str, readings: Floats, conditions: Conditions) -> tuple[str, ...]:
    """Name the conditions without which an effect is not known.

    Args:
        knowledge: of the rig.
        effect: `family@where`.
        readings: (n, joints) poses.
        conditions: all that may be chosen for them.

    Raises:
        DataError: it needs something that no condition gives.
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
    """Prepare an effect, in all its variants or as it was found, for poses (n, joints).

    Raises:
        DataError: no pose shows it.
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
    """Find which of several effects change with each kind of condition, by computing their displacements.

    Args:
        knowledge: of the rig.
        effects: that these poses show.
        readings: (n, joints) poses.
        conditions: all that may be chosen for them.

    Returns:
        Names of the conditions that change together -> `family@where` of the effects that change with them.
    """
    alternatives = [alternative_of(knowledge, effect, readings, conditions) for effect in effects]
    before, found = knowledge.context(readings, conditions), {}

    def is_changed(alternative: Alternative, after: EffectContext) -> bool:
        was, is_now = alternative.moved_mm(before), alternative.moved_mm(after)
        return float(np.linalg.norm(is_now - was)) > _CHANGES * float(np.linalg.norm(was))

    for kind in kinds_of(knowledge.chain.rig):
        after = knowledge.context(readings, changed(conditions, kind))
        # A path goes on with the poses, and not with the hours between them.
        asked = [alternative for alternative in alternatives if kind != ("time_s",) or not alternative.goes_by_travel]
        found[kind] = tuple(alternative.name for alternative in asked if is_changed(alternative, after))
    return found


def joined_columns(alternatives: tuple[Alternative, ...], context: EffectContext) -> EffectColumns:
    """Join the coefficients of all alternatives, one after the other."""
    return joined([alternative.columns(context) for alternative in alternatives], len(context))


def _scaled(choice: Choice, context: EffectContext, weight: float) -> EffectColumns:
    """A variant with coefficients of size 1, as plausible as it is among the others."""
    raw = choice.columns(context)
    sigma = raw.prior_sigma * math.sqrt(weight)
    shift = None if raw.shift_mm is None else raw.shift_mm * sigma
    return replace(raw, column=raw.column * sigma, prior_sigma=np.ones(len(raw)), shift_mm=shift)


def _spread(rows: int) -> NDArray[np.intp]:
    """Rows spread evenly, in their order, in no step with the prisms."""
    if rows <= _ROWS:
        return np.arange(rows)
    return np.unique((rows * (np.arange(_ROWS) * _GOLDEN % 1.0)).astype(np.intp))


def _flat(columns: EffectColumns) -> Floats:
    """(3 n, k) displacements; no rows where there are none."""
    if columns.shift_mm is None:
        return np.empty((0, len(columns)))
    return columns.shift_mm.reshape(-1, len(columns))
