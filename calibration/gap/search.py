"""The search for what the model lacks: screen, decide, adopt by joint refit, and again while anything can be named."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Situation
from calibration.effects.fitted import Choice
from calibration.gap.adequacy import closes
from calibration.gap.adopt import (
    Adopted,
    JointFit,
    adopted,
    evidence_of_forms,
    finer_forms,
    joint_fit,
    projected,
    refined_choice,
)
from calibration.gap.decide import beyond, chance_of_gain, wins
from calibration.gap.detect import detect
from calibration.gap.grammar import Found as Formula
from calibration.gap.grammar import Grammar
from calibration.gap.projection import Projection
from calibration.gap.rivals import (
    BOTH,
    NEAR,
    PLAIN,
    as_simple,
    best_of_each_family,
    further_places,
    near_rivals,
    odds_text,
    stands_out,
    together,
    with_a_chance,
    with_option,
)
from calibration.gap.screen import Place, Possible, Screen, Weighed, by_family, place_of, possible, variants_at
from calibration.identification.additions import joined
from calibration.identification.refinement import Fit, Prior
from calibration.identification.solve import Solution
from calibration.observations import Floats, Observations

MOST_FAMILIES = 4
MOST_OF_A_SET = 3

_CERTAIN = 0.95  # posterior of the family
_BETTER = 1.0  # in log evidence, to take another form of what is there
_LOOKED_AT = 0.5  # of the leading log evidence, for a rival to be looked at more closely
_STABLE = 0.8  # of half-samples
_STABLE_AGAIN = 0.5  # the same for one more place of a family whose name is earned already
_GAIN = 0.05  # p of no gain on held-out groups
_PAIRED = 10  # candidates that a formula may be the same as
_SHARPER = 3  # times the noise is taken anew from the best hypothesis
_STEPS = 30  # of the loop; every place of every adopted family
_PENDING = 3  # sets that are looked behind
_OUTLIER = 0.5  # probability of being none
_GROSS = 8.0  # times the median error
_MANY = 0.02  # share of gross outliers that is more than accidents


@dataclass(frozen=True)
class Turn:
    """One turn of the loop.

    Attributes:
        fit: kinematics and effects at its beginning.
        projection: about that fit.
        weighed: all places, the most probable first.
        posterior: family -> probability that it is there.
        taken: what it took in to stay: one effect, at one place or several; none in the last.
        reasons: `family@where` -> why it was not named, a clause.
    """

    fit: JointFit
    projection: Projection
    weighed: tuple[Weighed, ...]
    posterior: Mapping[str, float]
    taken: tuple[Choice, ...]
    reasons: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Found:
    """The result of the search.

    Attributes:
        adopted: kinematics and effects.
        joint: their fit.
        turns: in their order, the last without anything taken in.
        rivals: of the set that is pending, the most probable first; none where nothing is.
        formulas: of the grammar, where they explain better than all of the library what is left.
        certain: `family@where` of what is adopted -> posterior of its family when it was.
        possible: all places at the beginning, and what the data lack for others.
        first, last: what the kinematics alone leave, and what is left in the end.
    """

    adopted: Adopted
    joint: JointFit
    turns: tuple[Turn, ...]
    rivals: tuple[Weighed, ...]
    formulas: tuple[Formula, ...]
    certain: Mapping[str, float]
    possible: Possible
    first: Projection
    last: Projection


@dataclass(frozen=True)
class _Decision:
    kind: Literal["take", "set", "outside", "nothing"]
    weighed: tuple[Weighed, ...]
    posterior: Mapping[str, float]
    joint: JointFit | None = None
    rivals: tuple[Weighed, ...] = ()
    formulas: tuple[Formula, ...] = ()
    reasons: Mapping[str, str] = field(default_factory=dict)


class _Search:
    def __init__(
        self, solution: Solution, observations: Observations, families: Collection[str], prior: Prior, seed: int
    ) -> None:
        self.solution, self.observations, self.families = solution, observations, tuple(families)
        self.prior, self.seed = prior, seed

    def run(self) -> Found:
        """The search, with the fixes that are far off left out, and with all where there are many such.

        To kinematics alone a fix that shows an effect may look like an outlier, as such fixes are often the rare ones:
        those after a step, or where a load has changed its side. Of both searches the one counts whose effects leave
        fewer outliers over.
        """
        fit, gross = self.solution.fit, _gross(self.solution)
        found = self._run(replace(fit, weight=np.where(gross, fit.weight, 1.0)))
        if gross.mean() < _MANY:
            return found
        with_all = self._run(replace(fit, weight=np.ones(len(gross))))
        return with_all if with_all.joint.choices and self._outliers(with_all) < self._outliers(found) else found

    def _outliers(self, found: Found) -> int:
        """How many samples the kinematics with what was found weigh out."""
        fit = found.joint.fit if found.joint.choices else self.solution.fit
        return int((fit.weight < _OUTLIER).sum())

    def _run(self, fit: Fit) -> Found:
        solution = self.solution
        situation = Situation(solution.chain, fit.x[: len(solution.chain)], self.observations)
        joint = JointFit(situation, (), (), fit)
        turns: list[Turn] = []
        certain: dict[str, float] = {}
        pending: list[str] = []
        projection = self._project(joint)
        alone = joint, projection
        first = possible(situation, projection, self.families)
        there, steps = first.places, 0
        while True:
            decision = self._decide(joint, projection, there)
            steps += 1
            is_set = decision.kind == "set" and len(pending) < _PENDING
            taken = () if decision.joint is None else decision.joint.choices[len(joint.choices) :]
            # What is there already may have a better form by now, all the more at the same place; then look again.
            places = {c.where for c in taken}
            again = [c for c in joint.choices if not taken or c.where in places]
            settled = self._settled(joint, again) if steps < _STEPS else joint
            if settled is not joint:
                joint, projection = settled, self._project(settled)
                there = self._possible(joint, projection)
                continue
            if not is_set:
                own = taken if decision.kind == "take" else ()
                turns.append(Turn(joint, projection, decision.weighed, decision.posterior, own, decision.reasons))
            if decision.joint is None or steps > _STEPS or not (is_set or decision.kind == "take"):
                break
            # What cannot be told apart yet is there for the time being: others may stand out beside it.
            if is_set:
                pending += [str(c) for c in taken]
            certain |= {str(c): decision.posterior[c.family] for c in taken}
            joint = decision.joint
            projection = self._project(joint)
            there = self._possible(joint, projection)
        rivals = decision.rivals
        for name in pending:
            joint, turn, left = self._judged_again(joint, name)
            projection = self._project(joint)
            if turn is not None and turn.taken:
                turns.insert(-1, turn)
                certain |= {str(c): turn.posterior[c.family] for c in turn.taken}
            elif turn is not None and left and not rivals:
                turns[-1], rivals = turn, left
        turns = self._as_they_count(turns, alone, joint)
        turns[-1] = replace(turns[-1], fit=joint, projection=projection)
        certain = {str(c): certain[str(c)] for c in joint.choices}
        if joint.choices and not rivals:
            structured = bool(decision.formulas) or detect(Grammar(projection), self._rng()).significant
            if not closes(turns[0].projection, projection, is_structured=structured):
                return self._retracted(turns, decision, first)
        reason = "nothing stands out of the noise that could be named"
        if joint.choices:
            reason = f"the data ask for {', '.join(str(c) for c in joint.choices)}"
        return Found(
            adopted(solution, joint, reason) if joint.choices else Adopted(solution, solution.fit, reason=reason),
            joint,
            tuple(turns),
            rivals,
            decision.formulas,
            certain,
            first,
            turns[0].projection,
            projection,
        )

    def _judged_again(self, joint: JointFit, name: str) -> tuple[JointFit, Turn | None, tuple[Weighed, ...]]:
        """What could not be told from others, now that all else is known: the fit with it, or without and the set."""
        if name not in map(str, joint.choices):
            return joint, None, ()
        others = [c for c in joint.choices if str(c) != name]
        without = self._fit(others, joint.start(others))
        projection = self._project(without)
        decision = self._decide(without, projection, self._possible(without, projection))
        if decision.kind != "take" or decision.joint is None:
            turn = Turn(without, projection, decision.weighed, decision.posterior, (), decision.reasons)
            return without, turn, decision.rivals
        taken = decision.joint.choices[len(others) :]
        turn = Turn(without, projection, decision.weighed, decision.posterior, taken, decision.reasons)
        return decision.joint, turn, ()

    def _as_they_count(self, turns: Sequence[Turn], alone: tuple[JointFit, Projection], last: JointFit) -> list[Turn]:
        """The turns without what was there for the time being, each about a fit of what those before it took in.

        Args:
            turns: in their order.
            alone: the fit of the kinematics alone, and the projection about it.
            last: what is there in the end.
        """
        kept, there, out = {str(c) for c in last.choices}, set[str](), []
        for turn in turns:
            taken = tuple(c for c in turn.taken if str(c) in kept)
            dropped = {str(c): "what was found after it makes it superfluous" for c in turn.taken if c not in taken}
            own = [c for c in turn.fit.choices if str(c) in there]
            fit, projection = turn.fit, turn.projection
            if not own:
                fit, projection = alone
            elif len(own) < len(fit.choices):
                fit = self._fit(own, fit.start(own))
                projection = self._project(fit)
            out.append(replace(turn, fit=fit, projection=projection, taken=taken, reasons={**turn.reasons, **dropped}))
            there |= {str(c) for c in taken}
        return out

    def _retracted(self, turns: Sequence[Turn], decision: _Decision, first: Possible) -> Found:
        """No effect at all: what the library has explains a part of the gap only, so it is something else."""
        reasons = {str(c): "it closes a part of the gap only" for turn in turns for c in turn.taken}
        turn = replace(turns[0], taken=(), reasons={**turns[0].reasons, **reasons})
        start = turns[0].projection
        return Found(
            Adopted(self.solution, self.solution.fit, reason="what could be named closes a part of the gap only"),
            turn.fit,
            (turn,),
            (),
            Grammar(start).found() or decision.formulas,
            {},
            first,
            start,
            start,
        )

    # -- one turn ---------------------------------------------------------------------------------------------------

    def _decide(self, joint: JointFit, projection: Projection, places: Sequence[Place]) -> _Decision:
        """What to make of the places, given what is adopted."""
        reasons: dict[str, str] = {}
        first = Screen(projection, places)
        while True:
            weighed = first.weigh(without=reasons)
            if not weighed or not stands_out(weighed, len(weighed)):
                return _Decision("nothing", weighed, by_family(weighed), reasons=reasons)
            screen, weighed, tried = self._sharpened(joint, projection, with_a_chance(weighed), weighed[0])
            if not stands_out(weighed, len(places)):
                # What stood out was the tail of fixes that the fit now takes for outliers.
                return _Decision("nothing", weighed, by_family(weighed), reasons=reasons)
            leading = weighed[0]
            near = [w for w in weighed if w.log_bayes_factor > leading.log_bayes_factor - 2 * NEAR]
            out = {
                str(w.place): f"{', '.join(names)} would be beyond what is physical"
                for w in near
                if (names := beyond(joint.situation, w))
            }
            if names := tried.beyond(len(tried.choices) - 1):
                out[str(leading.place)] = f"{', '.join(names)} would be beyond what is physical"
            reasons |= out
            if str(leading.place) not in out:
                break
        weighed = screen.weigh(without=out)
        if str(weighed[0].place) != str(tried.choices[-1]):  # another one leads without those that are out
            start = screen.projection.solved(weighed[0].scaled_additions)
            tried = self._fit([*joint.choices, weighed[0].choice], start)
        return self._judged(joint, screen, weighed, by_family(weighed), tried, reasons)

    def _judged(
        self,
        joint: JointFit,
        screen: Screen,
        weighed: tuple[Weighed, ...],
        posterior: Mapping[str, float],
        tried: JointFit,
        reasons: dict[str, str],
    ) -> _Decision:
        leading, sharp = weighed[0], screen.projection
        best = best_of_each_family(weighed)
        near = near_rivals(weighed)
        grammar = Grammar(sharp)
        strongest = grammar.found(1)
        most = max(w.log_bayes_factor + w.place.log_prior for w in weighed)
        if strongest and strongest[0].log_evidence > most + NEAR:
            columns = [sharp.columns(sharp.moved_mm(w.additions)) for w in weighed[:_PAIRED]]
            if not any(strongest[0].alike(c) for c in columns):
                reasons |= {str(w.place): f"{strongest[0].term} explains it better" for w in near}
                return _Decision("outside", weighed, posterior, formulas=grammar.found(), reasons=reasons)
        rivals = [w for w in best if w.log_bayes_factor > leading.log_bayes_factor - 6 * NEAR][:6]
        against = ""
        # The name of a family that is there already is earned; one more place of it needs less than a new name.
        is_known = leading.place.family in {c.family for c in joint.choices}
        has_equal = not is_known and any(as_simple(leading, w) for w in near[1:])
        stable = _STABLE_AGAIN if is_known else _STABLE
        if posterior[leading.place.family] < _CERTAIN or has_equal:
            against = "another family is nearly as likely"
        elif (len(rivals) > 1 or leading.log_bayes_factor < PLAIN) and (
            share := wins(sharp, rivals, self.seed)
        ) < stable:
            against = f"it wins in {share:.0%} of half-samples only"
            near = (
                near if len(near) > 1 else [w for w in rivals if w.posterior + leading.posterior < BOTH or w is leading]
            )
        elif (p := chance_of_gain(sharp, leading, self.seed)) > _GAIN:
            against = f"it lowers no errors of held-out groups beyond chance (p {p:.2g})"
        if not against:
            reasons |= {str(w.place): odds_text(leading, w) for w in best[1:]}
            more = further_places(screen, weighed)
            if more:
                taken = [leading, *more]
                start = sharp.solved(joined([w.scaled_additions for w in taken], len(sharp.samples)))
                tried = self._fit([*joint.choices, *(w.choice for w in taken)], start)
            return _Decision("take", weighed, posterior, tried, reasons=reasons)
        reasons |= {str(w.place): against for w in near}
        if len(near) < 2:
            return _Decision("nothing", weighed, posterior, reasons=reasons)
        return _Decision("set", weighed, posterior, tried, tuple(near[:MOST_OF_A_SET]), reasons=reasons)

    def _sharpened(
        self, joint: JointFit, over: Projection, places: Sequence[Place], leading: Weighed
    ) -> tuple[Screen, tuple[Weighed, ...], JointFit]:
        """All places weighed with the noise that the best of them leaves, about the fit that has it."""
        for _ in range(_SHARPER):
            tried = self._fit([*joint.choices, leading.choice], over.solved(leading.scaled_additions))
            if finer_forms(tried.situation, leading.choice):
                # Which fixes are outliers depends on the form: those beside a step in a wrong place look like some.
                counted = replace(tried, fit=replace(tried.fit, weight=over.fit.weight))
                finer = refined_choice(tried, len(tried.choices) - 1, self._project(counted, without_last=True))
                if finer.settings != leading.choice.settings:
                    tried = self._fit([*joint.choices, finer], tried.fit.x)
                    places = [with_option(p, finer, over, joint.situation) if p is leading.place else p for p in places]
            sharp = self._project(tried, without_last=True)
            screen = Screen(sharp, places)
            weighed = screen.weigh()
            finer_places = [self._finer(joint, sharp, place, weighed) for place in places]
            if any(a is not b for a, b in zip(finer_places, places, strict=True)):
                places = finer_places
                screen = Screen(sharp, places)
                weighed = screen.weigh()
            if (weighed[0].choice.family, weighed[0].choice.where) == (leading.choice.family, leading.choice.where):
                break
            leading, over = weighed[0], sharp
        best, last = weighed[0].choice, tried.choices[-1]
        if (str(best), best.settings) != (str(last), last.settings):
            tried = self._fit([*joint.choices, weighed[0].choice], sharp.solved(weighed[0].scaled_additions))
        return screen, weighed, tried

    def _finer(self, joint: JointFit, sharp: Projection, place: Place, weighed: Sequence[Weighed]) -> Place:
        """A rival with the finest form about its best one: no step shall lose for want of a look at its instant."""
        own = next(w for w in weighed if w.place is place)
        if own is weighed[0] or own.log_bayes_factor < _LOOKED_AT * weighed[0].log_bayes_factor:
            return place
        finer = finer_forms(joint.situation, replace(own.choice, scale=1.0))
        if not finer:
            return place
        best = finer[int(np.argmax(evidence_of_forms(joint.situation, finer, sharp)))]
        return with_option(place, best, sharp, joint.situation)

    def _settled(self, joint: JointFit, again: Sequence[Choice]) -> JointFit:
        """The fit without those of its effects that others make superfluous, and with the better forms of the rest.

        `again` has those to look at; the fit itself comes back where nothing changes.
        """
        if len(joint.choices) < 2 or not again:
            return joint
        over = Projection(self.solution, joint.situation, joint.fit, joint.additions)
        places = [self._with_variants(joint, over, choice, is_open=choice in again) for choice in joint.choices]
        screen = Screen(over, places)
        chosen = {number: (0, choice.scale) for number, choice in enumerate(joint.choices)}
        for number, choice in enumerate(joint.choices):
            if choice not in again:
                continue
            others = {k: v for k, v in chosen.items() if k != number}
            without = together(screen, others)
            values = {
                one: together(screen, {**others, number: one}) + float(places[number].log_odds[one[0]])
                for one in itertools.product(range(len(places[number].options)), {1.0, choice.scale})
            }
            best = max(values, key=values.__getitem__)
            if values[best] < without:
                chosen = others
            elif values[best] > values[chosen[number]] + _BETTER:
                chosen[number] = best
        kept = [replace(places[n].options[option], scale=scale) for n, (option, scale) in chosen.items()]
        if kept == list(joint.choices):
            return joint
        parts = [
            replace(part, prior_sigma=part.prior_sigma * scale)
            for n, (option, scale) in chosen.items()
            for part in [places[n].additions[option]]
        ]
        return self._fit(kept, over.solved(joined(parts, len(over.samples))))

    def _with_variants(self, joint: JointFit, over: Projection, choice: Choice, *, is_open: bool) -> Place:
        """The place of an effect as it is, and with its other variants where it is open which it has."""
        options = [replace(choice, scale=1.0)]
        if is_open:
            variants = variants_at(joint.situation, choice.family, choice.where)
            options += [v for v in variants if v.settings != choice.settings]
        return place_of(joint.situation, over, choice.family, choice.where, options)

    # -- pieces -----------------------------------------------------------------------------------------------------

    def _allowed(self, joint: JointFit) -> tuple[str, ...]:
        """Families that may still be named: no others once there are as many as a model takes."""
        taken = {c.family for c in joint.choices}
        return tuple(f for f in self.families if f in taken) if len(taken) >= MOST_FAMILIES else self.families

    def _possible(self, joint: JointFit, projection: Projection) -> tuple[Place, ...]:
        """All places for what may still be missing."""
        there = [str(c) for c in joint.choices]
        return possible(joint.situation, projection, self._allowed(joint), there).places

    def _rng(self) -> np.random.Generator:
        return np.random.default_rng([self.seed, 2])

    def _fit(self, choices: Sequence[Choice], start: Floats) -> JointFit:
        return joint_fit(self.solution, self.observations, choices, self.prior, start)

    def _project(self, joint: JointFit, *, without_last: bool = False) -> Projection:
        """About a fit; its last effect is no part of what is taken out, if so asked."""
        return projected(self.solution, joint, without_last=without_last)


def search(
    solution: Solution,
    observations: Observations,
    families: Collection[str],
    *,
    prior: Prior = "recalibration",
    seed: int = 0,
) -> Found:
    """Find the effects that the data ask for.

    Args:
        solution: the kinematics alone, fitted to `observations`.
        observations: the rows.
        families: that may be named.
        prior: as the solution was found with.
        seed: of half-samples and folds.
    """
    return _Search(solution, observations, families, prior, seed).run()


def _gross(solution: Solution) -> NDArray[np.bool_]:
    """(m,) samples that are far off."""
    error = solution.samples.position_mm - solution.chain.positions_mm(solution.fit.x, solution.samples.data)
    size = np.linalg.norm(error, axis=1)
    gross: NDArray[np.bool_] = (solution.fit.weight < _OUTLIER) & (size > _GROSS * np.median(size))
    return gross
