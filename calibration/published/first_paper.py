"""The first paper's identification (Zhou et al. 2022): its parallel differential evolution without refinement.

The unknowns are the constants of the rows (38 for the boom). Base and unknown prism offsets keep the values of the
nominal model, as the paper assumes both known. The paper does not give its bounds: here they are multiples of the rig's
build tolerances, which the prior determines. The result of the search is not refined locally.
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
_SHARE = 0.8  # share of the poses in each repeat


def pde_paper(rig: Rig, observations: Observations, *, prior: Prior, run: Run) -> Solution:
    """Identify the rows' constants by the paper's search; every prism has the same weight in Eq. 19.

    Args:
        rig: the rig description.
        observations: rows with positions.
        prior: determines the width of the bounds (`bounds`).
        run: settings of the search, as for `evolve_paper`.

    Raises:
        DataError: a prism that the rig lacks.
        UnsafeError: a base that cannot be determined, mirrored coordinates, or too few fixes for the unknowns.
    """
    run.progress(0.0, "placing the base")
    chain, samples, start = place(rig, observations)
    refuse_mirrored(chain, samples)
    nominal = refine(chain, samples, start.x, free=np.isinf(chain.prior_sigma))
    refuse_turning(chain, samples, nominal.x)
    rows = np.array([p.kind == "row" for p in chain.parameters])
    different = different_fixes(chain, samples)
    if 3 * different < rows.sum():
        raise UnsafeError(
            f"{different} different poses cannot determine {rows.sum()} constants of the rows; measure more poses"
        )
    objective = _objective(chain, samples, rows, nominal.x)
    evolved = search(objective, bounds(chain, prior)[rows], run=run.part(0.05, 0.9))
    x = nominal.x.copy()
    x[rows] = evolved.x
    fit = posterior(chain, samples, x, prior=prior)
    warnings = evolved.warnings
    if not evolved.complete:
        warnings += ("the search was stopped before its end; the result is the best candidate until then",)
    left_mm, tolerated_mm = rms_left_mm(chain, samples, x), rms_tolerated_mm(chain, samples, nominal)
    if left_mm > tolerated_mm:
        warnings += (
            f"the error after the search is {left_mm:.0f} mm RMS, but build tolerances explain only "
            f"{tolerated_mm:.0f} mm before any fit: the search has not converged, or the data are not of this rig; "
            f"--method default shows which",
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
    """Return (p,) the largest absolute value of every parameter in the search, mm or rad.

    The bounds are four build tolerances. With the prior `as-built` they are 60 tolerances of a length and 30 of an
    angle (300 mm and 6 degrees for the boom).

    Args:
        chain: kinematics.
        prior: determines the width of the bounds.
    """
    return np.array([p.prior_sigma * _WIDTH[prior][p.unit] for p in chain.parameters])


def search(
    objective: PaperObjective,
    width: NDArray[np.float64],
    *,
    run: Run,
    settings: PaperSettings | None = None,
) -> Evolved:
    """Search the free parameters of an objective as the paper does: repeatedly, on shuffled data.

    Args:
        objective: the objective.
        width: (k,) bounds of the free parameters, from -width to width.
        run: settings of the search, as for `evolve_paper`.
        settings: settings of the evolution; the paper's by default.

    Raises:
        DataError: a weighted prism without a fix, or no pose with both prisms of the attitude.
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
    """Return Eq. 19 with equal weights; it has the attitude if two prisms of one frame were measured in a same pose."""
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
