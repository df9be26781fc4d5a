"""Effects: selected variants, fitted effects, and their application to observations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Family, FittedCoefficient, JointFamily, PrismFamily, Settings
from calibration.effects.columns import NO_JOINT, EffectColumns
from calibration.effects.context import EffectContext
from calibration.effects.library import library
from calibration.effects.regime import Regime
from calibration.kinematics.chain import Chain
from calibration.observations import Floats, Observations

_CHANCE = 2.0  # standard errors


@dataclass(frozen=True)
class FittedEffect:
    """A fitted effect of a model.

    Attributes:
        family, where: family of the effect, and its place.
        coefficients: fitted coefficients in the family's order, with standard errors; see `reported` for output.
        settings: settings of the variant.
        regime: the rows in which the effect acts; None for all.
    """

    family: str
    where: str
    coefficients: tuple[FittedCoefficient, ...]
    settings: Settings = field(default_factory=dict)
    regime: Regime | None = None

    def __str__(self) -> str:
        return f"{self.family}@{self.where}"

    def as_dict(self) -> dict[str, object]:
        """Return the JSON object (docs/reference/formats.md, gap), with the form and settings of the variant."""
        return {
            "family": self.family,
            "where": self.where,
            "coefficients": {
                c.name: {"value": c.value, "unit": c.unit, "standard_error": c.standard_error} for c in self.reported
            },
            "form": self.form,
            "settings": dict(self.settings),
            "regime": None if self.regime is None else self.regime.as_dict(),
        }

    @property
    def form(self) -> str:
        """Phrase that describes variant and regime; empty for a plain effect."""
        form = library()[self.family].form(self.settings)
        return ", ".join(text for text in (form, self.regime.text if self.regime else "") if text)

    @property
    def reported(self) -> tuple[FittedCoefficient, ...]:
        """The numbers to report in outputs."""
        return library()[self.family].reported(self.settings, self.coefficients)


@dataclass(frozen=True)
class Choice:
    """One variant of an effect at one place, before a fit.

    Attributes:
        family, where: family of the effect, and its place.
        settings: settings of the variant.
        scale: factor on the plausible sizes of the coefficients, selected by the data.
        regime: the rows in which the effect acts; None for all.
    """

    family: str
    where: str
    settings: Settings
    scale: float = 1.0
    regime: Regime | None = None

    def __str__(self) -> str:
        return f"{self.family}@{self.where}"

    def columns(self, context: EffectContext) -> EffectColumns:
        """Return the effect's columns for the observations of a context."""
        family = library()[self.family]
        found = family.coefficients(context, self.where, self.settings)
        column, shift = _moves(family, context, self)
        return EffectColumns(
            tuple(f"{self}:{c.name}" for c in found),
            np.full(len(found), _joint(family, context.chain, self.where)),
            column,
            np.array([c.sigma * self.scale for c in found]),
            shift,
        )

    def fitted(self, context: EffectContext, values: Floats, standard_errors: Floats) -> FittedEffect:
        """Return the effect with fitted coefficients.

        Args:
            context: the observations.
            values: (k,) fitted coefficients.
            standard_errors: (k,) standard errors.
        """
        found = library()[self.family].coefficients(context, self.where, self.settings)
        coefficients = tuple(
            FittedCoefficient(c.name, c.unit, float(value), float(error), c.sigma)
            for c, value, error in zip(found, values, standard_errors, strict=True)
        )
        return FittedEffect(self.family, self.where, coefficients, dict(self.settings), self.regime)

    def beyond_limits(self, context: EffectContext, values: Floats, standard_errors: Floats) -> tuple[str, ...]:
        """Return the names of the coefficients that exceed their hard limits significantly.

        Coefficients that only shape an effect are not reported and not checked here; see `has_implausible_shape`.

        Args:
            context: the observations.
            values: (k,) fitted coefficients.
            standard_errors: (k,) standard errors.
        """
        family = library()[self.family]
        limits = {c.name: c for c in family.coefficients(context, self.where, self.settings)}
        out = []
        for c in self.fitted(context, values, standard_errors).reported:
            limit = limits.get(c.name)
            if limit is None:
                continue
            over, at = max((limit.lower - c.value, limit.lower), (c.value - limit.upper, limit.upper))
            if over > _CHANCE * math.hypot(c.standard_error, family.limit_sigma * at):
                out.append(c.name)
        return tuple(out)

    def has_implausible_shape(self, values: Floats, standard_errors: Floats) -> bool:
        """Return True if coefficients that only shape the effect are implausible; see the method of `Family`."""
        return library()[self.family].has_implausible_shape(self.settings, values, standard_errors)


