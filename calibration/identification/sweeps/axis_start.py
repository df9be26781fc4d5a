"""Start of the refinement from the axes measured by single-joint sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calibration.identification.linear_model import prior_precision
from calibration.identification.samples import Samples
from calibration.identification.start import rigid_fit, rough_start
from calibration.identification.sweeps.circle_fit import CENTRE, DIRECTION, FEATURES, RADIUS, SweepCurve, fit_curve
from calibration.identification.sweeps.circles import Axis, drives_several, joint_values, predicted_curve
from calibration.kinematics.chain import Chain, ChainData, Placement
from calibration.observations import Floats

_FAR_PRIOR = 100.0  # prior sigma of a distant start, in build tolerances: angles may be tens of degrees off
_INNER_ROUNDS, _LAST_ROUNDS = 10, 40
_FLOOR_RAD, _FLOOR_MM = np.radians(0.2), 5.0  # added to the axes' sigmas, so that no axis dominates the start


def start_from_axes(chain: Chain, samples: Samples, axes: Sequence[Axis]) -> Floats:
    """Fit the model's axes and circles to the measured ones, as a start for the refinement.

    Directions depend on angles alone, and each hardly on the errors of the others. So base and angles are fitted to the
    directions first, with joints from the base outwards, and then lengths and angles to centres and radii as well. The
    position of a prism on its circle is not used, so an angle that turns no measured axis stays at its prior.

    Args:
        chain: kinematics with any placement of the bases.
        samples: the rows, for set-ups without sweeps.
        axes: result of `find_axes`, at least one.

    Returns:
        (p,) parameters.

    Raises:
        UnsafeError: the fixes of a set-up without sweeps cannot place its base.
    """
    precision = prior_precision(chain, _FAR_PRIOR)
    x = np.zeros(len(chain))
    seen = sorted({chain.setups.index(axis.setup) for axis in axes})
    for setup in seen:
        _turn_base(chain, x, setup, [a for a in axes if a.setup == chain.setups[setup]])
    angles = np.array([p.unit == "rad" and p.kind != "prism" for p in chain.parameters])
    # The circle of a joint that drives several rows may flip while the axes of these rows are far from correct.
    single = [a for a in axes if not drives_several(chain, a)] or list(axes)
    joints = list(dict.fromkeys(axis.joint for axis in single))
    for count in range(1, len(joints) + 1):
        inner = [a for a in single if a.joint in joints[:count]]
        x = _fit_axes(chain, x, inner, angles, precision, directions_only=True)
    for setup in seen:
        own = [a for a in axes if a.setup == chain.setups[setup]]
        shift = [a.centre_mm - predicted_curve(chain, x, a).features[CENTRE] for a in own]
        x[chain.base_index(setup)][:3] += np.median(shift, axis=0)
    everything = np.ones(len(chain), dtype=bool)
    x = _fit_axes(chain, x, single, everything, precision, directions_only=False)
    if len(single) < len(axes):
        x = _fit_axes(chain, x, list(axes), everything, precision, directions_only=False)
    return _place_others(chain, samples, x, seen)


def _turn_base(chain: Chain, x: Floats, setup: int, axes: Sequence[Axis]) -> None:
    """Turn a base so that the model's directions match the measured ones."""
    rotation = chain.base(x, setup).rotation
    modelled = np.array([predicted_curve(chain, x, a).features[DIRECTION] for a in axes]) @ rotation
    measured = np.array([a.direction for a in axes])
    if np.linalg.svd(modelled, compute_uv=False)[1:2].sum() < 0.1:  # parallel axes do not determine the turn about them
        return
    # Each direction and its opposite are points at distance 1 from the origin, so the fit is a pure rotation.
    points, targets = np.vstack([modelled, -modelled]), np.vstack([measured, -measured])
    turn = rigid_fit(points, targets, np.ones(len(points))).rotation
    x[chain.base_index(setup)] = chain.base_values(setup, Placement(turn, chain.base(x, setup).translation_mm))


def _fit_axes(
    chain: Chain, x: Floats, axes: Sequence[Axis], free: NDArray[np.bool_], precision: Floats, *, directions_only: bool
) -> Floats:
    """Fit the free parameters to the axes' features and the prior by least squares."""
    used = np.zeros(FEATURES, dtype=bool)
    used[DIRECTION] = True
    used[CENTRE] = used[RADIUS] = not directions_only
    floor = np.diag(np.array([_FLOOR_RAD] * 3 + [_FLOOR_MM] * 4 + [1.0]) ** 2)[np.ix_(used, used)]
    whiten = [np.linalg.inv(np.linalg.cholesky(a.covariance[np.ix_(used, used)] + floor)) for a in axes]
    root = np.sqrt(precision[free])
    together = ChainData(
        np.vstack([a.sweep.readings for a in axes]),
        np.concatenate([a.sweep.prism for a in axes]),
        np.concatenate([a.sweep.setup for a in axes]),
    )
    ends = np.cumsum([len(a.sweep) for a in axes]).tolist()
    own = [slice(end - len(a.sweep), end) for end, a in zip(ends, axes, strict=True)]
    values = [joint_values(chain, a.joint, a.sweep) for a in axes]

    def at(moved: Floats) -> Floats:
        out = x.copy()
        out[free] = moved
        return out

    def curves(places: Floats) -> list[SweepCurve]:
        return [fit_curve(a.kind, places[rows], v) for a, rows, v in zip(axes, own, values, strict=True)]

    def residual(moved: Floats) -> Floats:
        modelled = curves(chain.positions_mm(at(moved), together))
        parts = [w @ (c.features - a.features)[used] for w, c, a in zip(whiten, modelled, axes, strict=True)]
        return np.concatenate([*parts, root * moved])

    def jacobian(moved: Floats) -> Floats:
        lin = chain.linearise(at(moved), together)
        by_parameter = lin.jacobian[:, :, free]
        parts = [
            w @ c.sensitivity[used].reshape(len(w), -1) @ by_parameter[rows].reshape(-1, len(moved))
            for w, c, rows in zip(whiten, curves(lin.position_mm), own, strict=True)
        ]
        return np.vstack([*parts, np.diag(root)])

    rounds = _INNER_ROUNDS if directions_only else _LAST_ROUNDS
    found = least_squares(
        residual,
        x[free],
        jac=jacobian,
        x_scale=1.0 / root,
        ftol=1e-3,
        max_nfev=rounds,
    )
    return at(found.x)


def _place_others(chain: Chain, samples: Samples, x: Floats, seen: Sequence[int]) -> Floats:
    """Place the bases of set-ups that have no sweep, with the other parameters known."""
    others = [s for s in range(len(chain.setups)) if s not in seen]
    if not others:
        return x
    names = {chain.setups[s]: Placement.identity() for s in others}
    blank = Chain(chain.rig, names)
    own = samples.select(np.isin(samples.data.setup, others))
    own = replace(own, data=replace(own.data, setup=np.searchsorted(others, own.data.setup)))
    body = np.concatenate([x[: chain.base_start], np.zeros(6 * len(others))])
    # This is only a start; the fit checks whether coordinates are mirrored.
    start = rough_start(blank, own, body, offsets=False, mirrored="let pass")
    out = x.copy()
    for setup in others:
        out[chain.base_index(setup)] = chain.base_values(setup, start.placements[chain.setups[setup]])
    return out
