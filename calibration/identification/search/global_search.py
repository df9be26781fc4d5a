"""Global search: differential evolution within a multiple of the build tolerances, on a part of the data."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calibration.identification.linear_model import prior_precision
from calibration.identification.refinement import Prior
from calibration.identification.samples import Samples
from calibration.identification.search.islands import Evolved, Settings, evolve
from calibration.identification.start import PRIOR_SCALE, draw_rows
from calibration.kinematics.chain import Chain
from calibration.kinematics.fitness import Fitness
from calibration.observations import Floats
from calibration.run_settings import Run

_SEARCH_ROWS = 400  # enough to distinguish basins of attraction
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


def search_globally(
    chain: Chain,
    samples: Samples,
    nominal: Floats,
    local: Floats,
    scale_mm: float,
    prior: Prior,
    run: Run,
) -> tuple[Floats | None, Evolved]:
    """Search for a start for the refinement that is better than the local optimum.

    Args:
        chain: kinematics.
        samples: rows.
        nominal: (p,) centre of the search.
        local: (p,) local optimum.
        scale_mm: robust size of the misfit at the centre.
        prior: determines the width of the search.
        run: as for `evolve`.

    Returns:
        A better start (p,), or None if nothing is better than the local optimum; and the result of the search.
    """
    rows = draw_rows(samples.data, samples.position_mm, _SEARCH_ROWS, run.seed)
    searched = samples.select(rows)
    data, position = searched.data, searched.position_mm
    lin = chain.linearise(nominal, data)
    # Noise far below the misfit would make the basin too narrow to find; the refinement uses the true noise.
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
        nominal - width,
        nominal + width,
        run=run,
        settings=Settings(evaluations=_EVALUATIONS_PER_PARAMETER * len(chain)),
        start=nominal[None],
    )
    better = evolved.cost < float(penalised(local[None])[0])
    return evolved.x if better else None, evolved
