"""Judgement of every effect of a model given all others: its evidence, its alternatives, and where it may be.

The order in which effects are found matters to none of this: each is left out in turn, the background takes what it
can, and everything in the library competes for what is missing then.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from scipy.special import softmax

from calibration.gap.background.blocks import Block
from calibration.gap.background.search import (
    ODDS,
    Gain,
    gain,
    grown,
    is_beyond_limits,
    is_curve,
    log_prior,
    needed,
    promising,
    temper,
)
from calibration.gap.background.system import Chosen, Model, System
from calibration.gap.screening import ScoredEffect

_CERTAIN = 0.95  # posterior of a family
_OPEN = 0.02  # posterior of another family
_ROUNDS = 5
_BETTER = 1.0  # log odds, to take one effect for another
_COMPARED = 8
_BY_SCALES = 20.0  # log Bayes factor that other scales of the background may add
NEAR = 5.0  # log Bayes factor: places and families this near are not told apart
_NOT_TOLD = math.exp(-NEAR)
_DOMINATES = 4.0  # squares of a curve, of those of surfaces at its joint


@dataclass(frozen=True)
class Judged:
    """An effect of a model, judged given all others.

    Attributes:
        effect: the effect.
        scored: the same, beside the model without it.
        log_bayes_factor: against the model without it.
        log_odds: the same with prior odds.
        posterior: probability of its family.
        places: place -> probability that it is there, given the family; those that are possible.
        alternatives: of other families, where these are possible.
    """

    effect: Chosen
    scored: ScoredEffect
    log_bayes_factor: float
    log_odds: float
    posterior: float
    places: Mapping[str, float]
    alternatives: tuple[ScoredEffect, ...] = ()

    @property
    def is_certain(self) -> bool:
        """True if the family is beyond doubt."""
        return self.posterior >= _CERTAIN


def judged(system: System, model: Model) -> tuple[Model, list[Judged]]:
    """Return a model in which every effect is the most probable given all others, and the judgement of each.

    Where an effect had to go, the search goes on beside those that are left.
    """
    seen = set[frozenset[tuple[int, int]]]()
    for _ in range(_ROUNDS):
        before, effects = model, frozenset(effect[:2] for effect in model.effects)
        if effects in seen:  # no set holds: each is judged worse than another of them
            break
        seen.add(effects)
        found: list[Judged] = []
        for effect in before.effects:
            if effect not in model.effects:
                continue
            alternatives = _Alternatives(system, model, model.effects.index(effect))
            changed = alternatives.changed()
            model = model if changed is None else changed
            found += [] if changed is not None else [alternatives.judgement()]
        model = grown(system, model)
        if len(found) == len(before.effects) == len(model.effects):
            return model, found
    return model, judgements(system, model)


def judgements(system: System, model: Model) -> list[Judged]:
    """Return the judgement of every effect of a model that stays as it is."""
    return [_Alternatives(system, model, number).judgement() for number in range(len(model.effects))]


class _Alternatives:
    """An effect of a model, and all that could be in its place."""

    def __init__(self, system: System, model: Model, number: int) -> None:
        self.system, self.model = system, model
        self.effect, self.rest = model.effects[number], model.without(number)
        self.candidate = system.candidates[self.effect[0]]
        self.without = system.fit(self.rest, model.scales)
        # Scores at the scales of the whole: found again without the effect, a background takes what it can of it.
        beside = system.at(self.rest, model.scales)
        every = system.screen(beside).score()
        own = self._own(next(w for w in every if w.candidate is self.candidate))
        self.temper = temper(system, model, self.candidate, own.log_bayes_factor)
        least = own.scored.log_bayes_factor - NEAR * self.temper - _BY_SCALES
        near = [w for w in promising(system, beside, every) if w.log_bayes_factor > least]
        others = [w for w in near if w.candidate is not self.candidate][:_COMPARED]
        self.gains = [own, *(gain(system, self.without, w, model.scales) for w in others)]
        # A prior probability counts between a candidate and nothing; between families it is that of their places.
        self.odds = [(g.log_bayes_factor - math.log(_places(system, g))) / self.temper for g in self.gains]

    def _own(self, scored: ScoredEffect) -> Gain:
        """Return what the effect gains, in its present form or in that which is the best one now."""
        odds = log_prior(self.system, self.without, self.candidate)
        best = self.model.log_evidence - self.without.log_evidence
        there = best + scored.form_averaging
        own = Gain(scored, there, best, there + odds, self.model)
        if self.system.choice(scored) == self.effect:
            return own
        again = gain(self.system, self.without, scored, self.model.scales)
        return again if again.log_likelihood_gain > best else own

    def changed(self) -> Model | None:
        """Return the model without the effect where it is not needed, with a better one where there is one, or None."""
        best = max(range(len(self.gains)), key=self.odds.__getitem__)
        if not self._is_needed() or is_beyond_limits(self.system, self.model, self.gains[0].scored):
            return self.system.fit(self.rest, self.without.scales)
        if self.odds[best] > self.odds[0] + _BETTER:
            better = self.gains[best]
            return self.system.fit([*self.rest, self.system.choice(better.scored)], better.model.scales)
        return None

    def _is_needed(self) -> bool:
        """True if the effect is beyond doubt: beside all others, and where a curve can imitate it against nothing."""
        own = self.gains[0]
        if own.log_odds < needed(self.system, self.without, self.candidate):
            return False
        if not is_curve(self.system, self.candidate):
            return True
        bare = self.system.fit(self.rest, self.model.scales, without={f"curve({self.candidate.where})"})
        return own.model.log_evidence - bare.log_evidence - math.log(len(self.system.candidates)) > ODDS

    def judgement(self) -> Judged:
        """Return the judgement of the effect."""
        share = softmax([*self.odds, 0.0])
        same = [n for n, g in enumerate(self.gains) if g.scored.candidate.family == self.candidate.family]
        # How large an effect would be at another place is no evidence against that place.
        at_best = softmax([self.gains[n].log_likelihood_gain / self.temper for n in same])
        places = {self.gains[n].scored.candidate.where: float(p) for n, p in zip(same, at_best, strict=True)}
        least = places[self.candidate.where] * _NOT_TOLD
        return Judged(
            self.effect,
            self.gains[0].scored,
            self.gains[0].log_bayes_factor,
            self.gains[0].log_odds,
            float(share[same].sum()),
            {where: p for where, p in places.items() if p > least},
            tuple(g.scored for n, g in enumerate(self.gains) if n not in same and share[n] > _OPEN),
        )


def _places(system: System, gain: Gain) -> int:
    return sum(c.family == gain.scored.candidate.family for c in system.candidates)


def curves(system: System, model: Model) -> dict[str, float]:
    """Return the joints whose curve is beyond doubt and no part of a surface, the largest first, with its log odds.

    A smooth error that depends on several angles has a part that depends on each alone: a curve is a joint's own where
    it is much larger than the surfaces at this joint. And another effect at the joint may be what a curve imitates.
    """
    amounts = system.amounts(model)
    size = {
        name: float(((system.columns[:, own] @ amounts[own]) ** 2).sum())
        for name in system.blocks
        for own in [system.of_block(name)]
    }
    every = [block for block in system.blocks.values() if block.kind == "curve"]
    prior = -math.log(len({c.family for c in system.candidates}) * max(len(every), 1))
    found = {}
    for block in every:
        surfaces = [b.name for b in system.blocks.values() if b.kind == "surface" and b.where == block.where]
        if size[block.name] < _DOMINATES * sum(size[name] for name in surfaces):
            continue
        without = system.fit(model.effects, model.scales, without={block.name})
        added = model.log_evidence - without.log_evidence
        if added + prior > ODDS and not _is_imitated(system, without, block, added):
            found[block.where] = added + prior
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def _is_imitated(system: System, without: Model, curve: Block, added: float) -> bool:
    """True if another effect at its joint does nearly what a curve adds to a model that lacks it."""
    every = promising(system, without, system.screen(without).score())
    for scored in [w for w in every if w.candidate.where == curve.where][:_COMPARED]:
        near = added - NEAR * temper(system, without, scored.candidate, added)
        if gain(system, without, scored, without.scales, {curve.name}).log_bayes_factor > near:
            return True
    return False
