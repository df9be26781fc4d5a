"""Candidates: every effect of the library at every place where the data can reveal it, with its prior probability.

A priori all families are equally probable, and all places of a family: an effect that a rig may have at seven joints
is tried seven times, which must not favour it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calibration.effects.columns import EffectColumns, same_columns, sharing
from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice
from calibration.effects.library import library
from calibration.gap.projected.projection import Projection
from calibration.gap.projected.rare_columns import without_zeros
from calibration.observations import Floats


@dataclass(frozen=True)
class CandidateEffect:
    """An effect at one place of the machine, in all its variants.

    Attributes:
        family, where: family of the effect, and its place: a joint, prism, `boom`, `base`, `station` or `clock`.
        options: the o variants at this place.
        additions: columns of each variant for the samples.
        log_odds: (o,) log prior probability of each variant, given the candidate.
        log_prior: log prior probability of the candidate among all candidates.
    """

    family: str
    where: str
    options: tuple[Choice, ...]
    additions: tuple[EffectColumns, ...]
    log_odds: Floats
    log_prior: float

    def __str__(self) -> str:
        return f"{self.family}@{self.where}"

    @cached_property
    def first_equal(self) -> tuple[int, ...]:
        """(o,) for each variant the index of the first one with equal columns; the two differ only in their priors."""
        every = self.additions
        return tuple(
            next((k for k in range(n) if every[k].sums == own.sums and same_columns(every[k], own)), n)
            for n, own in enumerate(every)
        )


@dataclass(frozen=True)
class CandidateEffects:
    """Candidate effects of the library, and the reasons why other families are excluded.

    Attributes:
        candidates: effects that the data can reveal.
        disabled: family -> reason for its exclusion.
    """

    candidates: tuple[CandidateEffect, ...]
    disabled: Mapping[str, str]


def candidate_effects(
    context: EffectContext,
    over: Projection,
    families: Collection[str],
    without: Collection[str] = (),
    like: Sequence[CandidateEffect] = (),
) -> CandidateEffects:
    """Return the candidates of the given families.

    Args:
        context: context of the observations.
        over: the projection whose samples the columns are for.
        families: names of families in the library.
        without: `family@where` of the effects that are already in the model.
        like: candidates of an earlier fit, most of whose columns can be reused.
    """
    found, disabled = _possible(context, families, without)
    alike = {(c.family, c.where): c for c in like}
    log_prior = _log_priors([name for name, _, _ in found], {name.partition("@")[0] for name in without})
    return CandidateEffects(
        tuple(
            candidate_at(context, over, name, where, choices, log_prior[name], alike.get((name, where)))
            for name, where, choices in found
        ),
        disabled,
    )


def each_candidate(
    context: EffectContext, over: Projection, families: Collection[str], like: Sequence[CandidateEffect] = ()
) -> Iterator[CandidateEffect]:
    """Yield the candidates of the given families one at a time, as all together take gigabytes for thousands of fixes.

    Arguments are those of `candidate_effects`.
    """
    found, _ = _possible(context, families, ())
    alike = {(c.family, c.where): c for c in like}
    log_prior = _log_priors([name for name, _, _ in found], ())
    for name, where, choices in found:
        yield candidate_at(context, over, name, where, choices, log_prior[name], alike.get((name, where)))


def _possible(
    context: EffectContext, families: Collection[str], without: Collection[str]
) -> tuple[list[tuple[str, str, tuple[Choice, ...]]], dict[str, str]]:
    """Return (family, place, variants) of each effect that the data can reveal, and family -> reason of exclusion."""
    found: list[tuple[str, str, tuple[Choice, ...]]] = []
    disabled: dict[str, str] = {}
    for name in sorted(families):
        family = library()[name]
        places = family.places(context.rig)
        known = [where for where in places if family.known(context, where).mean() >= family.least_known]
        here = [(name, where, variants_at(context, name, where)) for where in known if f"{name}@{where}" not in without]
        if not places:
            disabled[name] = f"rig {context.rig.name!r} has no place for it"
        elif not known:
            disabled[name] = f"needs {family.needs(places[0])}"
        elif here and not any(choices for _, _, choices in here):
            disabled[name] = "it has no effect in these poses"
        found += [one for one in here if one[2]]
    return found, disabled


def partly_lacking(context: EffectContext, families: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield family and place of each effect that can be looked for, but whose inputs some rows lack.

    Args:
        context: context of the observations.
        families: names of the families that may be named.
    """
    for name in sorted(families):
        family = library()[name]
        for where in family.places(context.rig):
            if family.least_known <= family.known(context, where).mean() < 1.0:
                yield name, where


