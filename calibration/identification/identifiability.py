"""What the data cannot see: singular values of the whitened Jacobian, each parameter measured in prior sigmas.

The prior itself takes no part: a direction counts as seen where the data alone would determine it within ten prior
sigmas. Everything else stays at its prior and is named, redundant parameters with what they repeat.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.identification.samples import Samples, reading_covariance
from calibration.kinematics import Chain
from calibration.observations import Floats

_SEEN = 0.1
_FLAT_SIGMA = {"mm": 1e3, "rad": 1.0}
_PART = 0.05  # smallest share of a combination that is worth naming
_NAMED = 4


@dataclass(frozen=True)
class Identifiability:
    """How much of the parameters the data determine.

    Attributes:
        parameters: how many there are.
        rank: how many directions of them the data see.
        unidentifiable: one sentence for each direction they do not see.
    """

    parameters: int
    rank: int
    unidentifiable: tuple[str, ...]

    def as_dict(self) -> dict[str, object]:
        """The contract's JSON object."""
        return {"parameters": self.parameters, "rank": self.rank, "unidentifiable": list(self.unidentifiable)}


def identifiability(chain: Chain, samples: Samples, x: Floats, excess_variance: float) -> Identifiability:
    """Rank and null space at parameters `x` (p,)."""
    lin = chain.linearise(x, samples.data)
    covariance = samples.station_covariance + reading_covariance(chain.rig, lin.joint_jacobian, samples.rates)
    covariance = covariance + excess_variance * np.eye(3)
    sigma = np.where(np.isinf(chain.prior_sigma), [_FLAT_SIGMA[p.unit] for p in chain.parameters], chain.prior_sigma)
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), lin.jacobian * sigma).reshape(-1, len(chain))
    # The triangle has the singular values of the whole, at a fraction of the cost.
    _, singular, vt = np.linalg.svd(np.linalg.qr(whitened, mode="r"), full_matrices=True)
    rank = int((singular > _SEEN).sum())
    return Identifiability(len(chain), rank, _sentences(chain, vt[rank:], np.linalg.norm(whitened, axis=0)))


def _sentences(chain: Chain, null: Floats, effect: Floats) -> tuple[str, ...]:
    """Bring the null space (k, p) to reduced echelon form: each row is one parameter and what it repeats.

    Parameters are weighed by their `effect` (p,), the length of their columns, so that what a combination moves
    counts and not the unit it is in.
    """
    blind = effect <= _SEEN
    # Blind parameters span part of the null space by themselves; the rest of it is orthogonal to them.
    rest = _row_space(null[:, ~blind], len(null) - int(blind.sum()))
    names = [p.name for p, unseen in zip(chain.parameters, blind, strict=True) if not unseen]
    found = [
        f"{p.name}: the data say nothing of it" for p, unseen in zip(chain.parameters, blind, strict=True) if unseen
    ]
    rows = rest * effect[~blind]
    pivots: list[int] = []
    for k in range(len(rows)):
        size = np.abs(rows[k:])
        # The last parameter that weighs enough gives way: earlier rows are what people look for.
        enough = size.max(axis=0) >= 0.5 * size.max()
        enough[pivots] = False
        pivot = int(np.flatnonzero(enough)[-1])
        best = k + int(size[:, pivot].argmax())
        rows[[k, best]] = rows[[best, k]]
        rows[k] /= rows[k, pivot]
        for other in range(len(rows)):
            if other != k:
                rows[other] -= rows[other, pivot] * rows[k]
        pivots.append(pivot)
    for row, pivot in zip(rows, pivots, strict=True):
        order = np.argsort(-np.abs(row), kind="stable").tolist()
        others = [names[i] for i in order if i != pivot and abs(row[i]) > _PART]
        more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
        found.append(f"{names[pivot]}: repeats {', '.join(others[:_NAMED])}{more}")
    return tuple(sorted(found))


def _row_space(rows: Floats, rank: int) -> Floats:
    """(rank, p) orthonormal basis of the strongest directions of (k, p) rows."""
    return np.linalg.svd(rows, full_matrices=False)[2][:rank]
