"""Assessment of every effect of a model given all others: its evidence, its alternatives, and its possible places.

The result does not depend on the order in which effects were found. Each effect is left out in turn, the background is
fitted again, and all effects of the library compete to replace it.
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
    add_certain_effects,
    gain,
    is_beyond_limits,
    is_curve,
    log_prior,
    needed,
    promising,
    temper,
)
from calibration.gap.background.system import Chosen, Model, System
from calibration.gap.screening import ScoredEffect

_CERTAIN = 0.95  # posterior from which on a family is certain
_OPEN = 0.02  # posterior from which on a different family is a possible alternative
_ROUNDS = 5
_BETTER = 1.0  # log odds required to replace one effect by another
_COMPARED = 8
_BY_SCALES = 20.0  # log Bayes factor that refitting the scales of the background may add
NEAR = 5.0  # difference of log Bayes factors below which places and families are not distinguishable
_INDISTINGUISHABLE = math.exp(-NEAR)
_DOMINATES = 4.0  # required ratio of a curve's sum of squares to that of the surfaces at its joint


@dataclass(frozen=True)
class Assessment:
    """An effect of a model, assessed given all others.

    Attributes:
        effect: the effect.
        scored: its score given the model without it.
        log_bayes_factor: log Bayes factor against the model without the effect.
        log_odds: the same including prior odds.
        posterior: posterior probability of the family.
        places: possible place -> its posterior probability, given the family.
        alternatives: possible effects of other families.
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
        """True if the family is certain."""
        return self.posterior >= _CERTAIN


def assess_model(system: System, model: Model) -> tuple[Model, list[Assessment]]:
    """Return a model in which every effect is the most probable given all others, and the assessment of each.

    Where an effect is removed, the search continues with the remaining ones.

    Args:
        system: the linear model of the data.
        model: effects and scales to start from.
    """
    seen = set[frozenset[tuple[int, int]]]()
    for _ in range(_ROUNDS):
        before, effects = model, frozenset(effect[:2] for effect in model.effects)
        if effects in seen:  # a cycle: no set of effects is stable
            break
        seen.add(effects)
        found: list[Assessment] = []
        for effect in before.effects:
            if effect not in model.effects:
                continue
            alternatives = _Alternatives(system, model, model.effects.index(effect))
            changed = alternatives.changed()
            model = model if changed is None else changed
            found += [] if changed is not None else [alternatives.assessment()]
        model = add_certain_effects(system, model)
        if len(found) == len(before.effects) == len(model.effects):
            return model, found
    return model, assessments(system, model)


def assessments(system: System, model: Model) -> list[Assessment]:
    """Return the assessment of every effect of an unchanged model."""
    return [_Alternatives(system, model, number).assessment() for number in range(len(model.effects))]


class _Alternatives:
    """An effect of a model, and the candidates that could replace it."""

    def __init__(self, system: System, model: Model, number: int) -> None:
        self.system, self.model = system, model
        self.effect, self.rest = model.effects[number], model.without(number)
        self.candidate = system.candidates[self.effect[0]]
        self.without = system.fit(self.rest, model.scales)
        # Scores use the scales of the full model. Refitted without the effect, the background would absorb part of it.
        given = system.at(self.rest, model.scales)
        every = system.screen(given).score()
        own = self._own(next(w for w in every if w.candidate is self.candidate))
        self.temper = temper(system, model, self.candidate, own.log_bayes_factor)
        least = own.scored.log_bayes_factor - NEAR * self.temper - _BY_SCALES
        near = [w for w in promising(system, given, every) if w.log_bayes_factor > least]
        others = [w for w in near if w.candidate is not self.candidate][:_COMPARED]
        self.gains = [own, *(gain(system, self.without, w, model.scales) for w in others)]
        # The prior of a candidate against no effect is not used here; families compete with the prior of their places.
        self.odds = [(g.log_bayes_factor - math.log(_places(system, g))) / self.temper for g in self.gains]

    def _own(self, scored: ScoredEffect) -> Gain:
        """Return the gain by the effect, in its present variant or in the one that is best now."""
        odds = log_prior(self.system, self.without, self.candidate)
        best = self.model.log_evidence - self.without.log_evidence
        there = best + scored.form_averaging
        own = Gain(scored, there, best, there + odds, self.model)
        if self.system.choice(scored) == self.effect:
            return own
        again = gain(self.system, self.without, scored, self.model.scales)
        return again if again.log_likelihood_gain > best else own

    def changed(self) -> Model | None:
        """Return a model without the effect if not needed, or with a better effect; None if it is to be kept."""
        best = max(range(len(self.gains)), key=self.odds.__getitem__)
        if not self._is_needed() or is_beyond_limits(self.system, self.model, self.gains[0].scored):
            return self.system.fit(self.rest, self.without.scales)
        if self.odds[best] > self.odds[0] + _BETTER:
            better = self.gains[best]
            return self.system.fit([*self.rest, self.system.choice(better.scored)], better.model.scales)
        return None

    def _is_needed(self) -> bool:
        """Return True if the effect is certain given all others; if a curve can imitate it, also against no effect."""
        own = self.gains[0]
        if own.log_odds < needed(self.system, self.without, self.candidate):
            return False
        if not is_curve(self.system, self.candidate):
            return True
        bare = self.system.fit(self.rest, self.model.scales, without={f"curve({self.candidate.where})"})
        return own.model.log_evidence - bare.log_evidence - math.log(len(self.system.candidates)) > ODDS

    def assessment(self) -> Assessment:
        """Return the assessment of the effect."""
        share = softmax([*self.odds, 0.0])
        same = [n for n, g in enumerate(self.gains) if g.scored.candidate.family == self.candidate.family]
        # The size of the effect at a place does not count as evidence against that place.
        at_best = softmax([self.gains[n].log_likelihood_gain / self.temper for n in same])
        places = {self.gains[n].scored.candidate.where: float(p) for n, p in zip(same, at_best, strict=True)}
        least = places[self.candidate.where] * _INDISTINGUISHABLE
        return Assessment(
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
    """Return joint -> log odds of its curve, for curves that are certain and not part of a surface, largest first.

    A smooth error of several angles has parts that depend on each angle alone. A curve is therefore attributed to the
    joint only if it is much larger than the surfaces at this joint, and if no other effect at the joint explains it.

    Args:
        system: the linear model of the data.
        model: effects and scales.
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
    """Return True if a different effect at the joint adds nearly the same evidence as a curve to a model without it."""
    every = promising(system, without, system.screen(without).score())
    for scored in [w for w in every if w.candidate.where == curve.where][:_COMPARED]:
        near = added - NEAR * temper(system, without, scored.candidate, added)
        if gain(system, without, scored, without.scales, {curve.name}).log_bayes_factor > near:
            return True
    return False
