"""Circles and lines through the positions of a prism while one joint moves, with derivatives by each position.

Least squares of the geometric distance (for a circle: out of its plane and off its radius), by Levenberg-Marquardt from
the algebraic fit. Gross outliers are removed first: the circle through three positions, or line through two, with the
smallest median distance decides which positions count (Rousseeuw's least median of squares).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats

Kind = Literal["revolute", "prismatic"]

DIRECTION, CENTRE, RADIUS, TRAVEL = slice(0, 3), slice(3, 6), 6, 7
FEATURES = 8

_ROUNDS = 50
_GAIN = 1e-10  # relative decrease of the squares at which the iteration ends
_EXACT = 1e-9  # of the radius; positions of a model that turns about one axis fit as exactly
_TRIED = 40  # positions
_TRIALS = 300  # circles or lines
_OUTLYING = 4.5  # standard deviations
_GROWTH = 10  # rounds


@dataclass(frozen=True)
class SweepCurve:
    """A circle or a line.

    Attributes:
        features: (8,) direction, centre, radius and travel. The direction is that of right-handed rotation, or of
            motion along a line, as readings increase. The centre, mm, is the middle of a line. The radius, mm, is 0 for
            a line. The travel is in rad or mm per unit of reading.
        sensitivity: (8, n, 3) derivative of the features by the positions.
        distance_mm: (n,) distance of the positions from the curve.
    """

    features: Floats
    sensitivity: Floats
    distance_mm: Floats

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the residuals: two for each position, minus the parameters of the curve."""
        return 2 * len(self.distance_mm) - (6 if self.features[RADIUS] else 4)


def fit_curve(kind: Kind, places_mm: Floats, readings: Floats) -> SweepCurve:
    """Fit the circle or line with the least sum of squared distances.

    Args:
        kind: `revolute` for a circle, `prismatic` for a line.
        places_mm: (n, 3) positions, at least 3, not all the same.
        readings: (n,) readings of the joint, not all the same; they determine the sense of direction and the travel.
    """
    if kind == "revolute":
        return _curve_of_circle(_least_squares_circle(places_mm), places_mm, readings)
    return _line(places_mm, readings)


def without_outliers(kind: Kind, places_mm: Floats, sigma_mm: float) -> NDArray[np.bool_]:
    """Return an (n,) mask of positions on one circle or line.

    Args:
        kind: `revolute` for a circle, `prismatic` for a line.
        places_mm: (n, 3) positions.
        sigma_mm: noise of a position; the scatter about the curve is used instead if it is larger.
    """
    n, taken = len(places_mm), 3 if kind == "revolute" else 2
    some = np.linspace(0, n - 1, min(n, _TRIED)).astype(int).tolist()
    every = np.array(list(itertools.combinations(some, taken)))
    chosen = every[np.linspace(0, len(every) - 1, min(len(every), _TRIALS)).astype(int)]
    corners = places_mm[chosen]  # (trials, taken, 3)
    distance = _from_circles(places_mm, corners) if kind == "revolute" else _from_lines(places_mm, corners)
    middle = np.median(distance, axis=1)
    best = int(np.nanargmin(middle)) if np.isfinite(middle).any() else 0
    kept: NDArray[np.bool_] = distance[best] <= _OUTLYING * max(1.4826 * middle[best], sigma_mm)
    for _ in range(_GROWTH):
        if 2 * kept.sum() <= (6 if kind == "revolute" else 4):
            break
        deviation, scatter = (_off_circle if kind == "revolute" else _off_line)(places_mm, kept)
        agrees = deviation <= _OUTLYING * max(scatter, sigma_mm)
        if (agrees == kept).all():
            break
        kept = agrees
    return kept


def _off_circle(places: Floats, kept: NDArray[np.bool_]) -> tuple[Floats, float]:
    """Return (n,) distances from the circle of the kept positions, scaled for its uncertainty there; and scatter."""
    through = _least_squares_circle(places[kept])
    jacobian = through.jacobian()
    covariance = np.linalg.pinv(jacobian.T @ jacobian)
    everywhere = _Round.of(places, through.normal, through.centre, through.radius)
    rows = everywhere.jacobian()
    unsure = np.einsum("ni,ij,nj->n", rows, covariance, rows).reshape(2, -1)
    square = np.array([everywhere.height, everywhere.excess]) ** 2 / (1.0 + unsure)
    scatter = float(np.sqrt(through.squares / max(2 * kept.sum() - 6, 1)))
    return np.asarray(np.sqrt(square.sum(axis=0))), scatter


