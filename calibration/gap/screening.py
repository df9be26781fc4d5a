"""Screening: every effect of the library at every place, scored by its evidence in the data.

An effect's evidence has a closed form in the projected space (`projection`), averaged over its variants. Candidates are
scored one at a time, and the best ones in pairs, because if two effects exist, a third one that resembles their sum may
beat each of them alone.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import chdtrc

from calibration.effects.base import FittedCoefficient
from calibration.effects.columns import EffectColumns
from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice, FittedEffect
from calibration.effects.library import library
from calibration.gap.candidates import CandidateEffect
from calibration.gap.projected.column_products import BlockProducts, ProjectedProducts
from calibration.gap.projected.projection import Projection, from_products
from calibration.observations import Floats

_PAIRED = 10
_SECOND = math.log(0.05)  # log prior probability of a second effect
_SEEN = 1e-10  # smallest eigenvalue of products of columns that counts, relative to the largest
_ROUNDING = 1e-12
_TINY = float(np.finfo(np.float64).tiny)
_EQUAL = 5.0  # difference of log Bayes factors below which variants explain the data equally well
SCALES = (1 / 3, 1.0, 3.0, 10.0)  # factors on plausible sizes, which are known only roughly
_SQUARED_SCALES = np.square(SCALES)[:, None]
LOG_SCALE_ODDS = dict(zip(SCALES, np.log([0.2, 0.5, 0.25, 0.05]).tolist(), strict=True))


@dataclass(frozen=True)
class ScoredEffect:
    """A candidate with its evidence.

    Attributes:
        candidate: the effect at its place.
        option: index of the best variant.
        scale: factor on the plausible sizes of this variant.
        estimate, standard_error: (k,) estimates and standard errors of its coefficients in the linear model.
        log_bayes_factor: log Bayes factor against no effect, averaged over variants.
        form_averaging: `log_bayes_factor` minus that of the best variant alone: the penalty for the unknown variant.
        log_likelihood: log likelihood ratio against no effect at the best coefficients, averaged over variants.
        p: p-value of the squares that the best variant explains, corrected for the number of variants.
        posterior: posterior probability of the candidate among all candidates, pairs and no effect.
        log_evidence: log posterior odds against no effect of the most probable model with this candidate.
        partner: the other effect, if that model is a pair.
        same_family: other variants and places of the family that the data cannot distinguish from it.
    """

    candidate: CandidateEffect
    option: int
    scale: float
    estimate: Floats
    standard_error: Floats
    log_bayes_factor: float
    form_averaging: float
    log_likelihood: float
    p: float
    posterior: float = 0.0
    log_evidence: float = -math.inf
    partner: ScoredEffect | None = None
    same_family: tuple[ScoredEffect, ...] = ()

    @property
    def choice(self) -> Choice:
        """The best variant, at its best scale."""
        return replace(self.candidate.options[self.option], scale=self.scale)

    def fitted(self, context: EffectContext) -> FittedEffect:
        """Return the effect with the coefficients of the linear model."""
        return self.choice.fitted(context, self.estimate, self.standard_error)

    @property
    def additions(self) -> EffectColumns:
        """Columns of the best variant for the samples."""
        return self.candidate.additions[self.option]

    @property
    def scaled_additions(self) -> EffectColumns:
        """`additions` with prior sigmas at the best scale."""
        return replace(self.additions, prior_sigma=self.additions.prior_sigma * self.scale)

    @property
    def size(self) -> int:
        """Number of reported coefficients; the others only shape the effect."""
        choice, names = self.choice, [name.partition(":")[2] for name in self.additions.names]
        fitted = [FittedCoefficient(name, "", 0.0, 1.0, 1.0) for name in names]
        listed = {c.name for c in library()[choice.family].reported(choice.settings, tuple(fitted))}
        return sum(name in listed for name in names) or len(names)


class Screen:
    """Products of the columns of all candidates in the projected space, from which any set of them is scored.

    Args:
        projection: the projected space.
        candidates: the effects.
        products: products of blocks of columns, one block for each distinct variant in order; by default those of the
            projection.
    """

    def __init__(
        self, projection: Projection, candidates: Sequence[CandidateEffect], products: BlockProducts | None = None
    ) -> None:
        self.projection, self.candidates = projection, tuple(candidates)
        self._number = {id(candidate): number for number, candidate in enumerate(self.candidates)}
        self._block: dict[tuple[int, int], int] = {}
        blocks: list[EffectColumns] = []
        for number, candidate in enumerate(self.candidates):
            for option, first in enumerate(candidate.first_equal):
                self._block[number, option] = len(blocks) if first == option else self._block[number, first]
                if first == option:
                    blocks.append(candidate.additions[option])
        self._blocks = blocks
        self._eigen_of: dict[int, tuple[Floats, Floats, Floats, Floats]] = {}
        self._products = ProjectedProducts(projection, blocks) if products is None else products

    def columns(self, candidate: int, option: int) -> Floats:
        """Return (3 m, k) the projected columns of a variant.

        Args:
            candidate: number of the candidate.
            option: number of its variant.
        """
        additions = self._blocks[self._block[candidate, option]]
        return self.projection.columns(self.projection.moved_mm(additions))

    def distinct(self, candidate: int) -> tuple[tuple[int, ...], ...]:
        """Return the variants of a candidate, in groups that differ only in their prior."""
        found: dict[int, list[int]] = {}
        for option in range(len(self.candidates[candidate].options)):
            found.setdefault(self._block[candidate, option], []).append(option)
        return tuple(map(tuple, found.values()))

    def log_bayes_factor(self, chosen: Sequence[tuple[int, int]], scales: Sequence[float] | None = None) -> float:
        """Return the log Bayes factor of several variants together against no effect.

        Args:
            chosen: (candidate, option) of each variant.
            scales: factors on the plausible sizes of each; 1 by default.
        """
        blocks = [self._block[which] for which in chosen]
        gram = np.block([[self._products.product(a, b) for b in blocks] for a in blocks])
        along = np.concatenate([self._products.along(block) for block in blocks])
        sigma = np.concatenate(
            [
                self.candidates[candidate].additions[option].prior_sigma * scale
                for (candidate, option), scale in zip(chosen, scales or [1.0] * len(chosen), strict=True)
            ]
        )
        return from_products(gram, along, sigma)

    def given(self, chosen: Mapping[int, tuple[int, float]]) -> ConditionalScores:
        """Return the scores of candidates given other candidates.

        Args:
            chosen: number of each given candidate -> its variant and scale.
        """
        own = [
            (self._block[number, option], self._sigma(number, option, scale))
            for number, (option, scale) in chosen.items()
        ]
        return ConditionalScores(
            self, [block for block, _ in own], np.concatenate([np.empty(0), *(sigma for _, sigma in own)])
        )

    def _sigma(self, candidate: int, option: int, scale: float) -> Floats:
        sigma: Floats = self.candidates[candidate].additions[option].prior_sigma * scale
        return sigma

    def together(self, scored: Sequence[ScoredEffect]) -> float:
        """Return the log Bayes factor of several effects together, in their best variants."""
        chosen = [(self._number[id(w.candidate)], w.option) for w in scored]
        return self.log_bayes_factor(chosen, [w.scale for w in scored])

    def score(self, without: Collection[str] = ()) -> tuple[ScoredEffect, ...]:
        """Score all candidates, sorted by the most probable model that includes them.

        Of a pair, the effect with the larger individual evidence comes first. Posterior probabilities would not give
        this order: two similar effects share their probability, while a small effect paired with either keeps its own.

        Args:
            without: `family@where` of candidates to leave out.
        """
        each = {n: self._score_one(n) for n, c in enumerate(self.candidates) if str(c) not in without}
        best = sorted(each, key=lambda n: -(each[n].log_bayes_factor + each[n].candidate.log_prior))[:_PAIRED]
        models: list[tuple[tuple[int, ...], float]] = [((), 0.0)]
        models += [((n,), w.log_bayes_factor + w.candidate.log_prior) for n, w in each.items()]
        for i, k in itertools.combinations(best, 2):
            pair = [each[i], each[k]]
            prior = sum(w.candidate.log_prior for w in pair) + math.log(2.0) + _SECOND
            models.append(((i, k), self.together(pair) + each[i].form_averaging + each[k].form_averaging + prior))
        total = _log_sum([value for _, value in models])
        share, top = dict.fromkeys(each, 0.0), dict.fromkeys(each, -math.inf)
        partner: dict[int, ScoredEffect | None] = dict.fromkeys(each)
        for members, value in models:
            for number in members:
                share[number] += math.exp(value - total)
                if value > top[number]:
                    top[number] = value
                    partner[number] = next((each[other] for other in members if other != number), None)
        scored = [replace(w, posterior=share[n], log_evidence=top[n], partner=partner[n]) for n, w in each.items()]
        return tuple(sorted(scored, key=lambda w: (-w.log_evidence, -w.log_bayes_factor, str(w.candidate))))

    def forms(self, scored: ScoredEffect, least: float) -> Iterator[ScoredEffect]:
        """Yield a scored effect in its other variants; none if the effect can be refined.

        Args:
            scored: the effect in its best variant.
            least: smallest log Bayes factor of the variants to yield.
        """
        choice, context = scored.choice, self.projection.context
        if library()[choice.family].refined(context, choice.where, choice.settings):
            return
        number = self._number[id(scored.candidate)]
        values, odds, likelihood = self._values(number)
        for together in self.distinct(number):
            of_form = np.full_like(values, -math.inf)
            of_form[list(together)] = values[list(together)]
            if scored.option not in together and _log_sum(of_form) >= least:
                yield self._score_best(number, of_form, odds, likelihood)

    def _score_one(self, number: int) -> ScoredEffect:
        """Score one candidate, excluding best variants of implausible shape.

        Variants whose coefficients exceed their limits are also excluded if a different variant explains the data as
        well. Variants that are mirrored or scaled versions of each other differ only in sign and size of coefficients.
        """
        values, odds, likelihood = self._values(number)
        while True:
            found = self._score_best(number, values, odds, likelihood)
            estimate, error = found.estimate, found.standard_error
            is_implausible = found.choice.has_implausible_shape(estimate, error)
            if not is_implausible and not found.choice.beyond_limits(self.projection.context, estimate, error):
                return found
            rest = values.copy()
            rest[found.option] = -math.inf
            if rest.max() < (-math.inf if is_implausible else values.max() - _EQUAL) or np.isneginf(rest).all():
                return found
            values = rest

    def _values(self, number: int) -> tuple[Floats, Floats, float]:
        """Return log evidence and prior odds (options, scales) of a candidate, and its log likelihood ratio."""
        candidate = self.candidates[number]
        by_size: dict[int, list[int]] = {}
        for option, additions in enumerate(candidate.additions):
            by_size.setdefault(len(additions.prior_sigma), []).append(option)
        odds = candidate.log_odds[:, None] + np.array(list(LOG_SCALE_ODDS.values()))
        values, explained = odds.copy(), np.empty(len(candidate.options))
        for alike in by_size.values():
            at_scales, explained[alike] = self._at_scales(number, alike)
            values[alike] += at_scales
        return values, odds, _log_sum(candidate.log_odds + 0.5 * explained)

    def _score_best(self, number: int, values: Floats, odds: Floats, log_likelihood: float) -> ScoredEffect:
        """Score a candidate by its best variant and scale; `values` and `odds` are those of `_values`."""
        candidate = self.candidates[number]
        option, best = np.unravel_index(int(np.argmax(values)), values.shape)
        prior = candidate.additions[option].prior_sigma * SCALES[best]
        size, axes, along = self._eigen(number, int(option))
        size, along = size * SCALES[best] ** 2, along * SCALES[best]
        explained, degrees = _explained(size, along)
        p = float(chdtrc(degrees, explained))
        together = _log_sum(values)
        tested = len({self._block[number, o] for o in range(len(values))})
        return ScoredEffect(
            candidate,
            int(option),
            SCALES[best],
            prior * (axes @ (along / (1.0 + size))),
            prior * np.sqrt(np.clip(1.0 - axes**2 @ (size / (1.0 + size)), 0.0, 1.0)),
            together,
            together - float(values[option, best] - odds[option, best]),
            log_likelihood,
            min(p * tested, 1.0),
        )

    def _at_scales(self, number: int, options: Sequence[int]) -> tuple[Floats, Floats]:
        """Return log Bayes factors (v, scales) of v variants with equally many coefficients, each alone.

        The second result is the largest sum of squares (v,) that each explains.
        """
        blocks = {self._block[number, option]: option for option in reversed(options)}
        new = {block: option for block, option in blocks.items() if block not in self._eigen_of}
        if new:
            additions = self.candidates[number].additions
            self._factor({block: additions[option].prior_sigma for block, option in new.items()})
        found = [self._eigen(number, option) for option in options]
        one, along_one = np.array([size for size, _, _ in found]), np.array([along for _, _, along in found])
        size, squares = one[:, None] * _SQUARED_SCALES, along_one[:, None] ** 2 * _SQUARED_SCALES
        values: Floats = 0.5 * (squares / (1.0 + size) - np.log1p(size)).sum(axis=2)
        seen = _is_seen(one)
        return values, (along_one**2 / np.where(seen, one, np.inf)).sum(axis=1)

    def _eigen(self, number: int, option: int) -> tuple[Floats, Floats, Floats]:
        """Return eigenvalues (k,) and eigenvectors (k, k) of a variant's G'G in prior sigmas, and G'r along these."""
        block = self._block[number, option]
        sigma = self.candidates[number].additions[option].prior_sigma
        if block in self._eigen_of:  # variants whose sigmas differ by a common factor have the same eigenvectors
            of, size, axes, along = self._eigen_of[block]
            factor = sigma[0] / of[0]
            if (np.abs(sigma - factor * of) <= _ROUNDING * factor * of).all():
                return size * factor**2, axes, along * factor
        self._factor({block: sigma})
        return self._eigen_of[block][1:]

    def _factor(self, sigma_of: Mapping[int, Floats]) -> None:
        """Compute the results of `_eigen` for several blocks with equally many columns at once, given prior sigmas."""
        sigma = np.array(list(sigma_of.values()))
        gram = np.array([self._products.product(block, block) for block in sigma_of])
        sizes, axes = np.linalg.eigh(gram * sigma[:, None] * sigma[:, :, None])
        for place, block in enumerate(sigma_of):
            along = axes[place].T @ (self._products.along(block) * sigma[place])
            self._eigen_of[block] = sigma[place], np.maximum(sizes[place], 0.0), axes[place], along


