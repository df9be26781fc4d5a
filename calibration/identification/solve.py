"""The whole identification: start in closed form, search globally, finish locally, say what stays unknown."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calibration.errors import UnsafeError
from calibration.identification.evolution import Settings, evolve
from calibration.identification.identifiability import Identifiability, identifiability
from calibration.identification.refinement import Fit, prior_precision, refine
from calibration.identification.samples import Samples, averaged, reading_covariance
from calibration.identification.start import Start, rough_start
from calibration.identification.turned import turned_start
from calibration.kernels import Fitness
from calibration.kinematics import Chain, Placement
from calibration.observations import Floats, Observations
from calibration.rig import Rig

Progress = Callable[[float, str], None]

_SEARCH_ROWS = 400  # enough to tell basins apart
_SEARCH_WIDTH = {"recalibration": 4.0, "as-built": 60.0}  # half-width of the search in build tolerances
_SEARCH_PRIOR = {"recalibration": 1.0, "as-built": 30.0}
_EVALUATIONS_PER_PARAMETER = 200
_BETTER = 1.0  # in log evidence; less is rounding
_SUSPICIOUS = 0.3  # mean error after the fit over what build tolerances explain before it
_DISCARDED = 1.0 / 3.0  # share of the fixes
_DISCARDED_OF_PRISM = 0.8
_LEAST_DISCARDED = 5
_FOREIGN = 2.0  # misfit after the fit over what build tolerances explain before it


@dataclass(frozen=True)
class Solution:
    """Result of `solve`.

    Attributes:
        chain: kinematics with the bases placed.
        samples: what was fitted.
        nominal: base and unknown prism offsets alone.
        fit: everything.
        identifiability: what the data see.
        search: how the global search and the local one from the nominal model compare, in words.
        tolerated_mm: RMS 3-D error that build tolerances explain before any fit.
    """

    chain: Chain
    samples: Samples
    nominal: Fit
    fit: Fit
    identifiability: Identifiability
    search: str
    tolerated_mm: float


@dataclass(frozen=True)
class PenalisedFitness:
    """Robust squared errors plus the prior's: -2 log posterior, up to a constant. Picklable."""

    fitness: Fitness
    precision: Floats

    def __call__(self, population: Floats) -> Floats:
        cost: Floats = self.fitness(population) + population**2 @ self.precision
        return cost


def place(rig: Rig, observations: Observations) -> tuple[Chain, Samples, Start]:
    """The chain with every set-up's base placed, the rows to fit and the rough start.

    Raises:
        DataError, UnsafeError: as `averaged` and `rough_start`.
    """
    setups = sorted(set(observations.setup.tolist()))
    blank = Chain(rig, {setup: Placement.identity() for setup in setups})
    samples = averaged(blank, observations)
    start = rough_start(blank, samples, np.zeros(len(blank)))
    return Chain(rig, start.placements), samples, start


def solve(
    rig: Rig,
    observations: Observations,
    *,
    prior: Literal["recalibration", "as-built"],
    seed: int,
    executor: Executor,
    progress: Progress,
) -> Solution:
    """Identify all parameters of a rig.

    Raises:
        DataError: a prism that the rig lacks.
        UnsafeError: too few fixes, a set-up whose base cannot be placed, mirrored coordinates, another rig's data.
    """
    setups = len(set(observations.setup.tolist()))
    parameters = len(Chain(rig, {})) + 6 * setups
    needed = math.ceil(parameters / 3)
    progress(0.0, "placing the base")
    if len(observations) < needed:
        raise UnsafeError(
            f"{len(observations)} fixes cannot determine {parameters} parameters; measure at least {needed}"
        )
    chain, samples, start = place(rig, observations)
    if len(samples) < needed:
        raise UnsafeError(
            f"{len(observations)} fixes are repeats of {len(samples)} different ones, which cannot determine "
            f"{parameters} parameters; measure at least {needed} different ones"
        )
    flat = np.isinf(chain.prior_sigma)
    nominal = refine(chain, samples, start.x, free=flat)
    progress(0.1, "refining")
    fit = refine(chain, samples, nominal.x, prior=prior)
    search = "the global search found nothing better than where the nominal model leads"
    progress(0.3, "searching globally")
    found = _search(chain, samples, nominal, fit, start.scale_mm, prior, seed, executor, progress)
    if found is not None:
        progress(0.75, "refining")
        distant = refine(chain, samples, found, prior=prior)
        if distant.cost < fit.cost - _BETTER:
            fit, search = distant, "the global search found a better optimum than the nominal model leads to"
    tolerated_mm = _tolerated_mm(chain, samples, nominal)
    if prior == "as-built" and _mean_error_mm(chain, samples, fit) > _SUSPICIOUS * tolerated_mm:
        progress(0.8, "trying turned joints")
        blank = Chain(rig, {setup: Placement.identity() for setup in chain.setups})
        at, turned = turned_start(blank, chain, samples)
        if turned:
            other = refine(chain, samples, at, prior=prior)
            if other.cost < fit.cost - _BETTER:
                fit, search = other, f"a start with {', '.join(turned)} turned by quarters led to a better optimum"
    _refuse_foreign(chain, samples, fit, tolerated_mm, prior)
    _refuse_discarded(rig, samples, fit, prior)
    progress(0.9, "checking what the data determine")
    seen = identifiability(chain, samples, nominal.x, fit.excess_variance)
    return Solution(chain, samples, nominal, fit, seen, search, tolerated_mm)


