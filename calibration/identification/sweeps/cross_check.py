"""Comparison of the identified model with the axes measured by single-joint sweeps, joint by joint.

The model's axis of a sweep is that of the circle or line through its predicted positions for that sweep, so that
measurement and model are fitted in the same way. Two results are distinguished: the joint's axis itself, which wrong
constants farther out do not affect, and the curve of the prism about or along it (a circle's radius and plane, a line's
position), which depends on all constants out to the prism.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from calibration.identification.noise import reading_variance
from calibration.identification.sweeps.circle_fit import CENTRE, DIRECTION, FEATURES, RADIUS, TRAVEL
from calibration.identification.sweeps.circles import Axis, drives_several, predicted_curve
from calibration.kinematics.chain import Chain
from calibration.observations import Floats

_CHANCE = 0.001  # probability that any axis of a correct model is reported
_REVERSED = 0.5 * np.pi


@dataclass(frozen=True)
class AxisCheck:
    """Comparison of a sweep's measured axis with the model's; sigmas include measurement, readings and model.

    Attributes:
        joint: joint that is swept.
        setup: set-up of the sweep.
        prism: prism of the sweep.
        angle_deg: angle between the axes.
        angle_sigma_deg: its standard error.
        offset_mm: distance of the centres across the axis.
        offset_sigma_mm: its standard error.
        along_mm: measured minus modelled position of the circle's plane along its axis; 0 for a line.
        along_sigma_mm: its standard error.
        radius_mm: measured minus modelled radius; 0 for a line.
        radius_sigma_mm: its standard error.
        travel: ratio of measured to modelled motion for the same change of reading.
        travel_sigma: its standard error.
        p_axis: probability that chance alone makes the axis and its travel differ by so much.
        p_curve: the same for the features that also depend on the prism: the circle's radius and plane, a line's
            position.
        sentence: description of a significant difference, or None.
    """

    joint: str
    setup: str
    prism: str
    angle_deg: float
    angle_sigma_deg: float
    offset_mm: float
    offset_sigma_mm: float
    along_mm: float
    along_sigma_mm: float
    radius_mm: float
    radius_sigma_mm: float
    travel: float
    travel_sigma: float
    p_axis: float
    p_curve: float
    sentence: str | None


def cross_check(chain: Chain, x: Floats, covariance: Floats, axes: Sequence[Axis]) -> tuple[AxisCheck, ...]:
    """Compare every measured axis with the model's.

    A difference is significant if chance causes one in fewer than one in a thousand checks of a correct model. The
    model's covariance is added to that of the sweep, which is conservative where the sweep was part of the fit.

    Args:
        chain: kinematics.
        x: (p,) identified parameters.
        covariance: (p, p) covariance of the parameters.
        axes: result of `find_axes`.

    Returns:
        One comparison for each axis, in the same order: from the base outwards.
    """
    return tuple(_check(chain, x, covariance, axis, _CHANCE / (2 * len(axes))) for axis in axes)


def disagreements(checks: Sequence[AxisCheck]) -> tuple[str, ...]:
    """Return one sentence for each joint that disagrees significantly, the joint nearest to the base first.

    Of the differences of one joint, that of the axis itself takes precedence over that of a curve.
    """
    worst: dict[str, AxisCheck] = {}
    for check in sorted((c for c in checks if c.sentence), key=lambda c: (c.p_axis, c.p_curve)):
        worst.setdefault(check.joint, check)
    joints = dict.fromkeys(check.joint for check in checks)
    return tuple(str(worst[joint].sentence) for joint in joints if joint in worst)


def _check(chain: Chain, x: Floats, covariance: Floats, axis: Axis, chance: float) -> AxisCheck:
    modelled = predicted_curve(chain, x, axis)
    total = axis.covariance + _model_covariance(chain, x, covariance, axis, modelled.sensitivity)
    difference = axis.features - modelled.features
    direction = modelled.features[DIRECTION]
    tilt = difference[DIRECTION] - (difference[DIRECTION] @ direction) * direction
    angle = float(np.arccos(np.clip(axis.direction @ direction, -1.0, 1.0)))
    across = difference[CENTRE] - (difference[CENTRE] @ direction) * direction

    # Rows that select the independent differences: tilt (2), shift across (2), travel; and plane, radius.
    u, v = np.linalg.svd(direction[None, :])[2][1:]
    line = np.zeros((5, FEATURES))
    line[0, DIRECTION], line[1, DIRECTION], line[2, CENTRE], line[3, CENTRE], line[4, TRAVEL] = u, v, u, v, 1.0
    circle = np.zeros((2, FEATURES))
    circle[0, CENTRE], circle[1, RADIUS] = direction, 1.0
    turns = axis.kind == "revolute"
    # A prismatic joint has a direction but no position, and a joint that drives several rows turns about no axis
    # of the machine. The position of their curves depends on the prism.
    if not turns or drives_several(chain, axis):
        line, circle = line[[0, 1, 4]], np.vstack([line[2:4], circle])
    if not turns:
        circle = circle[:2]
    p_axis = _chance(line, difference, total, axis.freedom)
    p_curve = _chance(circle, difference, total, axis.freedom)

    def sigma(way: Floats, part: slice) -> float:
        """Return the standard deviation along the difference `way`, or along `u` if there is none."""
        size = float(np.linalg.norm(way))
        unit = way / size if size > 0.0 else u
        return float(np.sqrt(unit @ total[part, part] @ unit))

    travel = axis.travel / max(float(modelled.features[TRAVEL]), 1e-12)
    check = AxisCheck(
        joint=axis.joint,
        setup=axis.setup,
        prism=axis.prism,
        angle_deg=float(np.degrees(angle)),
        angle_sigma_deg=float(np.degrees(sigma(tilt, DIRECTION))),
        offset_mm=float(np.linalg.norm(across)),
        offset_sigma_mm=sigma(across, CENTRE),
        along_mm=float(difference[CENTRE] @ direction) if turns else 0.0,
        along_sigma_mm=float(np.sqrt(direction @ total[CENTRE, CENTRE] @ direction)) if turns else 0.0,
        radius_mm=float(difference[RADIUS]),
        radius_sigma_mm=float(np.sqrt(total[RADIUS, RADIUS])),
        travel=travel,
        travel_sigma=float(np.sqrt(total[TRAVEL, TRAVEL])) / max(float(modelled.features[TRAVEL]), 1e-12),
        p_axis=p_axis,
        p_curve=p_curve,
        sentence=None,
    )
    return _with_sentence(check, chance, turns=turns)


def _model_covariance(chain: Chain, x: Floats, covariance: Floats, axis: Axis, sensitivity: Floats) -> Floats:
    """Return the (8, 8) covariance of the modelled features, due to parameters and readings of the standing joints."""
    lin = chain.linearise(x, axis.sweep)
    by_place = sensitivity.reshape(FEATURES, -1)
    by_parameter = by_place @ lin.jacobian.reshape(-1, len(x))
    by_reading = by_place @ lin.joint_jacobian.reshape(-1, len(chain.rig.joints))
    sigma = np.sqrt(reading_variance(chain.rig))
    sigma[chain.rig.joint_names.index(axis.joint)] = 0.0  # its readings only move the positions along the curve
    readings: Floats = (by_reading * sigma) @ (by_reading * sigma).T
    return by_parameter @ covariance @ by_parameter.T + readings


def _chance(pick: Floats, difference: Floats, covariance: Floats, freedom: int) -> float:
    """Return the probability of so large a difference by Hotelling's T^2 as F, since the noise is estimated too."""
    part = pick @ difference
    own = pick @ covariance @ pick.T
    scale = 1.0 / np.sqrt(np.diag(own))
    square = float(part * scale @ np.linalg.solve(own * scale[:, None] * scale, part * scale))
    return float(fdtrc(len(part), max(freedom, 1), square / len(part)))


