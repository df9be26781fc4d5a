"""The noise model: covariance of a fix by station, readings and timing, and whitening of fixes that share a standstill.

Fixes of one standstill share random errors of its readings, so their covariance is

    V = blockdiag(S_i) + J_q Sigma_q J_q'

over all of them, where S_i covers station, timing, excess and the errors of readings that each fix has separately. A
row with the probability w of being no outlier counts as if it had additional independent noise of covariance
(1/w - 1) V_ii: w = 1 is the model above, w = 0 removes the row, and a standstill of a single fix gets the familiar
w V^-1. With W the diagonal matrix of the w, V_w = W^-1/2 A W^-1/2, where A has the blocks V_ii on its diagonal and
sqrt(w_i w_j) J_i Sigma_q J_j' off it; so nothing is ever divided by w.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.numerics.jit import compiled
from calibration.observations import Floats, Observations
from calibration.rig.description import Rig

Integers = NDArray[np.intp]

_ROUNDING = 1e-13  # least pivot, relative to its diagonal element


def station_covariance(rig: Rig, position_mm: Floats, sigma_mm: Floats) -> Floats:
    """Return the (n, 3, 3) covariance of fixes due to the instrument's circles, distance and target centring, mm^2.

    Args:
        rig: describes the instrument.
        position_mm: (n, 3) in the station's frame.
        sigma_mm: (n, 3) standard deviations of x, y, z to use instead where all three are finite.
    """
    station = rig.station
    range_mm = np.maximum(np.linalg.norm(position_mm, axis=1), 1e-6)
    radial = (station.distance_sigma_mm + station.distance_sigma_ppm * 1e-6 * range_mm) ** 2
    across = (range_mm * np.radians(station.angle_sigma_arcsec / 3600.0)) ** 2
    line = position_mm / range_mm[:, None]
    identity = np.eye(3)
    covariance: Floats = (across + station.target_sigma_mm**2)[:, None, None] * identity + (radial - across)[
        :, None, None
    ] * line[:, :, None] * line[:, None, :]
    given = np.isfinite(sigma_mm).all(axis=1)
    covariance[given] = sigma_mm[given][:, :, None] ** 2 * identity
    return covariance


def reading_variance(rig: Rig) -> Floats:
    """Return the (joints,) variance of a reading, deg^2 or mm^2: sigma^2 + resolution^2 / 12."""
    return np.array([joint.sigma**2 + joint.resolution**2 / 12.0 for joint in rig.joints])


def reading_covariance(rig: Rig, joint_jacobian: Floats, rates: Floats) -> Floats:
    """Return the (n, 3, 3) covariance due to readings and timing, mm^2.

    It is J_q Sigma_q J_q' + (J_q q_dot)(J_q q_dot)' sigma_t^2.

    Args:
        rig: gives the random errors of readings and timing.
        joint_jacobian: (n, 3, joints) J_q, mm per deg or mm.
        rates: (n, joints) q_dot, deg/s or mm/s.
    """
    readings = covariance_by_joints(joint_jacobian, reading_variance(rig))
    return readings + timing_covariance(rig, joint_jacobian, rates)


def timing_covariance(rig: Rig, joint_jacobian: Floats, rates: Floats) -> Floats:
    """Return the (n, 3, 3) covariance due to the timing of the fix, mm^2.

    Args:
        rig: gives the random error of timing.
        joint_jacobian: (n, 3, joints) mm per deg or mm.
        rates: (n, joints) deg/s or mm/s.
    """
    velocity = joint_jacobian @ rates[:, :, None] * rig.station.timing_sigma_s
    covariance: Floats = velocity @ velocity.transpose(0, 2, 1)
    return covariance


def covariance_by_joints(joint_jacobian: Floats, variance: Floats) -> Floats:
    """Return the (n, 3, 3) covariance J_q V J_q' of positions due to independent errors of the joints, mm^2.

    Args:
        joint_jacobian: (n, 3, joints) J_q, mm per deg or mm.
        variance: (joints,) or (n, joints), deg^2 or mm^2.
    """
    scaled = joint_jacobian * np.sqrt(variance)[..., None, :]
    covariance: Floats = scaled @ scaled.transpose(0, 2, 1)
    return covariance


def joint_rates(rig: Rig, observations: Observations) -> Floats:
    """Return the (n, joints) columns `<name>_rate`, deg/s or mm/s; 0 where not measured."""
    missing = np.zeros(len(observations))
    columns = [observations.extra.get(f"{name}_rate", missing) for name in rig.joint_names]
    rates: Floats = np.nan_to_num(np.column_stack(columns))
    return rates


@compiled
def _blocks(station: Floats, velocity: Floats, by_joint: Floats, variance: Floats, excess: float, out: Floats) -> None:
    """Write V_ii (m, 3, 3) = station + timing + readings + excess to `out`."""
    for m in range(len(station)):
        for i in range(3):
            for j in range(i + 1):
                total = station[m, i, j] + velocity[m, i] * velocity[m, j]
                for k in range(variance.shape[1]):
                    total += by_joint[m, i, k] * variance[m, k] * by_joint[m, j, k]
                out[m, i, j] = total
                out[m, j, i] = total
            out[m, i, i] += excess


@compiled
def _marginals(block: Floats, error: Floats, square: Floats, log_det: Floats, trace: Floats) -> None:
    """Compute e' V^-1 e, log det V, and the traces (m, 2) of V^-1 and V^-2, of every row by itself."""
    inverse = np.empty((3, 3))
    for m in range(len(block)):
        v = block[m]
        a, b, c, d, e, f = v[0, 0], v[1, 0], v[2, 0], v[1, 1], v[2, 1], v[2, 2]
        inverse[0, 0], inverse[1, 1], inverse[2, 2] = d * f - e * e, a * f - c * c, a * d - b * b
        inverse[0, 1], inverse[0, 2], inverse[1, 2] = c * e - b * f, b * e - c * d, b * c - a * e
        determinant = max(a * inverse[0, 0] + b * inverse[0, 1] + c * inverse[0, 2], _ROUNDING * a * d * f)
        i00, i11, i22 = inverse[0, 0] / determinant, inverse[1, 1] / determinant, inverse[2, 2] / determinant
        i01, i02, i12 = inverse[0, 1] / determinant, inverse[0, 2] / determinant, inverse[1, 2] / determinant
        x, y, z = error[m, 0], error[m, 1], error[m, 2]
        square[m] = x * x * i00 + y * y * i11 + z * z * i22 + 2.0 * (x * y * i01 + x * z * i02 + y * z * i12)
        log_det[m] = math.log(determinant)
        trace[m, 0] = i00 + i11 + i22
        trace[m, 1] = i00 * i00 + i11 * i11 + i22 * i22 + 2.0 * (i01 * i01 + i02 * i02 + i12 * i12)


