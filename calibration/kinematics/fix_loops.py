"""Compiled loops of `CompiledChain`: positions of prisms with the uncertainty of a fix."""

from __future__ import annotations

import math

import numpy as np

from calibration.kinematics.chain_loops import (
    Integers,
    Points,
    Transforms,
    by_base,
    by_coefficients,
    by_offset,
    by_transforms,
    place_point,
    turn_back,
    walk_from_base,
)
from calibration.numerics.jit import compiled
from calibration.observations import Floats

Station = tuple[float, float, float, float, float, float]


@compiled
def _add_square(factor: float, m0: float, m1: float, m2: float, out: Floats) -> None:
    """Add factor * m m' to the lower triangle of `out`."""
    out[0, 0] += factor * m0 * m0
    out[1, 0] += factor * m1 * m0
    out[1, 1] += factor * m1 * m1
    out[2, 0] += factor * m2 * m0
    out[2, 1] += factor * m2 * m1
    out[2, 2] += factor * m2 * m2


@compiled
def _turn(base: Floats, half: Floats, out: Floats) -> None:
    """Fill `out` (3, 3) with R S R' for the symmetric S whose lower triangle is `half`."""
    for i in range(3):
        for j in range(i):
            half[j, i] = half[i, j]
    for i in range(3):
        for j in range(i + 1):
            total = 0.0
            for k in range(3):
                total += base[i, k] * (base[j, 0] * half[k, 0] + base[j, 1] * half[k, 1] + base[j, 2] * half[k, 2])
            out[i, j] = total
            out[j, i] = total


@compiled
def _of_parameters(jacobian: Floats, root: Floats, scaled: Floats, out: Floats) -> None:
    """Fill the lower triangle of `out` (3, 3) with J root root' J'; `scaled` (3, q) is working space."""
    scaled[:] = 0.0
    for index in range(len(root)):
        m0, m1, m2 = jacobian[0, index], jacobian[1, index], jacobian[2, index]
        if m0 != 0.0 or m1 != 0.0 or m2 != 0.0:
            for r in range(index + 1):
                value = root[index, r]
                scaled[0, r] += m0 * value
                scaled[1, r] += m1 * value
                scaled[2, r] += m2 * value
    for i in range(3):
        for j in range(i + 1):
            total = 0.0
            for r in range(len(root)):
                total += scaled[i, r] * scaled[j, r]
            out[i, j] = total


@compiled
def _of_readings(rates: Floats, variance: Floats, instant_s: float, by_joint: Floats, out: Floats) -> None:
    """Fill the lower triangle of `out` (3, 3) with the covariance due to errors of the readings and of their timing."""
    out[:] = 0.0
    v0, v1, v2 = 0.0, 0.0, 0.0
    for joint in range(len(variance)):
        m0, m1, m2 = by_joint[0, joint], by_joint[1, joint], by_joint[2, joint]
        rate = rates[joint] if math.isfinite(rates[joint]) else 0.0
        v0, v1, v2 = v0 + m0 * rate, v1 + m1 * rate, v2 + m2 * rate
        _add_square(variance[joint], m0, m1, m2, out)
    _add_square(instant_s**2, v0, v1, v2, out)


@compiled
def _add_station(p: Floats, sigma_mm: Floats, station: Station, out: Floats) -> None:
    """Add the covariance of a fix at `p`, due to station (or the fix's own sigma) and repeats, to `out` (3, 3)."""
    distance_mm, distance_ppm, circles_rad, centring_mm, repeats_mm, _ = station
    range_mm = max(math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]), 1e-6)
    radial = (distance_mm + distance_ppm * 1e-6 * range_mm) ** 2
    across = (range_mm * circles_rad) ** 2
    given = math.isfinite(sigma_mm[0]) and math.isfinite(sigma_mm[1]) and math.isfinite(sigma_mm[2])
    for i in range(3):
        out[i, i] += repeats_mm**2 + (sigma_mm[i] ** 2 if given else across + centring_mm**2)
        if not given:
            for j in range(3):
                out[i, j] += (radial - across) * p[i] * p[j] / range_mm**2