def _with_sentence(check: AxisCheck, chance: float, *, turns: bool) -> AxisCheck:
    where = f"by the sweep of prism {check.prism}" + (f" at set-up {check.setup!r}" if check.setup else "")
    text = None
    if np.radians(check.angle_deg) > _REVERSED:
        text = f"{check.joint} runs the opposite way to the model {where}: is its sign right?"
    elif check.p_axis < chance:
        away = f" and {check.offset_mm:.1f} +- {check.offset_sigma_mm:.1f} mm" if turns else ""
        parts = [f"{check.angle_deg:.2f} +- {check.angle_sigma_deg:.2f} deg{away} from its place in the model"]
        if abs(check.travel - 1.0) > 4.0 * check.travel_sigma:
            parts.append(f"moves {check.travel:.4g} times as far as in the model for the same change of reading")
        text = f"the axis of {check.joint} {where} is {' and it '.join(parts)}"
    elif check.p_curve < chance and not turns:
        text = (
            f"as {check.joint} moves, prism {check.prism} runs {check.offset_mm:.1f} +- {check.offset_sigma_mm:.1f} mm "
            f"away from its line in the model"
        )
    elif check.p_curve < chance:
        text = (
            f"about {check.joint}, prism {check.prism} moves on a circle that differs from the model's by "
            f"{check.radius_mm:+.1f} +- {check.radius_sigma_mm:.1f} mm in radius and {check.along_mm:+.1f} +- "
            f"{check.along_sigma_mm:.1f} mm along the axis"
        )
    return replace(check, sentence=text)