@compiled
def _assemble(block: Floats, by_joint: Floats, sigma: Floats, root: Floats, shared: Floats, out: Floats) -> None:
    """Write the lower triangle of A of one standstill to `out`; `shared` is scratch space with as many rows."""
    for r in range(len(out)):
        fix, c = r // 3, r % 3
        for k in range(sigma.shape[1]):
            shared[r, k] = root[fix] * sigma[fix, k] * by_joint[fix, c, k]
        for q in range(3 * fix):
            total = 0.0
            for k in range(sigma.shape[1]):
                total += shared[r, k] * shared[q, k]
            out[r, q] = total
        for q in range(3 * fix, r + 1):
            out[r, q] = block[fix, c, q - 3 * fix]


@compiled
def _cholesky(matrix: Floats) -> float:
    """Replace the lower triangle of a matrix by its Cholesky factor; return log det."""
    log_det = 0.0
    for r in range(len(matrix)):
        diagonal = matrix[r, r]
        left = diagonal
        for q in range(r):
            total = matrix[r, q]
            for k in range(q):
                total -= matrix[r, k] * matrix[q, k]
            matrix[r, q] = total / matrix[q, q]
            left -= matrix[r, q] * matrix[r, q]
        matrix[r, r] = math.sqrt(max(left, _ROUNDING * diagonal))
        log_det += 2.0 * math.log(matrix[r, r])
    return log_det


@compiled
def _traces(factor: Floats, inverse: Floats) -> tuple[float, float]:
    """Return the traces of A^-1 and A^-2 from a Cholesky factor of A; `inverse` is scratch space."""
    once, twice = 0.0, 0.0
    for q in range(len(factor)):
        for r in range(q, len(factor)):
            total = 1.0 if r == q else 0.0
            for k in range(q, r):
                total -= factor[r, k] * inverse[k, q]
            inverse[r, q] = total / factor[r, r]
            once += inverse[r, q] * inverse[r, q]
    for q in range(len(factor)):
        for r in range(q, len(factor)):
            total = 0.0
            for k in range(r, len(factor)):
                total += inverse[k, r] * inverse[k, q]
            twice += total * total * (1.0 if r == q else 2.0)
    return once, twice


@compiled
def _factorise(
    start: Integers, block: Floats, by_joint: Floats, sigma: Floats, root: Floats, factor: Floats, sums: Floats
) -> None:
    """Factor A by Cholesky, standstill by standstill.

    Row 3 i + c of `factor` (3 m, widest) is the factor's row of coordinate c of fix i. `sigma` (m, joints) is the
    shared standard deviation of the readings, `root` (m,) is sqrt(w). `sums` (3,) receives log det A and the traces of
    A^-1 and A^-2.
    """
    widest = factor.shape[1]
    shared, inverse = np.empty((widest, sigma.shape[1])), np.empty((widest, widest))
    sums[0], sums[1], sums[2] = 0.0, 0.0, 0.0
    for g in range(len(start) - 1):
        i, j = start[g], start[g + 1]
        own = factor[3 * i : 3 * j, : 3 * (j - i)]
        _assemble(block[i:j], by_joint[i:j], sigma[i:j], root[i:j], shared, own)
        sums[0] += _cholesky(own)
        once, twice = _traces(own, inverse)
        sums[1] += once
        sums[2] += twice