@compiled
def locate(
    readings: Floats,
    prism: Integers,
    setup: Integers,
    kind: Integers,
    amount: Floats,
    drive_start: Integers,
    drive_joint: Integers,
    drive_size: Floats,
    row_start: Integers,
    frame_before: Integers,
    frame: Integers,
    offset: Floats,
    parameter: Integers,
    path_start: Integers,
    path: Integers,
    bases: Floats,
    base_start: int,
    root: Floats,
    coefficient_joint: Integers,
    station: Station,
    column: Floats,
    shift: Floats,
    sigma_mm: Floats,
    rates: Floats,
    variance: Floats,
    position: Floats,
    place: Floats,
    frames: Floats,
    by_joint: Floats,
    by_parameter: Floats,
    of_fix: Floats,
    of_parameters: Floats,
) -> None:
    """Fill the arrays of a `Located`; `by_parameter` and both covariances only if they have rows.

    The first arguments are as for `chain_loops.linearise`. `root` (q, q) is lower triangular; root @ root' is the
    covariance of parameters and then coefficients of effects. `coefficient_joint` (k,) is the joint that each
    coefficient changes, -1 for none. `station` holds the sigmas of distance in mm and ppm, circles in rad, centring in
    mm, repeats in mm and timing in s. The following arguments are as for `CompiledChain.spread`. The last are the
    arrays to fill, of which both Jacobians must be zero initially.
    """
    transforms = Transforms(kind, amount, drive_start, drive_joint, drive_size, row_start, frame_before)
    points = Points(frame, offset, parameter, path_start, path)
    ends, kept = np.empty((frames.shape[1], 3, 3)), np.empty((len(kind), 6))
    jacobian, scaled = np.empty((3, by_parameter.shape[2])), np.empty((3, len(root)))
    arm, half = np.empty(3), np.empty((3, 3))
    wanted = len(by_parameter) > 0 or len(of_fix) > 0
    for n in range(len(prism)):
        point, at, base = prism[n], frame[prism[n]], bases[setup[n]]
        walk_from_base(readings[n], transforms, ends, kept, frames[n])
        place_point(offset[point], ends[at], frames[n, at], place[n])
        for i in range(3):
            arm[i] = base[i, 0] * place[n, 0] + base[i, 1] * place[n, 1] + base[i, 2] * place[n, 2]
            position[n, i] = base[3, i] + arm[i]
        if len(by_parameter) > 0:
            jacobian = by_parameter[n]
        elif wanted:
            jacobian[:] = 0.0
        by_transforms(place[n], point, transforms, points, kept, wanted, by_joint[n], jacobian)
        if wanted:
            by_offset(ends[at], parameter[point], jacobian)
            first = base_start + 6 * setup[n]
            by_base(arm, base, first, jacobian)
            turn_back(base, first, jacobian)
            by_coefficients(column[n], shift[n], coefficient_joint, by_joint[n], jacobian)
        if len(of_fix) > 0:
            _of_parameters(jacobian, root, scaled, half)
            _turn(base, half, of_parameters[n])
            _of_readings(rates[n], variance[n], station[5], by_joint[n], half)
            _turn(base, half, of_fix[n])
            _add_station(position[n], sigma_mm[n], station, of_fix[n])


@compiled
def add_learned(
    setup: Integers,
    bases: Floats,
    before: Floats,
    estimate: Floats,
    weight: Floats,
    of_fix: Floats,
    of_parameters: Floats,
    of_base: Floats,
    made_good: float,
    excess: Floats,
    position: Floats,
    sigma: Floats,
) -> bool:
    """Fill positions corrected by a residual learner, and the standard deviation of a fix about them.

    Args:
        setup: (n,) set-up of each row.
        bases: (setups, 7, 3) bases of `CompiledChain`.
        before: (n, 3) positions without the learner, mm.
        estimate: (n, 3) correction by the learner in the base frame, mm.
        weight: (n,) weight of the correction, 0 to 1.
        of_fix: (n, 3, 3) covariance from `CompiledChain.spread`.
        of_parameters: (n, 3, 3) covariance from `CompiledChain.spread`.
        of_base: (n, 3) variance due to parameters that no learner reduces, mm^2.
        made_good: share of the remaining variance due to parameters that a learner of weight 1 removes.
        excess: (2, 3) excess variance along the base frame's axes, without and with a learner, mm^2.
        position: (n, 3) positions in the station's frame, mm, to be filled.
        sigma: (n, 3) standard deviations in the station's frame, mm, to be filled.

    Returns:
        True if all positions and standard deviations are finite.
    """
    total = 0.0  # shows both infinity and NaN
    for n in range(len(setup)):
        base, counts = bases[setup[n]], weight[n]
        for i in range(3):
            place, by_parameters = before[n, i], of_parameters[n, i, i]
            variance = of_fix[n, i, i] + by_parameters - counts * made_good * (by_parameters - of_base[n, i])
            for j in range(3):
                place += base[i, j] * estimate[n, j]
                variance += base[i, j] * base[i, j] * ((1.0 - counts) * excess[0, j] + counts * excess[1, j])
            position[n, i], sigma[n, i] = place, math.sqrt(variance)
            total += place + sigma[n, i]
    return math.isfinite(total)
