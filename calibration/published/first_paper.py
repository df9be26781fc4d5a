"""The first paper's identification (Zhou et al. 2022): its parallel differential evolution and nothing after it.

The unknowns are the constants of the rows (the boom's 38); base and unknown prism offsets stay where the nominal model
puts them, as the paper knows both. The paper does not print its bounds: they follow the rig's build tolerances here,
and the prior decides how far. Its end result is taken as it is: no local refinement.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calibration.errors import UnsafeError
from calibration.identification.checks import different_fixes, refuse_turning, rms_left_mm, rms_tolerated_mm
from calibration.identification.identifiability import identifiability
from calibration.identification.refinement import Prior, posterior, refine
from calibration.identification.samples import Samples
from calibration.identification.search.islands import Evolved
from calibration.identification.solve import Solution, place
from calibration.identification.start import refuse_mirrored
from calibration.kinematics.chain import Chain
from calibration.observations import Observations
from calibration.published.paper_evolution import PaperSettings, evolve_paper
from calibration.published.paper_objective import PaperObjective
from calibration.rig.description import Rig
from calibration.run_settings import Run

_WIDTH: Mapping[Prior, Mapping[str, float]] = {  # half-width of the bounds in build tolerances
    "recalibration": {"mm": 4.0, "rad": 4.0},
    "as-built": {"mm": 60.0, "rad": 30.0},
}
_REPEATS = 2
_SHARE = 0.8  # of the poses that each repeat sees


def pde_paper(rig: Rig, observations: Observations, *, prior: Prior, run: Run) -> Solution:
    """Identify the rows' constants by the paper's search; every prism has the same weight in Eq. 19.

    Args:
        rig: the rig description.
        observations: rows with positions.
        prior: how wide the bounds are: four build tolerances, or what an uncalibrated machine needs.
        run: of the search, as `evolve_paper`.

    Raises:
        DataError: a prism that the rig lacks.
        UnsafeError: a base that cannot be placed, mirrored coordinates, fewer fixes than the unknowns need.
    """
    run.progress(0.0, "placing the base")
    chain, samples, start = place(rig, observations)
    refuse_mirrored(chain, samples)
    nominal = refine(chain, samples, start.x, free=np.isinf(chain.prior_sigma))
    refuse_turning(chain, samples, nominal.x)
    rows = np.array([p.kind == "row" for p in chain.parameters])
    different = different_fixes(chain, samples)
    if 3 * different < rows.sum():
        raise UnsafeError(f"{different} different fixes cannot determine {rows.sum()} constants of the rows")
    objective = _objective(chain, samples, rows, nominal.x)
    evolved = search(objective, bounds(chain, prior)[rows], run=run.part(0.05, 0.9))
    x = nominal.x.copy()
    x[rows] = evolved.x
    fit = posterior(chain, samples, x, prior=prior)
    warnings = evolved.warnings
    if not evolved.complete:
        warnings += ("the search was stopped before its end; the result is the best until then",)
    left_mm, tolerated_mm = rms_left_mm(chain, samples, x), rms_tolerated_mm(chain, samples, nominal)
    if left_mm > tolerated_mm:
        warnings += (
            f"the search ended {left_mm:.0f} mm RMS off, where build tolerances explain {tolerated_mm:.0f} mm before "
            f"any fit: it has not come to rest, or the data are not this rig's; --method default says which",
        )
    return Solution(
        chain,
        samples,
        nominal,
        fit,
        identifiability(chain, samples, x, fit.excess_variance),
        f"the first paper's differential evolution, {evolved.evaluations:,} evaluations, not refined",
        tolerated_mm,
        warnings,
    )


def bounds(chain: Chain, prior: Prior) -> NDArray[np.float64]:
    """(p,) how far from zero the search may take every parameter, mm or rad.

    Four build tolerances, or as built 60 of a length's and 30 of an angle's (the boom's 300 mm and 6 degrees).
    """
    return np.array([p.prior_sigma * _WIDTH[prior][p.unit] for p in chain.parameters])


def search(
    objective: PaperObjective,
    width: NDArray[np.float64],
    *,
    run: Run,
    settings: PaperSettings | None = None,
) -> Evolved:
    """The paper's search of an objective's free parameters within +-`width`: shuffled data, repeated.

    Arguments and errors as `pde_paper`; `settings` are the paper's by default.
    """
    return evolve_paper(
        [objective.fitness(part) for part in objective.shuffled(_REPEATS, _SHARE, run.seed)],
        objective.fitness(),
        -width,
        width,
        run=run,
        settings=settings or PaperSettings(),
    )


def _objective(chain: Chain, samples: Samples, rows: NDArray[np.bool_], at: NDArray[np.float64]) -> PaperObjective:
    """Eq. 19 with equal weights, and the attitude where two prisms of one frame were measured in the same poses."""
    names = chain.rig.prism_names
    present = [names[i] for i in np.unique(samples.data.prism)]
    pose = samples.standstill.astype(str)
    weight = dict.fromkeys(present, 1.0)
    attitude = next(
        (
            (first, second)
            for first, second in combinations(present, 2)
            if chain.rig.prism(first).frame == chain.rig.prism(second).frame
            and _poses(samples, pose, names.index(first)) & _poses(samples, pose, names.index(second))
        ),
        None,
    )
    return PaperObjective(chain, samples.data, samples.position_mm, pose, weight, attitude=attitude, free=rows, at=at)


def _poses(samples: Samples, pose: NDArray[np.str_], prism: int) -> set[str]:
    return set(pose[samples.data.prism == prism].tolist()) - {""}
