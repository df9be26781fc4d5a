"""Start of the fit: closed-form base placements on nominal kinematics, and a robust descent towards the optimum.

The rigid transform follows Kabsch (Acta Cryst. A32, 1976), reweighted so that gross outliers do not tilt it.
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

PRIOR_SCALE = {"recalibration": 1.0, "as-built": 30.0}  # factor on the build tolerances before it is estimated

_PLACING_ROUNDS = 200
_PLACED = 1e-3  # of the misfit
_LINE = 1e-3  # ratio of the second singular value to the first, below which points lie on a line
_MIRRORED = 0.3  # misfit as the mirror image, relative to that as given, below which coordinates are mirrored
_LEAST_OF_SETUP = 6  # rows

_ROWS = 300  # enough to find the neighbourhood of the optimum
_ROUNDS = 80
_QUANTILE = 0.7  # of the errors; above 0.5, so that the rows of one prism cannot outweigh all others
_NORMAL_QUANTILE = 1.914  # of the norm of three standard normal numbers
_LIMIT = 4.0  # standard deviations beyond which the weight of a row decreases
_DAMPING = (1e-3, 1e-9, 1e9)  # at first, least, most
_SETTLED = 1e-3
_PATIENCE = 3


@dataclass(frozen=True)
class Start:
    """Result of `rough_start`.

    Attributes:
        placements: placement of the base, by set-up.
        x: (p,) parameters, including the offsets of unknown prisms.
        scale_mm: median 3-D misfit with these.
        misfit_mm: (m,) 3-D misfit of each sample with these.
    """

    placements: dict[str, Placement]
    x: Floats
    scale_mm: float
    misfit_mm: Floats


def rigid_fit(base_mm: Floats, station_mm: Floats, weight: Floats, *, mirrored: bool = False) -> Placement:
    """Return the least-squares rotation and translation from one set of points to another.

    Args:
        base_mm: (n, 3) points to move.
        station_mm: (n, 3) points to reach.
        weight: (n,) weight of each squared distance.
        mirrored: whether to return the best improper rotation instead, which no motion of a rigid body produces.
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
    """Place every base, in alternation with estimating the offsets of prisms whose mounting is unknown.

    Args:
        chain: kinematics whose placements are all the identity.
        samples: rows of every set-up of the chain.
        x: (p,) initial parameters; those of the bases are zero.
        offsets: whether to estimate offsets of prisms; if not, those of `x` are kept.
        mirrored: what to do about coordinates that fit much better as their mirror image.
        rounds: greatest number of reweighting rounds.
        in_base_mm: (m, 3) positions in the frames of the bases at `x`; computed if not given.

    Raises:
        UnsafeError: a set-up has fewer than three fixes, or all fixes on a line, or mirrored coordinates.
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
        # Least absolute distances by reweighting, which 20 % of gross outliers do not disturb.
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
    """Raise UnsafeError if the coordinates are mirrored, which otherwise only shows as a bad fit."""
    blank = Chain(chain.rig, {setup: Placement.identity() for setup in chain.setups})
    rough_start(blank, samples, np.zeros(len(blank)))


def draw_rows(data: ChainData, position_mm: Floats, count: int, seed: int) -> Integers:
    """Return the ascending indices of about `count` rows, drawn at random, as a sample of all rows.

    If fewer than six rows of a set-up are drawn, or all of its rows drawn lie on a line, more of its rows are added if
    there are any, so that the placement of its base is not left to chance.

    Args:
        data: n rows.
        position_mm: (n, 3) measured positions.
        count: number of rows; all are returned if there are no more.
        seed: seed of the draw.
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
    """Return True if points (n, 3) do not fix a rotation about them: fewer than three, or all on a line."""
    if len(position_mm) < 3:
        return True
    spread = np.linalg.svd(position_mm - position_mm.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= _LINE * spread[0] or spread[0] == 0.0)


def in_words(setup: str, alone: str = "the data") -> str:
    """Return words for a set-up in a message; `alone` for a single set-up without a name."""
    return f"set-up {setup!r}" if setup else alone


def _check_spread(setup: str, position_mm: Floats) -> None:
    if len(position_mm) < 3:
        fixes = "1 fix" if len(position_mm) == 1 else f"{len(position_mm)} fixes"
        raise UnsafeError(f"{in_words(setup)}: {fixes} cannot place the base; measure 3 or more in different places")
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
    """Descend from a distant start to near the optimum: damped Gauss-Newton with an outlier limit that narrows.

    The refinement's mixture decides early which rows are outliers. While the model is metres off, that decision is a
    guess, and the fit converges to the rows guessed to be inliers. Here no row is classified: the limit beyond which a
    row loses influence is a multiple of an upper quantile of all errors, wide at first and narrowing as the model
    improves (graduated non-convexity: Blake and Zisserman, "Visual Reconstruction", 1987; the loss is Geman and
    McClure's).

    Args:
        chain: kinematics.
        samples: m rows, of which about 300 are used.
        start: (p,) parameters.
        precision: (p,) 1 / sigma^2 of the prior.
        free: (p,) mask of the parameters to fit; all by default.
        rounds: greatest number of steps.

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
            with suppress(LinAlgError):  # without a step the cost stays the same
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
    """Return the standard deviation of a coordinate implied by the quantile of the errors, at least `least`."""
    return max(math.sqrt(float(np.quantile(_square(error), _QUANTILE))) / _NORMAL_QUANTILE, least)


def _loss(error: Floats, scale: float) -> float:
    """Return Geman and McClure's loss in units of squared sigma; infinite if it is out of range."""
    square = _square(error) / scale**2
    loss = float(np.sum(square / (1.0 + square / _LIMIT**2)))
    return loss if math.isfinite(loss) else math.inf
