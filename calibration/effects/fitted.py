"""Effects as a fit found them, and what they do to the readings of observations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from calibration.effects.base import Family, FittedCoefficient, JointFamily, PrismFamily, Settings, Situation
from calibration.effects.library import library
from calibration.identification.additions import NO_JOINT, Additions
from calibration.kinematics import Chain
from calibration.observations import Floats, Observations

_CHANCE = 2.0  # standard errors


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
        """The contract's JSON object, with the form and the numbers of the variant added."""
        return {
            "family": self.family,
            "where": self.where,
            "coefficients": {
                c.name: {"value": c.value, "unit": c.unit, "standard_error": c.standard_error} for c in self.reported
            },
            "form": self.form,
            "settings": dict(self.settings),
        }

    @property
    def form(self) -> str:
        """Which of several forms it has, a phrase; empty where that is no news."""
        return library()[self.family].form(self.settings)

    @property
    def reported(self) -> tuple[FittedCoefficient, ...]:
        """What outputs list of the coefficients."""
        return library()[self.family].reported(self.settings, self.coefficients)


@dataclass(frozen=True)
class Choice:
    """One variant of an effect at one place, before a fit.

    Attributes:
        family, where: which effect, and the place it is at.
        settings: the numbers of its variant.
        scale: of the plausible sizes of its coefficients, where the data say that they are larger or smaller.
    """

    family: str
    where: str
    settings: Settings
    scale: float = 1.0

    def __str__(self) -> str:
        return f"{self.family}@{self.where}"

    def additions(self, situation: Situation) -> Additions:
        """Its coefficients, for the observations of a situation."""
        family = library()[self.family]
        found = family.coefficients(situation, self.where, self.settings)
        column, shift = _moves(family, situation, self.where, self.settings)
        return Additions(
            tuple(f"{self}:{c.name}" for c in found),
            np.full(len(found), _joint(family, situation.chain, self.where)),
            column,
            np.array([c.sigma * self.scale for c in found]),
            shift,
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
        """Names of the coefficients (k,) that are beyond their hard limits by more than chance.

        Those that only shape an effect, and are not reported, have none; see `strained`.
        """
        family = library()[self.family]
        limits = {c.name: c for c in family.coefficients(situation, self.where, self.settings)}
        out = []
        for c in self.fitted(situation, values, standard_errors).reported:
            limit = limits.get(c.name)
            if limit is None:
                continue
            over, at = max((limit.lower - c.value, limit.lower), (c.value - limit.upper, limit.upper))
            if over > _CHANCE * math.hypot(c.standard_error, family.limit_sigma * at):
                out.append(c.name)
        return tuple(out)

    def strained(self, values: Floats, standard_errors: Floats) -> bool:
        """Whether coefficients (k,) have what only shapes the effect beyond its limits by more than chance."""
        return library()[self.family].strained(self.settings, values, standard_errors)


class Columns(NamedTuple):
    """What the k coefficients of a model's effects do in n rows.

    Attributes:
        column: (n, k) deg or mm of its joint per unit of each; zero for those that change none.
        shift_mm: (n, 3, k) displacement of the prism in the station's frame beside that; None where none does.
    """

    column: Floats
    shift_mm: Floats | None


class AppliedEffects:
    """A model's effects, prepared for any observations of its rig.

    An effect does nothing in rows that lack what it needs.

    Args:
        effects: with k coefficients together.
        chain: whose joints they are at.

    Attributes:
        joint: (k,) index of the joint that each coefficient changes, -1 for none.
        goes_by_order: whether what they do in a row depends on the rows before it.
    """

    def __init__(self, effects: Sequence[FittedEffect], chain: Chain) -> None:
        ends = list(accumulate((len(effect.coefficients) for effect in effects), initial=0))
        self._parts = [(library()[effect.family], effect, slice(*ends[i : i + 2])) for i, effect in enumerate(effects)]
        at = [_joint(family, chain, effect.where) for family, effect, _ in self._parts]
        self.joint = np.repeat(np.array(at, dtype=np.intp), np.diff(ends))
        self.goes_by_order = any(family.goes_by_order(effect.settings) for family, effect, _ in self._parts)
        self._value = coefficient_values(effects)
        of_machine = [family.moves_machine for family, _, _ in self._parts]
        self._of_machine = self._value * np.repeat(np.array(of_machine, dtype=bool), np.diff(ends))
        self._by_joint = np.zeros((ends[-1], len(chain.joint_index)))
        moving = np.flatnonzero(self.joint != NO_JOINT)
        self._by_joint[moving, self.joint[moving]] = self._value[moving]
        self._shifts = bool((self.joint == NO_JOINT).any())
        # Most effects lack nothing ever; what the others leave open does not depend on the rows.
        self._unknown = [
            (family, effect.where, joint, _left_open(effect))
            for (family, effect, _), joint in zip(self._parts, at, strict=True)
            if family.needs(effect.where)
        ]

    def columns(self, situation: Situation) -> Columns:
        """What unit coefficients do."""
        column = np.zeros((len(situation), len(self.joint)))
        shift_mm = np.zeros((len(situation), 3, len(self.joint))) if self._shifts else None
        for family, effect, own in self._parts:
            moved, shifted = _moves(family, situation, effect.where, effect.settings)
            column[:, own] = moved
            if shift_mm is not None and shifted is not None:
                shift_mm[:, :, own] = shifted
        return Columns(column, shift_mm)

    def change(self, columns: Columns) -> Floats:
        """(n, joints) by what the coefficients with these columns change the joints, deg or mm."""
        change: Floats = columns.column @ self._by_joint
        return change

    def shifted_mm(self, columns: Columns) -> Floats | None:
        """(n, 3) by what they move the prism beside that, in the station's frame; None where none does."""
        return None if columns.shift_mm is None else columns.shift_mm @ self._value

    def machine_shifted_mm(self, columns: Columns) -> Floats | None:
        """(n, 3) that part of it by which prisms move in the base frame; still along the station's axes."""
        return None if columns.shift_mm is None else columns.shift_mm @ self._of_machine

    def unknown_variance(self, situation: Situation) -> Floats:
        """(n, joints) variance of the joints' values in rows that lack what an effect needs, deg^2 or mm^2."""
        out = np.zeros((len(situation), self._by_joint.shape[1]))
        for family, where, joint, variance in self._unknown:
            known = family.known(situation, where)
            if joint != NO_JOINT and not known.all():
                out[~known, joint] += variance
        return out

    def unknown_mm2(self, situation: Situation) -> Floats:
        """(n,) variance of each coordinate in rows that lack what an effect that moves the prism needs, mm^2."""
        out = np.zeros(len(situation))
        for family, where, joint, variance in self._unknown:
            if joint == NO_JOINT:
                out[~family.known(situation, where)] += variance
        return out


def fitted_additions(effects: Sequence[FittedEffect], situation: Situation) -> Additions:
    """The coefficients of a model's effects, for other observations."""
    applied = AppliedEffects(effects, situation.chain)
    columns = applied.columns(situation)
    return Additions(
        tuple(f"{effect.family}@{effect.where}:{c.name}" for effect in effects for c in effect.coefficients),
        applied.joint,
        columns.column,
        np.array([c.prior_sigma for effect in effects for c in effect.coefficients]),
        columns.shift_mm,
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


def _joint(family: Family, chain: Chain, where: str) -> int:
    return chain.joint_index[where] if isinstance(family, JointFamily) else NO_JOINT


def _moves(family: Family, situation: Situation, where: str, settings: Settings) -> tuple[Floats, Floats | None]:
    """(n, k) columns at the joint; (n, 3, k) displacements beside that, None for effects at a joint."""
    if isinstance(family, JointFamily):
        return family.columns(situation, where, settings), None
    assert isinstance(family, PrismFamily)  # there are these two
    shift = family.shift_mm(situation, where, settings)
    return np.zeros((len(situation), shift.shape[2])), shift
