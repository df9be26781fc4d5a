"""The start of the fit: base placements in closed form on nominal kinematics, and a robust descent towards the optimum.

The rigid transform is Kabsch's (Acta Cryst. A32, 1976), reweighted so that gross outliers do not tilt it.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError

from calibration.errors import UnsafeError
from calibration.identification.refinement import damped_step
from calibration.identification.samples import Samples
from calibration.kinematics.chain import Chain, ChainData, Integers, Placement
from calibration.observations import Floats

PRIOR_SCALE = {"recalibration": 1.0, "as-built": 30.0}  # of the build tolerances while their scale is not known yet

_PLACING_ROUNDS = 200
_PLACED = 1e-3  # of the misfit
_LINE = 1e-3  # second singular value over the first below which points lie on a line
_MIRRORED = 0.3
_LEAST_OF_SETUP = 6  # rows

_ROWS = 300  # enough to lead the way
_ROUNDS = 80
_QUANTILE = 0.7  # of the errors: above half, so that one prism's rows cannot leave the others out
_NORMAL_QUANTILE = 1.914  # of the norm of three standard normal numbers
_LIMIT = 4.0  # standard deviations beyond which a row counts less and less
_DAMPING = (1e-3, 1e-9, 1e9)  # at first, least, most
_SETTLED = 1e-3
_PATIENCE = 3


@dataclass(frozen=True)
class Start:
    """Result of `rough_start`.

    Attributes:
        placements: placement of the base, by set-up.
        x: (p,) parameters, with the offsets of unknown prisms.
        scale_mm: robust size of the 3-D misfit there.
        misfit_mm: (m,) 3-D misfit of each sample there.
    """

    placements: dict[str, Placement]
    x: Floats
    scale_mm: float
    misfit_mm: Floats


def rigid_fit(base_mm: Floats, station_mm: Floats, weight: Floats, *, mirrored: bool = False) -> Placement:
    """Least-squares rotation and translation from (n, 3) points to (n, 3) points with (n,) weights.

    `mirrored` allows the improper rotation instead, which no rigid body makes.
    """
    total = weight.sum()
    from_centre = weight @ base_mm / total
    to_centre = weight @ station_mm / total
    u, _, vt = np.linalg.svd(((station_mm - to_centre) * weight[:, None]).T @ (base_mm - from_centre))
    sign = np.sign(np.linalg.det(u @ vt)) * (-1.0 if mirrored else 1.0)
    rotation = u @ np.diag([1.0, 1.0, sign]) @ vt
    return Placement(rotation, to_centre - rotation @ from_centre)


def rough_start(
    chain: Chain,
    samples: Samples,
    x: Floats,
    *,
    offsets: bool = True,
    mirrored: Literal["refuse", "let pass"] = "refuse",
    rounds: int = _PLACING_ROUNDS,
    in_base_mm: Floats | None = None,
) -> Start:
    """Place every base, alternating with the offsets of prisms whose mounting is unknown.

    Args:
        chain: kinematics whose placements are all the identity.
        samples: rows of every set-up of the chain.
        x: (p,) parameters to begin with; those of the bases are zero.
        offsets: False to leave the offsets of prisms as `x` has them.
        mirrored: what to do about coordinates that fit much better as their mirror image.
        rounds: of reweighting at most.
        in_base_mm: (m, 3) positions in the frames of the bases at `x`, where they are known already.

    Raises:
        UnsafeError: a set-up with fewer than three fixes, with all fixes on a line, or mirrored.
    """
    data = samples.data
    unknown = np.array([offsets and p.kind == "prism" and p.is_flat for p in chain.parameters])
    arm = chain.positions_mm(x, data) if in_base_mm is None else in_base_mm
    offset_jacobian = chain.linearise(x, data).jacobian[:, :, unknown] if unknown.any() else np.zeros((len(data), 3, 0))
    offset = np.zeros(int(unknown.sum()))
    weight = np.ones(len(samples))
    rows_of = [np.flatnonzero(data.setup == s) for s in range(len(chain.setups))]
    for setup, rows in zip(chain.setups, rows_of, strict=True):
        _check_spread(setup, samples.position_mm[rows])
    base = np.zeros_like(arm)
    for _ in range(rounds):
        before = base.copy()
        point = arm + offset_jacobian @ offset
        placements = [rigid_fit(point[r], samples.position_mm[r], weight[r]) for r in rows_of]
        for placement, rows in zip(placements, rows_of, strict=True):
            base[rows] = (samples.position_mm[rows] - placement.translation_mm) @ placement.rotation
        misfit = base - point
        # Least absolute distances by reweighting: 20 % of gross outliers leave it where it is.
        distance = np.linalg.norm(misfit, axis=1)
        scale = float(np.median(distance))
        weight = 1.0 / np.maximum(distance, max(0.1 * scale, 1e-6))
        weight /= weight.max()
        step = np.zeros(0)
        if unknown.any():
            root = np.sqrt(weight)[:, None]
            step = np.linalg.lstsq(
                (offset_jacobian * root[:, :, None]).reshape(-1, len(offset)), (misfit * root).ravel(), rcond=1e-9
            )[0]
        offset = offset + step
        if max(np.abs(step).max(initial=0.0), np.abs(base - before).max()) < _PLACED * scale:
            break
    if mirrored == "refuse":
        for setup, placement, rows in zip(chain.setups, placements, rows_of, strict=True):
            _check_handedness(setup, point[rows], samples.position_mm[rows], weight[rows], placement)
    x = x.copy()
    x[unknown] += offset
    left = base - arm - offset_jacobian @ offset
    return Start(dict(zip(chain.setups, placements, strict=True)), x, scale, np.linalg.norm(left, axis=1))


def refuse_mirrored(chain: Chain, samples: Samples) -> None:
    """UnsafeError where the coordinates are mirrored: no method can know it from a bad fit."""
    blank = Chain(chain.rig, {setup: Placement.identity() for setup in chain.setups})
    rough_start(blank, samples, np.zeros(len(blank)))


def draw_rows(data: ChainData, position_mm: Floats, count: int, seed: int) -> Integers:
    """Rising numbers of about `count` rows, drawn at random, that stand for all of them.

    A set-up with too few of them, or with all of them on a line, gets more, so that no base is left to chance: six rows
    and two dimensions, as far as it has them.

    Args:
        data: n rows.
        position_mm: (n, 3) of them.
        count: of rows; all are taken where there are no more.
        seed: of the draw.
    """
    order = np.random.default_rng(seed).permutation(len(data))
    taken = np.zeros(len(data), dtype=bool)
    taken[order[:count]] = True
    for setup in np.unique(data.setup):
        own = order[data.setup[order] == setup]
        number = max(int(taken[own].sum()), min(_LEAST_OF_SETUP, len(own)))
        while number < len(own) and _on_a_line(position_mm[own[:number]]):
            number += 1
        taken[own[:number]] = True
    return np.flatnonzero(taken)


def _on_a_line(position_mm: Floats) -> bool:
    """True if points (n, 3) leave a turn about them open: fewer than three, or all on a line."""
    if len(position_mm) < 3:
        return True
    spread = np.linalg.svd(position_mm - position_mm.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= _LINE * spread[0] or spread[0] == 0.0)


def in_words(setup: str, alone: str = "the data") -> str:
    """Name of a set-up in a message; `alone` for the only one, which has none."""
    return f"set-up {setup!r}" if setup else alone


def _check_spread(setup: str, position_mm: Floats) -> None:
    if len(position_mm) < 3:
        fixes = "1 fix" if len(position_mm) == 1 else f"{len(position_mm)} fixes"
        raise UnsafeError(f"{in_words(setup)}: {fixes} cannot place the base; at least 3 in different places")
    if np.ptp(position_mm, axis=0).max() == 0.0:
        raise UnsafeError(
            f"{in_words(setup)}: all {len(position_mm)} fixes have the same coordinates: did the station repeat one, "
            "or are the columns filled with one value?"
        )
    if _on_a_line(position_mm):
        raise UnsafeError(
            f"{in_words(setup)}: all fixes lie on a line, so the base may turn about it; measure other poses"
        )


def _check_handedness(setup: str, point: Floats, position_mm: Floats, weight: Floats, proper: Placement) -> None:
    def misfit(placement: Placement) -> float:
        moved = point @ placement.rotation.T + placement.translation_mm
        return float(np.median(np.linalg.norm(position_mm - moved, axis=1)))

    improper = rigid_fit(point, position_mm, weight, mirrored=True)
    if misfit(improper) < _MIRRORED * misfit(proper):
        raise UnsafeError(
            f"{in_words(setup)}: the coordinates are mirrored ({misfit(improper):.0f} mm from the rig when mirrored "
            f"back, {misfit(proper):.0f} mm as given); x = east, y = north, z = up is right-handed: are two axes "
            f"swapped?"
        )


# -- robust descent ----------------------------------------------------------------------------------------------------


def approach(
    chain: Chain,
    samples: Samples,
    start: Floats,
    *,
    precision: Floats,
    free: NDArray[np.bool_] | None = None,
    rounds: int = _ROUNDS,
) -> Floats:
    """Descend from afar to the neighbourhood of the optimum: damped Gauss-Newton with an outlier limit that narrows.

    The refinement's mixture decides early which rows are outliers. Where the model is metres off that decision is a
    guess, and the fit comes to rest on the rows that it guessed for. Here nothing is decided: the limit beyond which a
    row loses influence is a multiple of an upper quantile of all errors, wide open at first and closing as the model
    comes closer (graduated non-convexity: Blake and Zisserman, "Visual Reconstruction", 1987; the loss is Geman and
    McClure's).

    Args:
        chain: kinematics.
        samples: m rows, of which some are used.
        start: (p,) parameters.
        precision: (p,) 1 / sigma^2 of the prior.
        free: (p,) which parameters move; all by default.
        rounds: steps at most.

    Returns:
        (p,) parameters.
    """
    free = np.ones(len(chain), dtype=bool) if free is None else free
    rows = draw_rows(samples.data, samples.position_mm, _ROWS, 0)
    data, position = samples.data.select(rows), samples.position_mm[rows]
    least = math.sqrt(float(np.trace(samples.station_covariance[rows], axis1=1, axis2=2).mean()) / 3.0)
    columns = int(free.sum())
    x, prior = start.copy(), precision[free]
    error = position - chain.positions_mm(x, data)
    scale, damping, quiet = math.inf, _DAMPING[0], 0
    for _ in range(rounds):
        scale = min(scale, _scale(error, least))
        jacobian = chain.linearise(x, data).jacobian[:, :, free]
        weight = (1.0 + _square(error) / (_LIMIT * scale) ** 2) ** -2 / scale**2
        weighted = weight[:, None, None] * jacobian
        normal = jacobian.reshape(-1, columns).T @ weighted.reshape(-1, columns) + np.diag(prior)
        gradient = weighted.reshape(-1, columns).T @ error.ravel() - prior * x[free]
        here = _loss(error, scale) + float(prior @ x[free] ** 2)
        while True:
            there = x.copy()
            with suppress(LinAlgError):  # no step costs no more
                there[free] += damped_step(normal, gradient, damping)
            moved = position - chain.positions_mm(there, data)
            cost = _loss(moved, scale) + float(prior @ there[free] ** 2)
            if cost <= here or damping >= _DAMPING[2]:
                break
            damping *= 10.0
        if not cost <= here:
            break
        damping = max(damping / 10.0, _DAMPING[1])
        x, error = there, moved
        narrower = _scale(error, least) < scale * (1.0 - _SETTLED)
        quiet = 0 if narrower or here - cost > _SETTLED * here else quiet + 1
        if quiet == _PATIENCE:
            break
    return x


def _square(error: Floats) -> Floats:
    square: Floats = np.einsum("ni,ni->n", error, error)
    return square


def _scale(error: Floats, least: float) -> float:
    """Standard deviation of a coordinate that the quantile of the errors stands for, `least` at least."""
    return max(math.sqrt(float(np.quantile(_square(error), _QUANTILE))) / _NORMAL_QUANTILE, least)


def _loss(error: Floats, scale: float) -> float:
    """Geman and McClure's loss in units of squared sigma; infinite where the numbers left the range."""
    square = _square(error) / scale**2
    loss = float(np.sum(square / (1.0 + square / _LIMIT**2)))
    return loss if math.isfinite(loss) else math.inf
