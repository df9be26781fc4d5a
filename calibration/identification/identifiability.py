"""Identifiability by the singular values of the whitened Jacobian, each parameter measured in prior sigmas.

The prior itself adds no information: a direction counts as seen if the data alone determine it within ten prior
sigmas. All others stay at their prior and are described in words: parameters that no fix depends on with the reason
if it is known, redundant ones with the parameters that they repeat.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calibration.effects.columns import EffectColumns
from calibration.identification.samples import Samples, standing_spread
from calibration.kinematics.chain import Chain, Linearisation
from calibration.numerics.statistics import halton
from calibration.observations import Floats

_SEEN = 0.1  # least singular value of a direction that the data see
_FLAT_SIGMA = {"mm": 1e3, "rad": 1.0}
_ALIKE = 0.9  # parameters that stay at their prior nearly as much as the one that stays most are equal candidates
_MARKED = 0.1  # share of a parameter's prior variance that the data leave
_PART = 0.05  # smallest share of a combination that is worth naming
_NAMED = 4  # parameters named one by one


@dataclass(frozen=True)
class Identifiability:
    """Number of parameters that the data determine, and names of those that they do not.

    Attributes:
        parameters: number of parameters analysed, including coefficients of effects in the same fit.
        rank: number of directions in their space that the data see.
        unidentifiable: one sentence for each direction that the data do not see.
        marked: names of the parameters of whose prior variance a tenth or more remains.
        observability: `O1` .. `O5`, larger is better (`observability_indices`); empty if the data see nothing.
    """

    parameters: int
    rank: int
    unidentifiable: tuple[str, ...]
    marked: tuple[str, ...] = ()
    observability: Mapping[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, object]:
        """Return the JSON object (docs/reference/formats.md, calibrate)."""
        return asdict(self)


@dataclass(frozen=True)
class _Asked:
    """The parameters under analysis."""

    names: tuple[str, ...]
    words: tuple[tuple[str, str], ...]  # each as the subject, and as one of several that are named together
    sigma: Floats  # of the prior
    columns: NDArray[np.intp]  # indices among parameters and coefficients


def identifiability(
    chain: Chain,
    samples: Samples,
    x: Floats,
    excess_variance: float,
    *,
    free: NDArray[np.bool_] | None = None,
    additions: EffectColumns | None = None,
    listed: NDArray[np.bool_] | None = None,
) -> Identifiability:
    """Find the rank of the parameters and describe their null space in words.

    Args:
        chain: kinematics.
        samples: m rows.
        x: (p,) parameters at which to linearise, (p + k,) if coefficients are not zero.
        excess_variance: variance that the scatter of the data adds to their covariance, mm^2 per axis.
        free: (p,) mask of the parameters to analyse, all by default. The others count as known (base and prisms, for
            example).
        additions: k coefficients of effects in the same fit.
        listed: (k,) mask of the coefficients to analyse, all by default. The others only shape a curve and count as
            known.
    """
    coefficients = 0 if additions is None else len(additions)
    at = np.concatenate([x, np.zeros(len(chain) + coefficients - len(x))])
    asked = _asked(chain, free, additions, np.ones(coefficients, dtype=bool) if listed is None else listed)
    whitened = _whitened(chain, samples, at, excess_variance, additions, asked)
    count, effect = len(asked.names), np.linalg.norm(whitened, axis=0)
    # R of the QR decomposition has the same singular values, at a fraction of the cost.
    _, singular, vt = np.linalg.svd(np.linalg.qr(whitened, mode="r"), full_matrices=True)
    rank = int((singular > _SEEN).sum())
    null = vt[rank:]
    sentences: list[str] = []
    if rank < count:
        moved = {
            joint: _whitened(chain, shown, at, excess_variance, additions, asked)
            for joint, shown in _with_still_joints_moved(chain, samples).items()
        }
        blind, combinations = _echelon(null, effect)
        for i in blind:
            reason = _why_blind(chain, samples, asked.names[i]) or _why(chain, moved, np.eye(count)[i])
            sentences.append(f"{asked.names[i]}: the data show nothing about {asked.words[i][0]}{reason}")
        for pivot, direction in combinations:
            sentences.append(_repeats(asked, pivot, direction * effect) + _why(chain, moved, direction))
    left = (null**2).sum(axis=0)
    return Identifiability(
        count,
        rank,
        tuple(sentences),
        tuple(name for name, share in zip(asked.names, left, strict=True) if share >= _MARKED),
        observability_indices(singular[:rank], len(samples)),
    )


def observability_indices(singular: Floats, measurements: int) -> dict[str, float]:
    """Return the five observability indices of a set of measurements.

    With the singular values s_1 >= ... >= s_r of the identification Jacobian, here whitened by the covariance of the
    fixes and in prior sigmas of each parameter, so that all are dimensionless:

        O1 = (s_1 s_2 ... s_r)^(1/r) / sqrt(m)   Borm and Menq (1991): volume of the confidence ellipsoid (D-optimal)
        O2 = s_r / s_1                           Driels and Pathre (1990): its eccentricity (condition number)
        O3 = s_r                                 Nahvi, Hollerbach and Hayward (1994): its longest axis (E-optimal)
        O4 = s_r^2 / s_1                         Nahvi and Hollerbach (1996): amplification of noise
        O5 = 1 / (1/s_1 + ... + 1/s_r)           Sun and Hollerbach (2008): sum of its axes (near A-optimal)

    Args:
        singular: (r,) positive singular values, in descending order, of the directions that the data see.
        measurements: m, number of fixes.

    Returns:
        `O1` .. `O5`; empty for r = 0.
    """
    if len(singular) == 0:
        return {}
    largest, smallest = float(singular[0]), float(singular[-1])
    return {
        "O1": math.exp(float(np.log(singular).mean())) / math.sqrt(measurements),
        "O2": smallest / largest,
        "O3": smallest,
        "O4": smallest**2 / largest,
        "O5": 1.0 / float((1.0 / singular).sum()),
    }


# -- the Jacobian ----------------------------------------------------------------------------------------------------


def _asked(
    chain: Chain, free: NDArray[np.bool_] | None, additions: EffectColumns | None, listed: NDArray[np.bool_]
) -> _Asked:
    asked = np.ones(len(chain), dtype=bool) if free is None else free
    names = [p.name for p in chain.parameters]
    sigma = np.where(np.isinf(chain.prior_sigma), [_FLAT_SIGMA[p.unit] for p in chain.parameters], chain.prior_sigma)
    words = [_words(chain, name) for name in names]
    if additions is not None:
        names += additions.names
        words += [_words_of_coefficient(name) for name in additions.names]
        sigma = np.concatenate([sigma, additions.prior_sigma])
    columns = np.concatenate([np.flatnonzero(asked), len(chain) + np.flatnonzero(listed)])
    return _Asked(
        tuple(names[i] for i in columns),
        tuple(words[i] for i in columns),
        sigma[columns],
        columns,
    )


def _whitened(
    chain: Chain, samples: Samples, at: Floats, excess_variance: float, additions: EffectColumns | None, asked: _Asked
) -> Floats:
    """Return the (3 m, q) change of the fixes, in their sigmas, by one prior sigma of each parameter analysed."""
    lin = _linearised(chain, samples, at, additions)
    covariance = samples.covariance(chain.rig, lin.joint_jacobian) + excess_variance * np.eye(3)
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), lin.jacobian[:, :, asked.columns] * asked.sigma)
    return np.asarray(whitened.reshape(-1, len(asked.columns)), dtype=np.float64)


def _linearised(chain: Chain, samples: Samples, at: Floats, additions: EffectColumns | None) -> Linearisation:
    """Linearise the m samples with respect to p parameters and k coefficients, at the values `at` (p + k,)."""
    if additions is None:
        return chain.linearise(at, samples.data)
    p = len(chain)
    return additions.linearise(lambda data: chain.linearise(at[:p], data), samples.data, at[p:])


# -- the null space --------------------------------------------------------------------------------------------------


def _echelon(null: Floats, effect: Floats) -> tuple[list[int], list[tuple[int, Floats]]]:
    """Bring the null space (k, q), in prior sigmas, to reduced echelon form: one parameter and its repeats per row.

    The pivots are the parameters that stay at their prior most. Of equal ones the last is used, as people look for
    the earlier ones.

    Returns:
        Columns whose own `effect` (q,) is negligible; pivot and direction (q,), of length 1, of each other row.
    """
    # Their effects are so small that even all together are not seen: each is one direction of the null space.
    blind = effect <= _SEEN / math.sqrt(len(effect))
    others = np.flatnonzero(~blind)
    # An orthonormal basis of the strongest directions.
    rows = np.linalg.svd(null[:, others], full_matrices=False)[2][: len(null) - int(blind.sum())]
    pivots: list[int] = []
    left = rows.copy()
    for _ in range(len(rows)):
        size = np.linalg.norm(left, axis=0)
        pivot = int(np.flatnonzero(size >= _ALIKE * size.max())[-1])
        unit = left[:, pivot] / size[pivot]
        left = left - np.outer(unit, unit @ left)
        left[:, pivot] = 0.0
        pivots.append(pivot)
    reduced = np.linalg.solve(rows[:, pivots], rows) if pivots else rows
    found = []
    for pivot, row in sorted(zip(pivots, reduced, strict=True), key=lambda pair: pair[0]):
        direction = np.zeros(len(effect))
        direction[others] = row / np.linalg.norm(row)
        found.append((int(others[pivot]), direction))
    return np.flatnonzero(blind).tolist(), found


# -- words -----------------------------------------------------------------------------------------------------------


def _repeats(asked: _Asked, pivot: int, part: Floats) -> str:
    """Return a sentence such as `row2.beta repeats row3.theta: beta at row 2 repeats the offset of theta3`.

    `part` (q,) is the effect on the fixes of each parameter's share of the combination, whatever its unit.
    """
    order = np.argsort(-np.abs(part), kind="stable").tolist()
    others = [i for i in order if i != pivot and abs(part[i]) > _PART * abs(part[pivot])]
    groups = list(dict.fromkeys(asked.words[i][1] for i in others))
    names = _listed([asked.names[i] for i in others[:_NAMED]], len(others) - _NAMED)
    words = _listed(groups[:_NAMED], len(groups) - _NAMED)
    return f"{asked.names[pivot]} repeats {names}: {asked.words[pivot][0]} repeats {words}"


def _listed(items: Iterable[str], more: int) -> str:
    parts = [*items, *([f"{more} more"] if more > 0 else [])]
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def _words(chain: Chain, name: str) -> tuple[str, str]:
    """Return words for a parameter: as the subject, and as one of several that are named together."""
    where, _, constant = name.rpartition(".")
    if where.startswith("base"):
        setup = where.removeprefix("base")[1:-1]
        base = f"the base at set-up {setup!r}" if setup else "the base"
        axis = constant[-1]
        if constant.startswith("r"):
            return f"the turn of {base} about {axis}", "the attitude of the base"
        return f"{axis} of {base}", "the place of the base"
    if where.startswith("prism."):
        prism = f"prism {where.removeprefix('prism.')}"
        return f"{constant} of {prism}", f"the place of {prism}"
    number = int(where.removeprefix("row"))
    couplings = list(chain.rig.couplings())
    drivers = [joint for row, driven, joint, _ in couplings if (row, driven) == (number, constant)]
    if len(drivers) == 1 and sum(joint == drivers[0] for _, _, joint, _ in couplings) == 1:
        return (text := f"the offset of {drivers[0]}"), text
    return (text := f"{constant} at row {number}"), text


def _words_of_coefficient(name: str) -> tuple[str, str]:
    """Return words for a coefficient, in the form of `_words`."""
    family, _, place = name.partition("@")
    where, _, coefficient = place.partition(":")
    text = f"{coefficient} of {family} at {where}" if coefficient else f"{family} at {where}"
    return text, text


def _why_blind(chain: Chain, samples: Samples, name: str) -> str:
    """Return the reason why no fix depends on a parameter: no prism beyond it or nothing at its set-up was measured."""
    where, _, _ = name.rpartition(".")
    measured = [chain.rig.prisms[i] for i in np.unique(samples.data.prism)]
    if where.startswith("prism.") and where.removeprefix("prism.") not in {p.name for p in measured}:
        return f": prism {where.removeprefix('prism.')} was not measured"
    if where.startswith("row") and not any(int(where[3:]) in chain.rig.path(p.frame) for p in measured):
        return f": no prism beyond row {where[3:]} was measured"
    if where.startswith("base[") and not (samples.data.setup == chain.setups.index(where[5:-1])).any():
        return f": set-up {where[5:-1]!r} has no fixes"
    return ""


def _with_still_joints_moved(chain: Chain, samples: Samples) -> dict[tuple[int, ...], Samples]:
    """Return samples in which joints that never moved span their limits: each such joint alone, and all together."""
    readings = samples.data.readings
    still = np.flatnonzero(np.ptp(readings, axis=0) <= standing_spread(chain.rig)).tolist()
    if not still:
        return {}
    turn = halton(len(still), len(samples))
    low, high = np.array([chain.rig.joints[j].limits for j in still]).T
    spread = low + (high - low) * turn

    def moved(which: Sequence[int]) -> Samples:
        shown = readings.copy()
        for joint in which:
            shown[:, joint] = spread[:, still.index(joint)]
        return replace(samples, data=replace(samples.data, readings=shown))

    return {tuple(which): moved(which) for which in [*([j] for j in still), still]}


def _why(chain: Chain, moved: Mapping[tuple[int, ...], Floats], direction: Floats) -> str:
    """Return the reason why a direction (q,) is not seen: joints that never moved and would show it if they did."""
    for joints, whitened in moved.items():
        if float(np.linalg.norm(whitened @ direction)) > _SEEN:
            names = _listed([chain.rig.joint_names[j] for j in joints], 0)
            return f", as {names} never moved" if len(joints) == 1 else f", as none of {names} moved"
    return ""