class ConditionalScores:
    """Scores of candidates given other candidates, whose products are factored once by `Screen.given`.

    Attributes:
        log_bayes_factor: log Bayes factor of the given candidates together against no effect; 0 for none.
    """

    def __init__(self, screen: Screen, blocks: Sequence[int], sigma: Floats) -> None:
        self._screen, self._others, self._sigma = screen, blocks, sigma
        self._factor = np.linalg.cholesky(np.eye(len(sigma)) + self._across(blocks) * sigma)
        self._along = self._solved(np.concatenate([np.empty(0), *map(screen._products.along, blocks)]) * sigma)
        self.log_bayes_factor = 0.5 * float(self._along @ self._along) - float(np.log(np.diag(self._factor)).sum())
        self._left: dict[int, tuple[Floats, Floats]] = {}

    def together(self, candidate: int, option: int, scale: float) -> float:
        """Return the log Bayes factor of a variant together with the given candidates against no effect.

        Args:
            candidate: number of the candidate.
            option: number of its variant.
            scale: factor on its plausible sizes.
        """
        block = self._screen._block[candidate, option]
        if block not in self._left:
            removed = self._solved(self._across([block]))
            own, along = self._screen._products.product(block, block), self._screen._products.along(block)
            self._left[block] = own - removed.T @ removed, along - removed.T @ self._along
        return self.log_bayes_factor + from_products(*self._left[block], self._screen._sigma(candidate, option, scale))

    def _across(self, blocks: Sequence[int]) -> Floats:
        """Return products (q, k) of the given candidates' columns, in prior sigmas, with those of some blocks."""
        rows = [np.hstack([self._screen._products.product(a, b) for b in blocks]) for a in self._others]
        if not rows:
            return np.empty((0, sum(len(self._screen._products.along(b)) for b in blocks)))
        stacked: Floats = np.vstack(rows) * self._sigma[:, None]
        return stacked

    def _solved(self, right: Floats) -> Floats:
        """Solve the triangular system of the factor for a right-hand side (q,) or (q, k)."""
        if not len(right):
            return right
        return np.asarray(solve_triangular(self._factor, right, lower=True, check_finite=False))


def _log_sum(values: Floats | Sequence[float]) -> float:
    """Return the logarithm of a sum of exponentials; SciPy's function is a hundred times slower for few values."""
    return float(np.logaddexp.reduce(np.ravel(values)))


def _explained(size: Floats, along: Floats) -> tuple[float, int]:
    """Return the squares that columns explain and their rank, from eigenvalues (k,) of G'G and G'r along these."""
    seen = _is_seen(size)
    return float((along[seen] ** 2 / size[seen]).sum()), int(seen.sum())


def _is_seen(size: Floats) -> NDArray[np.bool_]:
    """Return a mask of the rising eigenvalues (..., k) that are above rounding errors."""
    return size > _SEEN * np.maximum(size[..., -1:], _TINY)


def by_family(scored: Iterable[ScoredEffect]) -> dict[str, float]:
    """Return family -> posterior summed over its places, at most 1, greatest first."""
    found: dict[str, float] = {}
    for w in scored:
        found[w.candidate.family] = min(1.0, found.get(w.candidate.family, 0.0) + w.posterior)
    return dict(sorted(found.items(), key=lambda item: -item[1]))
