"""The global search: differential evolution within a multiple of the build tolerances, on a part of the data."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from calibration.identification.approach import PRIOR_SCALE
from calibration.identification.refinement import Fit, Prior, prior_precision
from calibration.identification.samples import Samples
from calibration.identification.search.checkpoint import Checkpoint
from calibration.identification.search.islands import Settings, evolve
from calibration.identification.subset import drawn
from calibration.kernels import Fitness
from calibration.kinematics import Chain
from calibration.observations import Floats

_SEARCH_ROWS = 400  # enough to tell basins apart
_SEARCH_WIDTH = {"recalibration": 4.0, "as-built": 60.0}  # half-width of the search in build tolerances
_EVALUATIONS_PER_PARAMETER = 200


@dataclass(frozen=True)
class PenalisedFitness:
    """Robust squared errors plus the prior's: -2 log posterior, up to a constant. Picklable."""

    fitness: Fitness
    precision: Floats

    def __call__(self, population: Floats) -> Floats:
        cost: Floats = self.fitness(population) + population**2 @ self.precision
        return cost


@dataclass(frozen=True)
class Found:
    """Result of `search_globally`.

    Attributes:
        x: (p,) a better start; None where nothing is better than where the local fit ended.
        complete: False if the search was stopped before its end.
        warnings: what went wrong with the checkpoint.
    """

    x: Floats | None
    complete: bool
    warnings: tuple[str, ...] = ()


def search_globally(
    chain: Chain,
    samples: Samples,
    nominal: Fit,
    local: Fit,
    scale_mm: float,
    prior: Prior,
    seed: int,
    executor: Executor,
    progress: Callable[[float, str], None],
    should_stop: Callable[[], bool] | None = None,
    checkpoint: Checkpoint | None = None,
) -> Found:
    """Look for a start for the refinement that is better than where the local one ended.

    Args:
        chain, samples: kinematics and rows.
        nominal: the middle of the search.
        local: the fit to beat.
        scale_mm: robust size of the misfit at the middle.
        prior: gives the width of the search.
        seed, executor, progress, should_stop, checkpoint: as `evolve`.
    """
    rows = drawn(samples.data, samples.position_mm, _SEARCH_ROWS, seed)
    searched = samples.select(rows)
    data, position = searched.data, searched.position_mm
    lin = chain.linearise(nominal.x, data)
    # Noise far below the misfit would make the basin a needle's eye; the refinement has the true noise.
    variance = searched.variance(chain.rig, lin.joint_jacobian) + (scale_mm / 30.0) ** 2
    weight = np.full(len(rows), 1.0 / variance)
    fitness = Fitness.build(chain, data, position, weight, robust_scale=4.0 * scale_mm / math.sqrt(variance))
    reach = max(float(np.median(np.linalg.norm(position - position.mean(axis=0), axis=1))), 1.0)
    flat_width = {"mm": 4.0 * scale_mm, "rad": min(0.5, 4.0 * scale_mm / reach)}
    flat = np.isinf(chain.prior_sigma)
    width = np.where(flat, [flat_width[p.unit] for p in chain.parameters], chain.prior_sigma * _SEARCH_WIDTH[prior])
    precision = np.where(flat, 0.0, prior_precision(chain, PRIOR_SCALE[prior]))
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
        should_stop=should_stop,
        checkpoint=checkpoint,
    )
    better = evolved.cost < float(penalised(local.x[None])[0])
    return Found(evolved.x if better else None, evolved.complete, evolved.warnings)