def partly_known(context: EffectContext, families: Collection[str]) -> Iterator[str]:
    """Yield a sentence for each input that too few rows have, and also other rows or another place.

    Effects with such inputs are not candidates, and their errors may be attributed to other effects.

    Args:
        context: context of the observations.
        families: names of the families to check.
    """
    lacking: dict[tuple[str, int], list[str]] = {}
    for name in sorted(families):
        family = library()[name]
        known = {where: family.known(context, where) for where in family.places(context.rig)}
        is_elsewhere = "{where}" in family.column and any(rows.any() for rows in known.values())
        for where, rows in known.items():
            if 0.0 < rows.mean() < family.least_known or (is_elsewhere and not rows.any()):
                need = family.needs(where), int(rows.sum())
                lacking.setdefault(need, []).append(f"{name}@{where}")
    for (needs, number), names in lacking.items():
        have = f"{number} of {len(context)} rows have, too few" if number else "no row has"
        yield (
            f"not looked for: {', '.join(names)}; needs {needs}, which {have}: these effects may be reported under a "
            "different name"
        )


def _log_priors(names: Sequence[str], again: Collection[str]) -> dict[str, float]:
    """Return family -> log prior probability of each of its candidates; families of `again` share one half.

    Args:
        names: the family of every candidate.
        again: families that are already in the model.
    """
    count = {name: names.count(name) for name in names}
    twice = sum(name in again for name in count)
    once = len(count) - twice
    share = {
        name: (0.5 / twice if name in again else 0.5 / once) if twice and once else 1.0 / len(count) for name in count
    }
    return {name: math.log(share[name] / number) for name, number in count.items()}


def candidate_at(
    context: EffectContext,
    over: Projection,
    family: str,
    where: str,
    choices: Sequence[Choice],
    log_prior: float = 0.0,
    like: CandidateEffect | None = None,
) -> CandidateEffect:
    """Return the candidate with the given variants; equal columns of `like` are reused.

    Args:
        context: context of the observations.
        over: the projection whose samples the columns are for.
        family: family of the effect.
        where: place of the effect.
        choices: variants of the effect.
        log_prior: log prior probability of the candidate.
        like: the same candidate of an earlier fit.
    """
    odds = np.array([library()[family].odds(choice.settings) for choice in choices])
    return CandidateEffect(
        family,
        where,
        tuple(choices),
        sharing((_columns(choice, context, over, like) for choice in choices), like.additions if like else ()),
        np.log(odds / odds.sum()),
        log_prior,
    )


def _columns(choice: Choice, context: EffectContext, over: Projection, like: CandidateEffect | None) -> EffectColumns:
    """Return the columns of a variant, reusing those of an earlier fit where they do not depend on the fit."""
    if like is not None and choice in like.options and library()[choice.family].depends_on_readings_only:
        return like.additions[like.options.index(choice)]
    return without_zeros(choice.columns(context).over(over.samples.average))


def variants_at(context: EffectContext, family: str, where: str) -> tuple[Choice, ...]:
    """Return the variants of an effect at a place; empty if it cannot occur there."""
    return tuple(Choice(family, where, settings) for settings in library()[family].variants(context, where))
