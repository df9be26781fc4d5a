"""Effects as a fit found them, and what they do to the readings of observations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate

import numpy as np

from calibration.effects.base import Settings, Situation
from calibration.effects.library import library
from calibration.identification.additions import Additions
from calibration.kinematics import Chain
from calibration.observations import Floats, Observations

_CHANCE = 2.0  # standard errors


@dataclass(frozen=True)
class FittedCoefficient:
    """One number that a fit found.

    Attributes:
        name, unit: as the family's `Coefficient`.
        value, standard_error: posterior.
        prior_sigma: plausible size the fit used.
    """

    name: str
    unit: str
    value: float
    standard_error: float
    prior_sigma: float


@dataclass(frozen=True)
class FittedEffect:
    """An effect that a model has.

    Attributes:
        family, where: which effect it is and the place it is at.
        coefficients: in the family's order.
        settings: the numbers of its variant.
    """

    family: str
    where: str
    coefficients: tuple[FittedCoefficient, ...]
    settings: Settings = field(default_factory=dict)

    def as_dict(self) -> dict[str, object]:
        """The contract's JSON object, with the numbers of the variant added."""
        return {
            "family": self.family,
            "where": self.where,
            "coefficients": {
                c.name: {"value": c.value, "unit": c.unit, "standard_error": c.standard_error}
                for c in self.coefficients
            },
            "settings": dict(self.settings),
        }


@dataclass(frozen=True)
class Choice:
    """One variant of an effect at one place, before a fit."""

    family: str
    where: str
    settings: Settings

    def __str__(self) -> str:
        return f"{self.family}@{self.where}"

    def additions(self, situation: Situation) -> Additions:
        """Its coefficients, for the observations of a situation."""
        found = library()[self.family].coefficients(situation, self.where, self.settings)
        return _additions(
            self.family, self.where, self.settings, [c.name for c in found], [c.sigma for c in found], situation
        )

    def fitted(self, situation: Situation, values: Floats, standard_errors: Floats) -> FittedEffect:
        """As a fit found it; arrays (k,)."""
        found = library()[self.family].coefficients(situation, self.where, self.settings)
        coefficients = tuple(
            FittedCoefficient(c.name, c.unit, float(value), float(error), c.sigma)
            for c, value, error in zip(found, values, standard_errors, strict=True)
        )
        return FittedEffect(self.family, self.where, coefficients, dict(self.settings))

    def beyond(self, situation: Situation, values: Floats, standard_errors: Floats) -> tuple[str, ...]:
        """Names of the coefficients (k,) that are beyond their hard limits by more than chance."""
        found = library()[self.family].coefficients(situation, self.where, self.settings)
        return tuple(
            c.name
            for c, value, error in zip(found, values, standard_errors, strict=True)
            if not c.lower - _CHANCE * error <= value <= c.upper + _CHANCE * error
        )


def joined(parts: Sequence[Additions], rows: int) -> Additions:
    """All coefficients of several effects, for `rows` observations."""
    return Additions(
        tuple(name for part in parts for name in part.names),
        np.concatenate([np.empty(0, dtype=np.intp), *(part.joint for part in parts)]),
        np.hstack([np.empty((rows, 0)), *(part.column for part in parts)]),
        np.concatenate([np.empty(0), *(part.prior_sigma for part in parts)]),
    )


class AppliedEffects:
    """A model's effects, prepared for any observations of its rig.

    An effect does nothing in rows that lack what it needs.

    Args:
        effects: with k coefficients together.
        chain: whose joints they are at.

    Attributes:
        joint: (k,) index of the joint that each coefficient changes.
    """

    def __init__(self, effects: Sequence[FittedEffect], chain: Chain) -> None:
        ends = list(accumulate((len(effect.coefficients) for effect in effects), initial=0))
        self._parts = [(library()[effect.family], effect, slice(*ends[i : i + 2])) for i, effect in enumerate(effects)]
        at = [chain.joint_index[effect.where] for effect in effects]
        self.joint = np.repeat(np.array(at, dtype=np.intp), np.diff(ends))
        self._by_joint = np.zeros((ends[-1], len(chain.joint_index)))
        self._by_joint[np.arange(ends[-1]), self.joint] = coefficient_values(effects)
        # Most effects lack nothing ever; what the others leave open does not depend on the rows.
        self._unknown = [
            (family, effect.where, joint, _left_open(effect))
            for (family, effect, _), joint in zip(self._parts, at, strict=True)
            if family.needs(effect.where)
        ]

    def columns(self, situation: Situation) -> Floats:
        """(n, k) change of each coefficient's joint, deg or mm, per unit of the coefficient."""
        out = np.empty((len(situation), len(self.joint)))
        for family, effect, own in self._parts:
            out[:, own] = family.columns(situation, effect.where, effect.settings)
        return out

    def change(self, columns: Floats) -> Floats:
        """(n, joints) by what the coefficients with these columns change the joints, deg or mm."""
        change: Floats = columns @ self._by_joint
        return change

    def unknown_variance(self, situation: Situation) -> Floats:
        """(n, joints) variance of the joints' values in rows that lack what an effect needs, deg^2 or mm^2."""
        out = np.zeros((len(situation), self._by_joint.shape[1]))
        for family, where, joint, variance in self._unknown:
            known = family.known(situation, where)
            if not known.all():
                out[~known, joint] += variance
        return out


def fitted_additions(effects: Sequence[FittedEffect], situation: Situation) -> Additions:
    """The coefficients of a model's effects, for other observations."""
    applied = AppliedEffects(effects, situation.chain)
    return Additions(
        tuple(f"{effect.family}@{effect.where}:{c.name}" for effect in effects for c in effect.coefficients),
        applied.joint,
        applied.columns(situation),
        np.array([c.prior_sigma for effect in effects for c in effect.coefficients]),
    )


def coefficient_values(effects: Sequence[FittedEffect]) -> Floats:
    """(k,) values of all coefficients, in the order of `fitted_additions`."""
    return np.array([c.value for effect in effects for c in effect.coefficients])


def corrected(observations: Observations, change: Floats, names: Sequence[str]) -> Observations:
    """Observations with a change (n, joints) added to the readings of the joints called `names`."""
    joints: Mapping[str, Floats] = {name: observations.joints[name] + change[:, i] for i, name in enumerate(names)}
    return replace(observations, joints=joints)


def left_out(effects: Sequence[FittedEffect], situation: Situation) -> tuple[str, ...]:
    """A sentence for every effect that some of these observations lack something for."""
    sentences = []
    for effect in effects:
        family = library()[effect.family]
        lacking = int((~family.known(situation, effect.where)).sum())
        if lacking:
            rows = "" if lacking == len(situation) else f" in {lacking} of {len(situation)} rows"
            sentences.append(
                f"{effect.family}@{effect.where} is left out{rows}: this data lacks {family.needs(effect.where)}"
            )
    return tuple(sentences)


def _left_open(effect: FittedEffect) -> float:
    """Mean square of what an effect does to its joint where what it needs is not known, deg^2 or mm^2."""
    values = np.array([c.value for c in effect.coefficients])
    plausible = np.array([c.prior_sigma for c in effect.coefficients])
    return library()[effect.family].unknown_variance(values, plausible, effect.settings)


def _additions(
    family: str, where: str, settings: Settings, names: Sequence[str], sigma: Sequence[float], situation: Situation
) -> Additions:
    return Additions(
        tuple(f"{family}@{where}:{name}" for name in names),
        np.full(len(names), situation.rig.joint_names.index(where)),
        library()[family].columns(situation, where, settings),
        np.array(sigma),
    )
