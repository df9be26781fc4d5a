"""Constants that a rig file holds fixed although the data show that they are off, such as the tilt of parallel axes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calibration.identification.judgement import known_variance
from calibration.identification.refinement import Fit, Prior, refine
from calibration.identification.samples import Samples
from calibration.kinematics import ROW_ORDER, Chain

_NOTABLE = 0.1  # of the sigma that instruments account for: what is left beyond it
_BETTER = 10.0  # in log evidence
_LESS = 0.5  # of what is left beyond the noise
_SIGNIFICANT = 4.0  # standard errors


def held_fixed(chain: Chain, samples: Samples, fit: Fit, prior: Prior) -> Iterator[str]:
    """Say which constants these are, where correcting them too would explain most of what is left.

    Args:
        chain: kinematics with what the rig file identifies.
        samples: what was fitted.
        fit: of them.
        prior: how the build tolerances were used.
    """
    if fit.excess_variance < _NOTABLE**2 * known_variance(chain, samples, fit):
        return
    rig = chain.rig
    constants = tuple(constant for constant, _ in ROW_ORDER[rig.convention])
    rows = tuple(row.model_copy(update={"identify": constants}) for row in rig.rows)
    whole = chain.of(rig.model_copy(update={"rows": rows}))
    found = dict(zip((p.name for p in chain.parameters), fit.x.tolist(), strict=True))
    other = refine(whole, samples, np.array([found.get(p.name, 0.0) for p in whole.parameters]), prior=prior)
    if other.cost > fit.cost - _BETTER or other.excess_variance > _LESS**2 * fit.excess_variance:
        return
    off = np.abs(other.x) > _SIGNIFICANT * np.sqrt(np.diag(other.covariance))
    names = [p.name for p, is_off in zip(whole.parameters, off, strict=True) if is_off and p.name not in found]
    if names:
        left_mm, less_mm = np.sqrt([fit.excess_variance, other.excess_variance])
        yield (
            f"the rig file does not let calibration correct {', '.join(names)}, which the data show to be off: "
            f"{left_mm:.2g} mm per axis are left beyond the noise, and {less_mm:.2g} with them corrected; name them in "
            f"identify, or leave it out at their rows"
        )