class AppliedEffects:
    """The effects of a model, prepared for any observations of its rig.

    An effect is zero in rows that lack its inputs.

    Args:
        effects: the effects, with k coefficients in total.
        chain: the kinematics.

    Attributes:
        names: `family@where:name` of each of the k coefficients.
        joint: (k,) index of the joint that each coefficient changes, `NO_JOINT` for none.
        values: (k,) values of the coefficients.
        machine_values: (k,) the same, but 0 for effects that do not move prisms in the base frame.
        depends_on_order: True if the change in a row depends on the preceding rows.
    """

    def __init__(self, effects: Sequence[FittedEffect], chain: Chain) -> None:
        ends = list(accumulate((len(effect.coefficients) for effect in effects), initial=0))
        self._parts = [(library()[effect.family], effect, slice(*ends[i : i + 2])) for i, effect in enumerate(effects)]
        at = [_joint(family, chain, effect.where) for family, effect, _ in self._parts]
        of_machine = [family.moves_machine for family, _, _ in self._parts]
        self.names = tuple(f"{e.family}@{e.where}:{c.name}" for e in effects for c in e.coefficients)
        self.joint = np.repeat(np.array(at, dtype=np.intp), np.diff(ends))
        self.values = coefficient_values(effects)
        self.machine_values = self.values * np.repeat(np.array(of_machine, dtype=bool), np.diff(ends))
        self.depends_on_order = any(family.depends_on_order(effect.settings) for family, effect, _ in self._parts)
        self._joints = len(chain.joint_index)
        self._prior_sigma = np.array([c.prior_sigma for effect in effects for c in effect.coefficients])
        self._shifts = bool((self.joint == NO_JOINT).any())
        # Effects whose inputs may be missing. Their variance in such rows does not depend on the rows.
        self._unknown = [
            (effect, joint, _unknown_variance(effect))
            for (family, effect, _), joint in zip(self._parts, at, strict=True)
            if family.needs(effect.where) or effect.regime is not None
        ]

    def columns(self, context: EffectContext) -> EffectColumns:
        """Return the columns of all effects for the n observations of a context."""
        column = np.zeros((len(context), len(self.joint)))
        shift_mm = np.zeros((len(context), 3, len(self.joint))) if self._shifts else None
        for family, effect, own in self._parts:
            moved, shifted = _moves(family, context, effect)
            column[:, own] = moved
            if shift_mm is not None and shifted is not None:
                shift_mm[:, :, own] = shifted
        return EffectColumns(self.names, self.joint, column, self._prior_sigma, shift_mm)

    def unknown_variance(self, context: EffectContext) -> Floats:
        """Return the variance (n, joints) of joint values in rows that lack inputs of an effect, deg^2 or mm^2."""
        out = np.zeros((len(context), self._joints))
        for effect, joint, variance in self._unknown:
            known = _known(effect, context)
            if joint != NO_JOINT and not known.all():
                out[~known, joint] += variance
        return out

    def unknown_mm2(self, context: EffectContext) -> Floats:
        """Return the variance (n,) per coordinate in rows that lack inputs of an effect on the prism, mm^2."""
        out = np.zeros(len(context))
        for effect, joint, variance in self._unknown:
            if joint == NO_JOINT:
                out[~_known(effect, context)] += variance
        return out


def fitted_columns(effects: Sequence[FittedEffect], context: EffectContext) -> EffectColumns:
    """Return the columns of a model's effects for the observations of a context."""
    return AppliedEffects(effects, context.chain).columns(context)


def coefficient_values(effects: Sequence[FittedEffect]) -> Floats:
    """Return the values (k,) of all coefficients, in the order of `fitted_columns`."""
    return np.array([c.value for effect in effects for c in effect.coefficients])


def corrected(observations: Observations, change: Floats, names: Sequence[str]) -> Observations:
    """Return observations with a change added to the readings.

    Args:
        observations: n rows.
        change: (n, joints) change, deg or mm.
        names: names of the joints, in the order of the columns of `change`.
    """
    joints: Mapping[str, Floats] = {name: observations.joints[name] + change[:, i] for i, name in enumerate(names)}
    return replace(observations, joints=joints)


def missing_inputs(effects: Sequence[FittedEffect], context: EffectContext) -> tuple[str, ...]:
    """Return a sentence for every effect whose inputs are missing in some of these observations."""
    sentences = []
    for effect in effects:
        needs = library()[effect.family].needs(effect.where) or (effect.regime.variable if effect.regime else "")
        lacking = int((~_known(effect, context)).sum())
        if lacking:
            rows = "" if lacking == len(context) else f" in {lacking} of {len(context)} rows"
            sentences.append(f"{effect.family}@{effect.where} is left out{rows}: this data lacks {needs}")
    return tuple(sentences)


def _unknown_variance(effect: FittedEffect) -> float:
    """Return the mean squared effect in rows that lack its inputs, deg^2 or mm^2."""
    values = np.array([c.value for c in effect.coefficients])
    plausible = np.array([c.prior_sigma for c in effect.coefficients])
    return library()[effect.family].unknown_variance(values, plausible, effect.settings)


def _joint(family: Family, chain: Chain, where: str) -> int:
    return chain.joint_index[where] if isinstance(family, JointFamily) else NO_JOINT


def _known(effect: FittedEffect, context: EffectContext) -> NDArray[np.bool_]:
    """Return an (n,) mask of the rows in which all inputs of an effect are known."""
    known = library()[effect.family].known(context, effect.where)
    return known if effect.regime is None else known & effect.regime.known(context)


def _moves(family: Family, context: EffectContext, effect: Choice | FittedEffect) -> tuple[Floats, Floats | None]:
    """Return (n, k) columns at the joint, and (n, 3, k) prism displacements, or None for an effect at a joint."""
    acts = None if effect.regime is None else effect.regime.holds(context).astype(np.float64)
    if isinstance(family, JointFamily):
        column = family.columns(context, effect.where, effect.settings)
        return column if acts is None else column * acts[:, None], None
    assert isinstance(family, PrismFamily)  # the only other kind
    shift = family.shift_mm(context, effect.where, effect.settings)
    return np.zeros((len(context), shift.shape[2])), shift if acts is None else shift * acts[:, None, None]
