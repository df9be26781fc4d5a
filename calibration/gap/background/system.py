"""Kinematics, background and candidate effects as one linear model at a fit, evaluated by products of its columns."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular

from calibration.effects.columns import EffectColumns
from calibration.gap.background.blocks import Block
from calibration.gap.background.evidence import Products, Scales, maximise_evidence, posterior_factor
from calibration.gap.candidates import CandidateEffect
from calibration.gap.projected.projection import Projection
from calibration.gap.screening import ScoredEffect, Screen
from calibration.observations import Floats

Integers = NDArray[np.intp]

Chosen = tuple[int, int, float]  # number of a candidate, its variant, scale of plausible sizes
Effect = tuple[CandidateEffect, int, float]

_ENOUGH, _NEARLY = 0.01, 0.1  # tolerances of a log evidence; only differences of several units matter
_START, _AGAIN = -1.0, -3.0  # initial log scale of a block, and of a block that had vanished
_AT_ONCE = 3000  # rows per batch
_GONE = -5.0  # log scale below which a block has vanished
_NEGLIGIBLE = 0.01  # information of the data about a block below which it is negligible, nats
_SEEN = 1e-10  # smallest eigenvalue of products of columns that counts, relative to the largest


@dataclass(frozen=True)
class Model:
    """A model of the system: its effects, and the scales of its background.

    Attributes:
        effects: (candidate, variant, scale) of each effect.
        scales: scales of background and noise.
    """

    effects: tuple[Chosen, ...]
    scales: Scales

    @property
    def log_evidence(self) -> float:
        """Log evidence, up to a constant that depends only on the rows."""
        return self.scales.log_evidence

    def without(self, number: int) -> tuple[Chosen, ...]:
        """Return the effects without the one of this number."""
        return self.effects[:number] + self.effects[number + 1 :]


class System:
    """A linear model at a fit.

    Args:
        projection: projection at the fit; its kinematics are those of the model.
        blocks: blocks of the background.
        candidates: effects that may be part of the model.
        least_noise: smallest noise variance, relative to that used for whitening.

    Attributes:
        projection, candidates: as above.
        blocks: name -> block of the background.
        products: products of all whitened columns, in prior sigmas.
    """

    def __init__(
        self, projection: Projection, blocks: Sequence[Block], candidates: Sequence[CandidateEffect], least_noise: float
    ) -> None:
        self.projection, self.candidates = projection, tuple(candidates)
        self.blocks = {block.name: block for block in blocks}
        self._number = {str(candidate): number for number, candidate in enumerate(self.candidates)}
        parts, count = list[EffectColumns](), projection.kinematics.shape[1]
        self._kinematics: Integers = np.arange(count)
        self._of_block: dict[str, Integers] = {}
        self._of_option: dict[tuple[int, int], Integers] = {}
        for name, block in self.blocks.items():
            parts.append(block.columns)
            self._of_block[name] = np.arange(count, count := count + len(parts[-1]))
        for number, candidate in enumerate(self.candidates):
            for option, first in enumerate(candidate.first_equal):
                if first == option:
                    parts.append(candidate.additions[option])
                    self._of_option[number, option] = np.arange(count, count := count + len(parts[-1]))
                self._of_option[number, option] = self._of_option[number, first]
        self.columns, target = np.empty((len(projection.target), count)), projection.target
        self.columns[:, : len(self._kinematics)] = projection.kinematics
        first = len(self._kinematics)
        for part in parts:
            self.columns[:, first : (first := first + len(part))] = self._whitened(part)
        self.products = Products(
            self.columns.T @ self.columns,
            self.columns.T @ target,
            float(target @ target),
            len(target),
            least_noise,
        )

    def _whitened(self, additions: EffectColumns) -> Floats:
        return self.projection.whitened(self.projection.moved_mm(additions)) * additions.prior_sigma

    def of_rows(self, rows: Integers) -> System:
        """Return the same system for some of the whitened rows (r,) only: their products, without columns."""
        out = copy(self)
        out.columns = self.columns[:0]
        gram, along = np.zeros_like(self.products.gram), np.zeros_like(self.products.along)
        target = self.projection.target
        for first in range(0, len(rows), _AT_ONCE):  # a copy of half the rows of all columns would be 100 MB
            some = rows[first : first + _AT_ONCE]
            columns = self.columns[some]
            gram += columns.T @ columns
            along += columns.T @ target[some]
        out.products = Products(gram, along, float(target[rows] @ target[rows]), len(rows), self.products.least_noise)
        return out

    def chosen(self, effects: Sequence[Effect]) -> list[Chosen]:
        """Return effects with candidates given by number."""
        return [(self._number[str(candidate)], option, scale) for candidate, option, scale in effects]

    def choice(self, scored: ScoredEffect) -> Chosen:
        """Return a scored candidate in its best variant and scale."""
        return self._number[str(scored.candidate)], scored.option, scored.scale

    def fit(
        self,
        effects: Sequence[Chosen],
        start: Scales | None,
        *,
        without: Collection[str] = (),
        quick: bool = False,
    ) -> Model:
        """Return the model with the given effects and the background of maximum evidence.

        Args:
            effects: (candidate, variant, scale) of each effect.
            start: initial scales; plausible ones by default.
            without: names of blocks to leave out.
            quick: True for a looser tolerance that suffices to compare models, and without blocks that have vanished.
        """
        log_scale = dict.fromkeys(self._of_block, _START if start is None else _AGAIN)
        log_scale |= {} if start is None else start.log_scale
        blocks = {
            name: own
            for name, own in self._of_block.items()
            if name not in without and (not quick or log_scale[name] > _GONE)
        }
        fixed, sigma = self._fixed(effects)
        noise = 1.0 if start is None else start.noise
        scales = maximise_evidence(self.products, fixed, sigma, blocks, log_scale, noise, _NEARLY if quick else _ENOUGH)
        return Model(tuple(effects), scales)

    def negligible_blocks(self, model: Model) -> frozenset[str]:
        """Return the names of blocks so small in a model that the data have almost no information about them."""
        factor, diagonal = 0.5 / model.scales.noise, np.diag(self.products.gram)
        return frozenset(
            name
            for name, log_scale in model.scales.log_scale.items()
            if factor * math.exp(2.0 * log_scale) * float(diagonal[self._of_block[name]].sum()) < _NEGLIGIBLE
        )

    def background_log_bayes_factor(self, model: Model) -> float:
        """Return the log Bayes factor of a model's background against noise alone.

        The scales maximise the evidence, so the result is slightly above zero even without any structure.
        """
        return model.log_evidence - self.fit(model.effects, None, without=self.blocks).log_evidence

    def at(self, effects: Sequence[Chosen], scales: Scales) -> Model:
        """Return the model with the given effects at unchanged scales."""
        fixed, sigma = self._fixed(effects)
        return Model(tuple(effects), replace(scales, fixed=fixed, fixed_sigma=sigma))

    def _fixed(self, effects: Sequence[Chosen]) -> tuple[Integers, Floats]:
        """Return the indices (f,) of the columns of kinematics and effects, and the factors (f,) on their sigmas."""
        index, sigma = [self._kinematics], [np.ones(len(self._kinematics))]
        for number, option, scale in effects:
            own = self.candidates[number]
            unit = own.additions[own.first_equal[option]].prior_sigma
            index.append(self._of_option[number, option])
            sigma.append(own.additions[option].prior_sigma / unit * scale)
        return np.concatenate(index).astype(np.intp), np.concatenate(sigma)

    def amounts(self, model: Model) -> Floats:
        """Return the posterior means (t,) of the amplitudes of all columns, in prior sigmas; 0 if not in the model."""
        index, weight = model.scales.index, model.scales.weight
        factor = posterior_factor(self.products.gram[np.ix_(index, index)] * (weight * weight[:, None]))
        out = np.zeros(len(self.products.along))
        out[index] = weight * cho_solve((factor, True), weight * self.products.along[index])
        return out

    def residual(self, model: Model) -> Floats:
        """Return the whitened residuals (3 m,) of a model's posterior mean."""
        left: Floats = self.projection.target - self.columns @ self.amounts(model)
        return left

    def of_block(self, name: str) -> Integers:
        """Return the indices of the columns of a block."""
        return self._of_block[name]

    def of_effect(self, effect: Chosen) -> Integers:
        """Return the indices of the columns of an effect."""
        return self._of_option[effect[0], effect[1]]

    def screen(self, model: Model) -> Screen:
        """Return a screen of the candidates that a model lacks, given the model."""
        there = {number for number, _, _ in model.effects}
        numbers = [number for number in range(len(self.candidates)) if number not in there]
        candidates = [self.candidates[number] for number in numbers]
        distinct = [
            (number, option)
            for number in numbers
            for option, first in enumerate(self.candidates[number].first_equal)
            if first == option
        ]
        return Screen(self.projection, candidates, _GivenModel(self, model, distinct))

    def explained(self, model: Model, effect: Chosen) -> tuple[float, int, float]:
        """Return the largest part of a model's residual squares that an effect explains, its rank, and all squares.

        If the model is true, both sums of squares are chi-square distributed, up to the error of the model's noise.
        """
        own = _GivenModel(self, model, [effect[:2]])
        size, axes = np.linalg.eigh(own.product(0, 0))
        seen = size > _SEEN * max(float(size[-1]), _SEEN)
        squares = float(((axes.T @ own.along(0))[seen] ** 2 / size[seen]).sum())
        return squares, int(seen.sum()), own.squares


