"""Candidates: every effect of the library at every place where these data can show it, with its prior probability.

Beforehand all families are equally likely, and all places of a family: an effect that a rig may have at seven joints is
tried seven times and must not win by that.
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
from calibration.gap.projection import Projection
from calibration.gap.rare_columns import without_zeros
from calibration.observations import Floats

LEAST_KNOWN = 0.5  # share of the rows that have what an effect needs


@dataclass(frozen=True)
class CandidateEffect:
    """An effect at one place of the machine, in all its variants.

    Attributes:
        family, where: which effect, and at which joint, prism, `boom`, `base`, `station` or `clock`.
        options: its o variants at this place.
        additions: displacements of the samples by each variant.
        log_odds: (o,) log prior probability of each variant, given the candidate.
        log_prior: log prior probability of the candidate among all.
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
        """(o,) for each variant the first one with the same columns; the two differ in their prior alone."""
        every = self.additions
        return tuple(
            next((k for k in range(n) if every[k].sums == own.sums and same_columns(every[k], own)), n)
            for n, own in enumerate(every)
        )


@dataclass(frozen=True)
class CandidateEffects:
    """Effects of the library that these data can show, and why the others are none.

    Attributes:
        candidates: effects that these data can show.
        disabled: family -> what the data or the rig lack for it.
    """

    candidates: tuple[CandidateEffect, ...]
    disabled: Mapping[str, str]


def candidate_effects(
    situation: EffectContext,
    over: Projection,
    families: Collection[str],
    without: Collection[str] = (),
    like: Sequence[CandidateEffect] = (),
) -> CandidateEffects:
    """Return the candidates of the given families.

    Args:
        situation: of the observations.
        over: the projection to whose samples the columns belong.
        families: names in the library.
        without: `family@where` of the effects that are in the model already.
        like: candidates about another fit, most of whose columns are the same.
    """
    found, disabled = _possible(situation, families, without)
    alike = {(c.family, c.where): c for c in like}
    log_prior = _log_priors([name for name, _, _ in found], {name.partition("@")[0] for name in without})
    return CandidateEffects(
        tuple(
            candidate_at(situation, over, name, where, choices, log_prior[name], alike.get((name, where)))
            for name, where, choices in found
        ),
        disabled,
    )


def each_candidate(
    situation: EffectContext, over: Projection, families: Collection[str], like: Sequence[CandidateEffect] = ()
) -> Iterator[CandidateEffect]:
    """Yield the candidates of the given families, one at a time: all of them are gigabytes for thousands of fixes.

    Arguments are those of `candidate_effects`.
    """
    found, _ = _possible(situation, families, ())
    alike = {(c.family, c.where): c for c in like}
    log_prior = _log_priors([name for name, _, _ in found], ())
    for name, where, choices in found:
        yield candidate_at(situation, over, name, where, choices, log_prior[name], alike.get((name, where)))


def _possible(
    situation: EffectContext, families: Collection[str], without: Collection[str]
) -> tuple[list[tuple[str, str, tuple[Choice, ...]]], dict[str, str]]:
    """Return family, place and variants of each effect that the data can show; why they cannot show the others."""
    found: list[tuple[str, str, tuple[Choice, ...]]] = []
    disabled: dict[str, str] = {}
    for name in sorted(families):
        family = library()[name]
        places = family.places(situation.rig)
        known = [where for where in places if family.known(situation, where).mean() >= LEAST_KNOWN]
        here = [
            (name, where, variants_at(situation, name, where)) for where in known if f"{name}@{where}" not in without
        ]
        if not places:
            disabled[name] = f"rig {situation.rig.name!r} has no place for it"
        elif not known:
            disabled[name] = f"needs {family.needs(places[0])}"
        elif here and not any(choices for _, _, choices in here):
            disabled[name] = "these poses show nothing of it"
        found += [one for one in here if one[2]]
    return found, disabled


def partly_known(situation: EffectContext, families: Collection[str]) -> Iterator[str]:
    """Yield a sentence for each need that most rows lack and some have: what goes by it may bear another name."""
    lacking: dict[tuple[str, int], list[str]] = {}
    for name in sorted(families):
        family = library()[name]
        for where in family.places(situation.rig):
            known = family.known(situation, where)
            if 0.0 < known.mean() < LEAST_KNOWN:
                need = family.needs(where), int(known.sum())
                lacking.setdefault(need, []).append(f"{name}@{where}")
    for (needs, rows), names in lacking.items():
        yield (
            f"not looked for: {', '.join(names)}; it needs {needs}, which {rows} of {len(situation)} rows have, fewer "
            "than half: what these do may be told under another name"
        )


def _log_priors(names: Sequence[str], again: Collection[str]) -> dict[str, float]:
    """Return the log prior probability of one candidate of each family; families of `again` share half of it all.

    Args:
        names: the family of every candidate.
        again: families that are in the model already.
    """
    count = {name: names.count(name) for name in names}
    twice = sum(name in again for name in count)
    once = len(count) - twice
    share = {
        name: (0.5 / twice if name in again else 0.5 / once) if twice and once else 1.0 / len(count) for name in count
    }
    return {name: math.log(share[name] / number) for name, number in count.items()}


def candidate_at(
    situation: EffectContext,
    over: Projection,
    family: str,
    where: str,
    choices: Sequence[Choice],
    log_prior: float = 0.0,
    like: CandidateEffect | None = None,
) -> CandidateEffect:
    """Return the candidate with the given variants; columns that are equal to those of one `like` it are these."""
    odds = np.array([library()[family].odds(choice.settings) for choice in choices])
    return CandidateEffect(
        family,
        where,
        tuple(choices),
        sharing((_columns(choice, situation, over, like) for choice in choices), like.additions if like else ()),
        np.log(odds / odds.sum()),
        log_prior,
    )


def _columns(choice: Choice, situation: EffectContext, over: Projection, like: CandidateEffect | None) -> EffectColumns:
    """Return the columns of a variant: those of the same variant about another fit, where no fit changes them."""
    if like is not None and choice in like.options and library()[choice.family].goes_by_readings:
        return like.additions[like.options.index(choice)]
    return without_zeros(choice.columns(situation).over(over.samples.average))


def variants_at(situation: EffectContext, family: str, where: str) -> tuple[Choice, ...]:
    """Return the variants of an effect at a place; none where it cannot do anything there."""
    return tuple(Choice(family, where, settings) for settings in library()[family].variants(situation, where))