@compiled
def _whiten(start: Integers, factor: Floats, root: Floats, values: Floats, out: Floats) -> None:
    """Write L^-1 W^1/2 times `values` (3 m, p) to `out`, which may be `values` itself."""
    for g in range(len(start) - 1):
        first = 3 * start[g]
        for r in range(3 * (start[g + 1] - start[g])):
            row, scale, lower = out[first + r], root[start[g] + r // 3], factor[first + r]
            for p in range(len(row)):
                row[p] = scale * values[first + r, p]
            for q in range(r):
                above, along = out[first + q], lower[q]
                for p in range(len(row)):
                    row[p] -= along * above[p]
            for p in range(len(row)):
                row[p] /= lower[r]


@compiled
def _finish(start: Integers, factor: Floats, values: Floats, out: Floats) -> None:
    """Write L^-T times `values` (3 m, p) to `out`: this turns whitened rows into rows of A^-1 W^1/2."""
    for g in range(len(start) - 1):
        first, size = 3 * start[g], 3 * (start[g + 1] - start[g])
        for back in range(size):
            r = size - 1 - back
            row = out[first + r]
            for p in range(len(row)):
                row[p] = values[first + r, p]
            for q in range(r + 1, size):
                below, along = out[first + q], factor[first + q, r]
                for p in range(len(row)):
                    row[p] -= along * below[p]
            for p in range(len(row)):
                row[p] /= factor[first + r, r]


@dataclass(frozen=True)
class Marginals:
    """Covariance and error of every row by itself.

    Attributes:
        block: (m, 3, 3) covariance V_ii.
        square: (m,) squared Mahalanobis length of the error.
        log_det: (m,) log determinant of V_ii.
        trace: (m, 2) traces of V_ii^-1 and V_ii^-2.
    """

    block: Floats
    square: Floats
    log_det: Floats
    trace: Floats


@dataclass(frozen=True)
class Whitening:
    """Factors of the covariance of all rows, with outliers downweighted.

    Attributes:
        start: (groups + 1,) first row of each standstill, and the number of rows.
        root: (m,) square root of every row's weight.
        factor: Cholesky factors of A.
        log_det: log determinant of A.
        trace: d log det V_w / d s^2, and the trace that scales the restricted likelihood's curvature.
    """

    start: Integers
    root: Floats
    factor: Floats
    log_det: float
    trace: tuple[float, float]

    def whiten(self, values: Floats) -> Floats:
        """Whiten rows J (m, 3, p) or (m, 3): return R (3 m, p) with R' R = J' V_w^-1 J."""
        stacked = np.ascontiguousarray(values, dtype=np.float64).reshape(3 * len(self.root), -1)
        out = np.empty_like(stacked)
        _whiten(self.start, self.factor, self.root, stacked, out)
        return out

    def finish(self, whitened: Floats) -> Floats:
        """Turn whitened rows into R (3 m, p) with R' R = J' V_w^-1 (d V_w / d s^2) V_w^-1 J."""
        out = np.empty_like(whitened)
        _finish(self.start, self.factor, whitened, out)
        return out


def marginals(
    station: Floats, velocity: Floats, by_joint: Floats, variance: Floats, excess: float, error: Floats
) -> Marginals:
    """Compute the covariances of m rows, each by itself.

    Args:
        station: (m, 3, 3) covariance of the fixes due to the station, mm^2.
        velocity: (m, 3) motion of the prism within one sigma of timing, mm.
        by_joint: (m, 3, joints) derivatives by the readings.
        variance: (m, joints) variance of the readings, deg^2 or mm^2.
        excess: s^2, mm^2.
        error: (m, 3) measured minus modelled, mm.
    """
    m = len(error)
    out = Marginals(np.empty((m, 3, 3)), np.empty(m), np.empty(m), np.empty((m, 2)))
    _blocks(station, velocity, by_joint, variance, excess, out.block)
    _marginals(out.block, np.ascontiguousarray(error), out.square, out.log_det, out.trace)
    return out


def factorise(start: Integers, of_rows: Marginals, by_joint: Floats, shared: Floats, weight: Floats) -> Whitening:
    """Factor the covariance of m rows that are sorted by standstill.

    Args:
        start: (groups + 1,) first row of each standstill, and m.
        of_rows: the rows' own covariances.
        by_joint: (m, 3, joints) derivatives by the readings.
        shared: (m, joints) variance of the readings that the fixes of a standstill have in common, deg^2 or mm^2.
        weight: (m,) probability that a row is no outlier.
    """
    root = np.sqrt(weight)
    factor = np.zeros((3 * len(root), 3 * int(np.diff(start).max(initial=1))))
    sums = np.empty(3)
    _factorise(start, of_rows.block, by_joint, np.sqrt(shared), root, factor, sums)
    dropped = (1.0 - weight) @ of_rows.trace
    return Whitening(start, root, factor, float(sums[0]), (float(sums[1] - dropped[0]), float(sums[2] - dropped[1])))