class _GivenModel:
    """Products of the columns of variants with a model projected out, in the form that `Screen` requires."""

    def __init__(self, system: System, model: Model, variants: Sequence[tuple[int, int]]) -> None:
        index, weight, root = model.scales.index, model.scales.weight, math.sqrt(model.scales.noise)
        gram, along = system.products.gram, system.products.along
        factor = posterior_factor(gram[np.ix_(index, index)] * (weight * weight[:, None]))
        of_variant = [system.of_effect((number, option, 1.0)) for number, option in variants]
        columns = np.concatenate([np.empty(0, dtype=np.intp), *of_variant])
        prior = [system.candidates[number].additions[option].prior_sigma for number, option in variants]
        unit = np.concatenate([np.empty(0), *prior]) * root
        removed = solve_triangular(factor, weight[:, None] * gram[np.ix_(index, columns)], lower=True) / unit
        left = solve_triangular(factor, weight * along[index], lower=True)
        self._gram = gram[np.ix_(columns, columns)] / (unit * unit[:, None]) - removed.T @ removed
        self._along = along[columns] / (unit * root) - removed.T @ left / root
        self.squares = (system.products.squares - float(left @ left)) / model.scales.noise
        ends = np.cumsum([0, *map(len, of_variant)]).tolist()
        self._slices = [slice(a, b) for a, b in itertools.pairwise(ends)]

    def along(self, block: int) -> Floats:
        own: Floats = self._along[self._slices[block]]
        return own

    def product(self, a: int, b: int) -> Floats:
        own: Floats = self._gram[self._slices[a], self._slices[b]]
        return own