def _off_line(places: Floats, kept: NDArray[np.bool_]) -> tuple[Floats, float]:
    """Return distances and scatter as `_off_circle`, for a line."""
    middle = places[kept].mean(axis=0)
    direction = np.linalg.svd(places[kept] - middle, full_matrices=False)[2][0]
    along = (places - middle) @ direction
    away = np.linalg.norm(places - middle - along[:, None] * direction, axis=1)
    unsure = 1.0 / kept.sum() + along**2 / float(along[kept] @ along[kept])
    scatter = float(np.sqrt((away[kept] ** 2).sum() / max(2 * kept.sum() - 4, 1)))
    return np.asarray(away / np.sqrt(1.0 + unsure)), scatter


def _from_circles(places: Floats, corners: Floats) -> Floats:
    """Return (trials, n) distances of positions (n, 3) from the circles through corners (trials, 3, 3)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(a, b)
    square = (normal**2).sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):  # corners on a line give NaN, which is never the best
        to_centre = (
            np.cross(normal, a) * (b**2).sum(axis=1, keepdims=True)
            + np.cross(b, normal) * (a**2).sum(axis=1, keepdims=True)
        ) / (2.0 * square)
        normal = normal / np.sqrt(square)
        radius = np.linalg.norm(to_centre, axis=1)
        arm = places - (corners[:, 0] + to_centre)[:, None, :]
        out = np.einsum("tni,ti->tn", arm, normal)
        across = np.linalg.norm(arm - out[:, :, None] * normal[:, None, :], axis=2)
        return np.asarray(np.hypot(out, across - radius[:, None]))


def _from_lines(places: Floats, corners: Floats) -> Floats:
    """Return (trials, n) distances of positions (n, 3) from the lines through corners (trials, 2, 3)."""
    along = corners[:, 1] - corners[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        arm = places - corners[:, 0][:, None, :]
        out = np.einsum("tni,ti->tn", arm, along)
        return np.asarray(np.linalg.norm(arm - out[:, :, None] * along[:, None, :], axis=2))


# -- circle ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Round:
    """A circle with its residuals: heights of the positions over its plane, and their excess over its radius."""

    u: Floats
    v: Floats
    normal: Floats
    centre: Floats
    radius: float
    height: Floats
    outward: Floats  # (n, 3) unit vectors in the plane
    excess: Floats

    @classmethod
    def of(cls, places: Floats, normal: Floats, centre: Floats, radius: float) -> _Round:
        u = _across(normal)
        arm = places - centre
        height = arm @ normal
        flat = arm - height[:, None] * normal
        length = np.linalg.norm(flat, axis=1)
        outward = flat / np.maximum(length, 1e-9)[:, None]
        return cls(u, np.cross(normal, u), normal, centre, radius, height, outward, length - radius)

    @property
    def squares(self) -> float:
        return float(self.height @ self.height + self.excess @ self.excess)

    def jacobian(self) -> Floats:
        """Return (2 n, 6) derivatives of heights and excesses by tilts towards u and v, centre and radius."""
        n = len(self.height)
        out = np.zeros((2 * n, 6))
        arm = self.height[:, None] * self.normal + (self.excess + self.radius)[:, None] * self.outward
        for i, tangent in enumerate((self.u, self.v)):
            out[:n, i] = arm @ tangent
            out[n:, i] = -self.height * (self.outward @ tangent)
        out[:n, 2:5] = -self.normal
        out[n:, 2:5] = -self.outward
        out[n:, 5] = -1.0
        return out

    def moved(self, places: Floats, step: Floats) -> _Round:
        normal = self.normal + step[0] * self.u + step[1] * self.v
        return _Round.of(
            places, normal / np.linalg.norm(normal), self.centre + step[2:5], abs(self.radius + float(step[5]))
        )


def _least_squares_circle(places: Floats) -> _Round:
    now = _algebraic_circle(places)
    # The step is solved in tilts times the radius, so that all six unknowns are lengths.
    damping = 1e-6
    for _ in range(_ROUNDS):
        if now.squares <= (_EXACT * now.radius) ** 2:
            break
        scale = np.array([max(now.radius, 1.0)] * 2 + [1.0] * 4)
        jacobian = now.jacobian() / scale
        normal = jacobian.T @ jacobian
        gradient = jacobian.T @ np.concatenate([now.height, now.excess])
        step = np.linalg.lstsq(normal + damping * np.diag(np.diag(normal)), -gradient, rcond=None)[0] / scale
        then = now.moved(places, step)
        if then.squares <= now.squares:
            gain = now.squares - then.squares
            now, damping = then, max(damping / 10.0, 1e-12)
            if gain <= _GAIN * now.squares:
                break
        elif damping > 1e6:
            break
        else:
            damping *= 10.0
    return now


def _algebraic_circle(places: Floats) -> _Round:
    middle = places.mean(axis=0)
    _, size, vt = np.linalg.svd(places - middle, full_matrices=False)
    u, v, normal = vt
    flat = (places - middle) @ np.column_stack([u, v])
    # |p|^2 = 2 c p + (r^2 - |c|^2), in units of the spread
    unit = max(float(size[0]), 1e-9)
    flat = flat / unit
    design = np.column_stack([2.0 * flat, np.ones(len(flat))])
    a, b, c = np.linalg.lstsq(design, (flat**2).sum(axis=1), rcond=1e-9)[0]
    radius = unit * np.sqrt(max(c + a * a + b * b, 1e-12))
    return _Round.of(places, normal, middle + unit * (a * u + b * v), float(radius))


def _curve_of_circle(found: _Round, places: Floats, readings: Floats) -> SweepCurve:
    n = len(places)
    order = np.argsort(readings, kind="stable")
    phase = np.empty(n)
    phase[order] = np.unwrap(np.arctan2(found.outward @ found.v, found.outward @ found.u)[order])
    centred = readings - readings.mean()
    travel = float(centred @ phase) / float(centred @ centred)
    sense = -1.0 if travel < 0.0 else 1.0
    # A position affects its height along the normal and its excess along the outward vector; both affect the unknowns.
    inverse = np.linalg.pinv(found.jacobian())[:, :, None]
    unknowns = -(inverse[:, :n] * found.normal + inverse[:, n:] * found.outward)  # (6, n, 3)
    sensitivity = np.zeros((FEATURES, n, 3))
    sensitivity[DIRECTION] = sense * (found.u[:, None, None] * unknowns[0] + found.v[:, None, None] * unknowns[1])
    sensitivity[CENTRE] = unknowns[2:5]
    sensitivity[RADIUS] = unknowns[5]
    tangent = np.cross(found.normal, found.outward)
    share = sense * centred / float(centred @ centred) / np.maximum(found.radius + found.excess, 1e-9)
    sensitivity[TRAVEL] = share[:, None] * tangent - np.tensordot(share @ tangent, unknowns[2:5], axes=1)
    features = np.concatenate([sense * found.normal, found.centre, [found.radius, abs(travel)]])
    return SweepCurve(features, sensitivity, np.hypot(found.height, found.excess))


# -- line ------------------------------------------------------------------------------------------------------------


def _line(places: Floats, readings: Floats) -> SweepCurve:
    n = len(places)
    middle = places.mean(axis=0)
    arm = places - middle
    direction = np.linalg.svd(arm, full_matrices=False)[2][0]
    along = arm @ direction
    centred = readings - readings.mean()
    travel = float(centred @ along) / float(centred @ centred)
    sense = -1.0 if travel < 0.0 else 1.0
    off = arm - along[:, None] * direction
    across = np.eye(3) - np.outer(direction, direction)
    sensitivity = np.zeros((FEATURES, n, 3))
    sensitivity[DIRECTION] = sense * across[:, None, :] * (along / max(float(along @ along), 1e-12))[:, None]
    sensitivity[CENTRE] = np.broadcast_to(np.eye(3)[:, None, :] / n, (3, n, 3))
    sensitivity[TRAVEL] = sense * (centred / float(centred @ centred))[:, None] * direction
    features = np.concatenate([sense * direction, middle, [0.0, abs(travel)]])
    return SweepCurve(features, sensitivity, np.linalg.norm(off, axis=1))


def _across(direction: Floats) -> Floats:
    """Return a unit vector perpendicular to a direction."""
    axis = np.zeros(3)
    axis[int(np.abs(direction).argmin())] = 1.0
    out = axis - (axis @ direction) * direction
    return np.asarray(out / np.linalg.norm(out))