def _search(
    chain: Chain,
    samples: Samples,
    nominal: Fit,
    local: Fit,
    scale_mm: float,
    prior: Literal["recalibration", "as-built"],
    seed: int,
    executor: Executor,
    progress: Progress,
) -> Floats | None:
    """A start for the refinement that is better than where the local one ended, if there is one."""
    rows = np.arange(len(samples))
    if len(rows) > _SEARCH_ROWS:
        rows = np.sort(np.random.default_rng(seed).permutation(rows)[:_SEARCH_ROWS])
    data, position = samples.data.select(rows), samples.position_mm[rows]
    lin = chain.linearise(nominal.x, data)
    known = samples.station_covariance[rows] + reading_covariance(chain.rig, lin.joint_jacobian, samples.rates[rows])
    # Noise far below the misfit would make the basin a needle's eye; the refinement has the true noise.
    variance = float(np.trace(known, axis1=1, axis2=2).mean()) / 3.0 + (scale_mm / 30.0) ** 2
    weight = np.full(len(rows), 1.0 / variance)
    fitness = Fitness.build(chain, data, position, weight, robust_scale=4.0 * scale_mm / math.sqrt(variance))
    reach = max(float(np.median(np.linalg.norm(position - position.mean(axis=0), axis=1))), 1.0)
    flat_width = {"mm": 4.0 * scale_mm, "rad": min(0.5, 4.0 * scale_mm / reach)}
    flat = np.isinf(chain.prior_sigma)
    width = np.where(flat, [flat_width[p.unit] for p in chain.parameters], chain.prior_sigma * _SEARCH_WIDTH[prior])
    precision = np.where(flat, 0.0, prior_precision(chain, _SEARCH_PRIOR[prior]))
    penalised = PenalisedFitness(fitness, precision)
    evolved = evolve(
        penalised,
        nominal.x - width,
        nominal.x + width,
        seed=seed,
        executor=executor,
        settings=Settings(evaluations=_EVALUATIONS_PER_PARAMETER * len(chain)),
        start=nominal.x[None],
        progress=lambda share: progress(0.3 + 0.45 * share, "searching globally"),
    )
    return evolved.x if evolved.cost < float(penalised(local.x[None])[0]) else None


def _tolerated_mm(chain: Chain, samples: Samples, nominal: Fit) -> float:
    """RMS 3-D error of the nominal model that build tolerances explain."""
    lin = chain.linearise(nominal.x, samples.data)
    sigma = np.where(np.isinf(chain.prior_sigma), 0.0, chain.prior_sigma)
    return math.sqrt(float(((lin.jacobian * sigma) ** 2).sum() / len(samples)))


def _mean_error_mm(chain: Chain, samples: Samples, fit: Fit) -> float:
    """Mean 3-D error of all samples, discarded ones too."""
    error = samples.position_mm - chain.positions_mm(fit.x, samples.data)
    return float(np.linalg.norm(error, axis=1).mean())


def _refuse_foreign(
    chain: Chain, samples: Samples, fit: Fit, tolerated_mm: float, prior: Literal["recalibration", "as-built"]
) -> None:
    """Errors that build tolerances cannot explain even before calibration mean another machine or wrong columns."""
    error = samples.position_mm - chain.positions_mm(fit.x, samples.data)
    left = math.sqrt(float(fit.weight @ (error**2).sum(axis=1) / fit.weight.sum()))
    if left > _FOREIGN * tolerated_mm:
        hint = "" if prior == "as-built" else "; if the nominal model is that far off, use --prior as-built"
        raise UnsafeError(
            f"after the fit the fixes are still {left:.0f} mm RMS off, outliers aside, where this rig's build "
            f"tolerances explain {tolerated_mm:.0f} mm even before it: another rig's data, exchanged columns or other "
            f"units{hint}"
        )


def _refuse_discarded(rig: Rig, samples: Samples, fit: Fit, prior: Literal["recalibration", "as-built"]) -> None:
    """A fit that holds only because it left out much of the data, or nearly all of a prism, is no fit of the data."""
    discarded = fit.weight < 0.5
    for prism, name in enumerate(rig.prism_names):
        own = discarded[samples.data.prism == prism]
        if own.sum() >= _LEAST_DISCARDED and own.mean() > _DISCARDED_OF_PRISM:
            hint = "" if prior == "as-built" else "; --prior as-built also tries joints that are mounted turned"
            raise UnsafeError(
                f"the fit had to leave out {own.sum()} of the {len(own)} fixes of prism {name!r}, so it would be wrong "
                f"there: check which prism was measured, its offset, and zero and sign of the joints before it{hint}"
            )
    if discarded.mean() > _DISCARDED:
        raise UnsafeError(
            f"the fit had to leave out {discarded.sum()} of {len(discarded)} fixes, so it describes a part of the data "
            f"only: check columns, units and zeros of the joints, and the station's set-up"
        )
