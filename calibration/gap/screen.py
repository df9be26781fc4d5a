"""Every effect of the library at every place, weighed by what the data say for it.

An effect's evidence is a closed form in the projected space (`projection`), averaged over its variants. Beforehand all
families are as likely, and all places of a family: an effect that a rig may have at seven joints is tried seven times
and must not win by that. One at a time, and the best in pairs: of two effects that are there, a third that looks like
their sum may beat each alone.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc, logsumexp

from calibration.effects.base import FittedCoefficient, Situation
from calibration.effects.fitted import Choice, FittedEffect
from calibration.effects.library import library
from calibration.gap.projection import Projection, from_products
from calibration.identification.additions import Additions, joined, same_columns
from calibration.observations import Floats

LEAST_KNOWN = 0.5  # share of the rows that have what an effect needs
_PAIRED = 10
_SECOND = math.log(0.05)  # that another effect is there as well, beforehand
_AT_ONCE = 128  # columns
_KEPT = 16  # variants whose rows are at hand; all of them are gigabytes where there are thousands of fixes
_SEEN = 1e-10  # least eigenvalue of products of columns, of their largest
_TINY = float(np.finfo(np.float64).tiny)
_AS_WELL = 5.0  # ln of a Bayes factor; less is no difference
SCALES = (1 / 3, 1.0, 3.0, 10.0)  # of plausible sizes: what is plausible is not known better than that
_SQUARED_SCALES = np.square(SCALES)[:, None]
LOG_SCALE_ODDS = dict(zip(SCALES, np.log([0.2, 0.5, 0.25, 0.05]).tolist(), strict=True))


@dataclass(frozen=True)
class Place:
    """An effect where it may be.

    Attributes:
        family, where: which and where.
        options: its variants here.
        additions: what each of them does to the samples.
        log_odds: (o,) of the variants beside each other.
        log_prior: of this place of this family among all.
    """

    family: str
    where: str
    options: tuple[Choice, ...]
    additions: tuple[Additions, ...]
    log_odds: Floats
    log_prior: float

    def __str__(self) -> str:
        return f"{self.family}@{self.where}"

    @cached_property
    def alike(self) -> tuple[int, ...]:
        """(o,) of each variant the first that has the same columns; the two differ in their prior alone."""
        # Columns of different sums are told apart without comparing them.
        sums = [(len(a), a.column.sum(), 0.0 if a.shift_mm is None else a.shift_mm.sum()) for a in self.additions]
        return tuple(
            next((k for k in range(n) if sums[k] == sums[n] and same_columns(self.additions[k], own)), n)
            for n, own in enumerate(self.additions)
        )


@dataclass(frozen=True)
class Possible:
    """All places, and what the data lack.

    Attributes:
        places: where effects may be.
        disabled: family -> what the data or the rig lack for it.
    """

    places: tuple[Place, ...]
    disabled: Mapping[str, str]


@dataclass(frozen=True)
class Weighed:
    """One place, weighed.

    Attributes:
        place: which.
        option: index of its best variant.
        scale: of that variant's plausible sizes.
        estimate, standard_error: (k,) of its coefficients in the linear model.
        log_bayes_factor: of the place against nothing, all its variants together.
        spread: the same less that of its best variant by itself: what it costs not to know the form.
        log_likelihood: against nothing, of the coefficients that fit best, whatever their size; averaged over variants.
        p: of the squares that the best variant explains, by chance, for one look.
        posterior: of the place, among all places, pairs and nothing.
        log_evidence: of the most probable model that has this place, the odds beforehand in it, against nothing.
        beside: the other of the pair, where that model is a pair.
        instead: other forms and places of its family that may be what it is, where it is one of a set.
    """

    place: Place
    option: int
    scale: float
    estimate: Floats
    standard_error: Floats
    log_bayes_factor: float
    spread: float
    log_likelihood: float
    p: float
    posterior: float = 0.0
    log_evidence: float = -math.inf
    beside: Weighed | None = None
    instead: tuple[Weighed, ...] = ()

    @property
    def choice(self) -> Choice:
        """The best variant, of the scale that the data ask for."""
        return replace(self.place.options[self.option], scale=self.scale)

    def fitted(self, situation: Situation) -> FittedEffect:
        """As the linear model has it."""
        return self.choice.fitted(situation, self.estimate, self.standard_error)

    @property
    def scaled_additions(self) -> Additions:
        """What it does to the samples, of the size that the data ask for."""
        return replace(self.additions, prior_sigma=self.additions.prior_sigma * self.scale)

    @property
    def size(self) -> int:
        """How many of its coefficients outputs list; the others only shape it."""
        choice, names = self.choice, [name.partition(":")[2] for name in self.additions.names]
        fitted = [FittedCoefficient(name, "", 0.0, 1.0, 1.0) for name in names]
        listed = {c.name for c in library()[choice.family].reported(choice.settings, tuple(fitted))}
        return sum(name in listed for name in names) or len(names)

    @property
    def additions(self) -> Additions:
        """What it does to the samples."""
        return self.place.additions[self.option]


def possible(
    situation: Situation, over: Projection, families: Collection[str], without: Collection[str] = ()
) -> Possible:
    """All that may be missing.

    Args:
        situation: of the observations.
        over: whose samples the columns are for.
        families: that may be named.
        without: `family@where` of what is in the model already.
    """
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
        found += [place for place in here if place[2]]
    log_prior = _log_priors([name for name, _, _ in found], {name.partition("@")[0] for name in without})
    return Possible(
        tuple(place_of(situation, over, name, where, choices, log_prior[name]) for name, where, choices in found),
        disabled,
    )


def _log_priors(names: Sequence[str], again: Collection[str]) -> dict[str, float]:
    """Of one place of each family, by the family of every place; those that are there `again` have half of it all."""
    count = {name: names.count(name) for name in names}
    twice = sum(name in again for name in count)
    once = len(count) - twice
    share = {
        name: (0.5 / twice if name in again else 0.5 / once) if twice and once else 1.0 / len(count) for name in count
    }
    return {name: math.log(share[name] / number) for name, number in count.items()}


def place_of(
    situation: Situation, over: Projection, family: str, where: str, choices: Sequence[Choice], log_prior: float = 0.0
) -> Place:
    """A place with the given variants."""
    odds = np.array([library()[family].odds(choice.settings) for choice in choices])
    return Place(
        family,
        where,
        tuple(choices),
        tuple(choice.additions(situation).over(over.samples.average) for choice in choices),
        np.log(odds / odds.sum()),
        log_prior,
    )


def variants_at(situation: Situation, family: str, where: str) -> tuple[Choice, ...]:
    """The forms that an effect may take at a place; none where it cannot be there."""
    return tuple(Choice(family, where, settings) for settings in library()[family].variants(situation, where))


class Screen:
    """Columns of all places in the projected space, as products, so that any selection of them is weighed at once.

    Args:
        projection: where.
        places: what.
    """

    def __init__(self, projection: Projection, places: Sequence[Place]) -> None:
        self.projection, self.places = projection, tuple(places)
        self._number = {id(place): number for number, place in enumerate(self.places)}
        self._block: dict[tuple[int, int], int] = {}
        blocks: list[Additions] = []
        for number, place in enumerate(self.places):
            for option, first in enumerate(place.alike):
                self._block[number, option] = len(blocks) if first == option else self._block[number, first]
                if first == option:
                    blocks.append(place.additions[option])
        target = projection.rows.target
        taken = projection.softly.taken(target)
        self._blocks, self._kept = blocks, dict[int, Floats]()
        self._taken: list[Floats] = []
        self._along: list[Floats] = []
        self._gram: dict[tuple[int, int], Floats] = {}
        for together in _several(blocks):
            whitened = projection.whitened(projection.moved_mm(joined(together, len(projection.samples))))
            of_kinematics = projection.softly.taken(whitened)
            along = whitened.T @ target - of_kinematics.T @ taken
            edges = np.cumsum([len(additions) for additions in together])[:-1]
            self._along += np.split(along, edges)
            both = zip(np.split(whitened, edges, axis=1), np.split(of_kinematics, edges, axis=1), strict=True)
            for number, (rows, own) in enumerate(both, len(self._taken)):
                self._gram[number, number] = rows.T @ rows - own.T @ own
                self._taken.append(own)

    def columns(self, place: int, option: int) -> Floats:
        """(3 m, k) of a variant."""
        return self.projection.softly(self._whitened(self._block[place, option]))

    def distinct(self, place: int) -> tuple[tuple[int, ...], ...]:
        """The variants of a place, those together that differ in their prior alone."""
        found: dict[int, list[int]] = {}
        for option in range(len(self.places[place].options)):
            found.setdefault(self._block[place, option], []).append(option)
        return tuple(map(tuple, found.values()))

    def log_bayes_factor(self, chosen: Sequence[tuple[int, int]], scales: Sequence[float] | None = None) -> float:
        """Of several variants together, (place, option) each, against nothing.

        Args:
            chosen: the variants.
            scales: of the plausible sizes of each; 1 by default.
        """
        blocks = [self._block[which] for which in chosen]
        gram = np.block([[self._product(a, b) for b in blocks] for a in blocks])
        along = np.concatenate([self._along[block] for block in blocks])
        sigma = np.concatenate(
            [
                self.places[place].additions[option].prior_sigma * scale
                for (place, option), scale in zip(chosen, scales or [1.0] * len(chosen), strict=True)
            ]
        )
        return from_products(gram, along, sigma)

    def together(self, weighed: Sequence[Weighed]) -> float:
        """Log evidence of several places together, in their best variants."""
        chosen = [(self._number[id(w.place)], w.option) for w in weighed]
        return self.log_bayes_factor(chosen, [w.scale for w in weighed])

    def weigh(self, without: Collection[str] = ()) -> tuple[Weighed, ...]:
        """All places but those called so (`family@where`), by the most probable model that has them.

        Of a pair first the one that shows more by itself: two that are like each other share the probability of what
        they may both be, and a small effect beside either of them would have all of its own.
        """
        each = {n: self._weigh(n) for n, place in enumerate(self.places) if str(place) not in without}
        best = sorted(each, key=lambda n: -(each[n].log_bayes_factor + each[n].place.log_prior))[:_PAIRED]
        models: list[tuple[tuple[int, ...], float]] = [((), 0.0)]
        models += [((n,), w.log_bayes_factor + w.place.log_prior) for n, w in each.items()]
        for i, k in itertools.combinations(best, 2):
            pair = [each[i], each[k]]
            prior = sum(w.place.log_prior for w in pair) + math.log(2.0) + _SECOND
            models.append(((i, k), self.together(pair) + each[i].spread + each[k].spread + prior))
        total = logsumexp([value for _, value in models])
        share, top = dict.fromkeys(each, 0.0), dict.fromkeys(each, -math.inf)
        beside: dict[int, Weighed | None] = dict.fromkeys(each)
        for members, value in models:
            for number in members:
                share[number] += math.exp(value - total)
                if value > top[number]:
                    top[number] = value
                    beside[number] = next((each[other] for other in members if other != number), None)
        weighed = [replace(w, posterior=share[n], log_evidence=top[n], beside=beside[n]) for n, w in each.items()]
        return tuple(sorted(weighed, key=lambda w: (-w.log_evidence, -w.log_bayes_factor, str(w.place))))

    def forms(self, weighed: Weighed, least: float) -> Iterator[Weighed]:
        """A weighed place in each of its other forms whose log evidence is at least this; finer ones are not others."""
        choice, situation = weighed.choice, self.projection.situation
        if library()[choice.family].refined(situation, choice.where, choice.settings):
            return
        number = self._number[id(weighed.place)]
        values, odds, likelihood = self._values(number)
        for together in self.distinct(number):
            of_form = np.full_like(values, -math.inf)
            of_form[list(together)] = values[list(together)]
            if weighed.option not in together and logsumexp(of_form) >= least:
                yield self._weigh_best(number, of_form, odds, likelihood)

    def _weigh(self, number: int) -> Weighed:
        """One place; its strained variants are left out, as long as they would be the best.

        And so are those whose coefficients are beyond their limits, where another explains the data as well: of forms
        that mirror or outgrow each other, data alone say which only by the sign and the size that they ask for.
        """
        values, odds, likelihood = self._values(number)
        while True:
            found = self._weigh_best(number, values, odds, likelihood)
            estimate, error = found.estimate, found.standard_error
            is_strained = found.choice.strained(estimate, error)
            if not is_strained and not found.choice.beyond(self.projection.situation, estimate, error):
                return found
            rest = values.copy()
            rest[found.option] = -math.inf
            if rest.max() < (-math.inf if is_strained else values.max() - _AS_WELL) or np.isneginf(rest).all():
                return found
            values = rest

    def _values(self, number: int) -> tuple[Floats, Floats, float]:
        """(options, scales) log evidence of a place, and the odds beforehand in it; its log likelihood."""
        place = self.places[number]
        each = [self._at_scales(number, option) for option in range(len(place.options))]
        odds = place.log_odds[:, None] + np.array(list(LOG_SCALE_ODDS.values()))
        values = odds + [at_scales for at_scales, _ in each]
        return values, odds, float(logsumexp(place.log_odds + [0.5 * explained for _, explained in each]))

    def _weigh_best(self, number: int, values: Floats, odds: Floats, log_likelihood: float) -> Weighed:
        """One place by its best variant and scale, for the log evidence (options, scales) of all, `odds` in it."""
        place = self.places[number]
        option, best = np.unravel_index(int(np.argmax(values)), values.shape)
        prior = place.additions[option].prior_sigma * SCALES[best]
        size, axes, along = self._eigen(number, int(option))
        size, along = size * SCALES[best] ** 2, along * SCALES[best]
        explained, degrees = _explained(size, along)
        p = float(chdtrc(degrees, explained))
        together = float(logsumexp(values))
        looks = len({self._block[number, o] for o in range(len(values))})
        return Weighed(
            place,
            int(option),
            SCALES[best],
            prior * (axes @ (along / (1.0 + size))),
            prior * np.sqrt(np.clip(1.0 - axes**2 @ (size / (1.0 + size)), 0.0, 1.0)),
            together,
            together - float(values[option, best] - odds[option, best]),
            log_likelihood,
            min(p * looks, 1.0),
        )

    def _at_scales(self, number: int, option: int) -> tuple[Floats, float]:
        """(scales,) log Bayes factors of a variant by itself, and the squares that it explains at most."""
        one, _, along_one = self._eigen(number, option)
        size, squares = one * _SQUARED_SCALES, along_one**2 * _SQUARED_SCALES
        values: Floats = 0.5 * (squares / (1.0 + size) - np.log1p(size)).sum(axis=1)
        return values, _explained(one, along_one)[0]

    def _eigen(self, number: int, option: int) -> tuple[Floats, Floats, Floats]:
        """Of a variant's G'G with the coefficients in prior sigmas: eigenvalues (k,), axes (k, k), G'r along these."""
        block = self._block[number, option]
        sigma = self.places[number].additions[option].prior_sigma
        size, axes = np.linalg.eigh(self._product(block, block) * sigma * sigma[:, None])
        return np.maximum(size, 0.0), axes, axes.T @ (self._along[block] * sigma)

    def _product(self, a: int, b: int) -> Floats:
        if (a, b) not in self._gram:
            product = self._whitened(a).T @ self._whitened(b) - self._taken[a].T @ self._taken[b]
            self._gram[a, b], self._gram[b, a] = product, product.T
        return self._gram[a, b]

    def _whitened(self, block: int) -> Floats:
        """(3 m, k) of a block."""
        if block not in self._kept:
            if len(self._kept) == _KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[block] = self.projection.whitened(self.projection.moved_mm(self._blocks[block]))
        return self._kept[block]


def _explained(size: Floats, along: Floats) -> tuple[float, int]:
    """Squares that columns explain, by the eigenvalues (k,) of their products and G'r along these; and how many do."""
    seen = size > _SEEN * max(float(size[-1]), _TINY)
    return float((along[seen] ** 2 / size[seen]).sum()), int(seen.sum())


def _several(blocks: Sequence[Additions]) -> Iterator[Sequence[Additions]]:
    """The blocks, as many at a time as have some columns together: one pass over the rows serves them all."""
    first, width = 0, 0
    for number, additions in enumerate(blocks, 1):
        width += len(additions)
        if width >= _AT_ONCE or number == len(blocks):
            yield blocks[first:number]
            first, width = number, 0


def by_family(weighed: Iterable[Weighed]) -> dict[str, float]:
    """Family -> posterior, the greatest first; a family at several places at once counts once."""
    found: dict[str, float] = {}
    for w in weighed:
        found[w.place.family] = min(1.0, found.get(w.place.family, 0.0) + w.posterior)
    return dict(sorted(found.items(), key=lambda item: -item[1]))
