"""Warnings about a calibration, its data and its result, one sentence each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from calibration.effects.fitted import missing_inputs
from calibration.effects.library import library
from calibration.identification.reading_steps import rounding
from calibration.identification.solve import Solution
from calibration.model.model import CalibratedModel, Outlier
from calibration.model.prediction import Predictor
from calibration.model.warnings import farthest, times_computed, torque_unit_warnings
from calibration.observations import Observations
from calibration.rig.description import ANOTHER_VALUE, BEYOND_BUILDING
from calibration.rig.limits import beyond_limits, never_moved

_LISTED = 10
_TOGETHER = 0.9  # least share of the outliers with a common label
_NOT_ALL = 0.7  # greatest share of all fixes with that label
_BADLY = 0.3  # of what build tolerances explain
_FAR_RAD = math.radians(10.0)
_BEYOND_LIMITS = 0.05  # of the span between a joint's limits
_TOO_SMALL = 0.4  # of the expected scatter
_FAR_NOISIER = 2.0  # times the noise of instruments and repeats
_FEW_FIXES = 6


def training_warnings(model: CalibratedModel, observations: Observations, solution: Solution) -> Iterator[str]:
    """Yield all warnings of a calibration.

    Args:
        model: the model with its outliers.
        observations: the rows to which it was fitted, without copies.
        solution: the identification from which it was made.
    """
    yield from solution.warnings
    context = Predictor.of(model).context(observations)
    yield from missing_inputs(model.effects, context)
    yield from torque_unit_warnings(times_computed(context))
    rounding_mm, rounded = rounding(context, model.effects_noise_mm)
    if rounded:
        yield rounded
    yield from _of_fit(model, observations, solution, rounding_mm)
    yield from _of_coverage(model, observations)
    yield from _of_outliers(model, observations, solution)
    yield from _of_result(model)
    if solution.has_priors:  # without priors, nearly redundant parameters go far although no file is wrong
        yield from _of_corrections(model)


def _of_fit(
    model: CalibratedModel, observations: Observations, solution: Solution, rounding_mm: float
) -> Iterator[str]:
    if not solution.fit.converged:
        yield "the fit did not converge; treat the result with care"
    unexplained_mm = math.sqrt(max(0.0, 3.0 * model.excess_sigma_mm**2 - rounding_mm**2))
    if unexplained_mm > _BADLY * solution.tolerated_mm:
        hint = "; try --prior as-built" if model.prior == "recalibration" else ""
        yield (
            f"the kinematics fit badly: {unexplained_mm:.1f} mm RMS remain that station and readings do not explain, "
            f"while build tolerances explain {solution.tolerated_mm:.0f} mm before the fit; check zeros and signs of "
            f"the joints, the rig file, and whether the station stood still{hint}"
        )
        return
    known_mm = math.sqrt(model.known_noise_mm2 + rounding_mm**2)
    if model.effects_noise_mm > _FAR_NOISIER * known_mm:
        given = ", whether the sigma columns are too small" if np.isfinite(observations.sigma_mm).any() else ""
        yield (
            f"the fixes scatter by {model.effects_noise_mm:.2g} mm RMS about the model, where station and readings "
            f"account for {known_mm:.2g} mm: check whether columns that effects need are missing{given}, whether the "
            f"prism sits tight and the station stood still, and whether readings and fixes are synchronised"
        )
    left = observations.position_mm - Predictor.of(model).effects_mm(observations)
    left_mm = math.sqrt(float((left**2).sum(axis=1).mean()))
    if left_mm < _TOO_SMALL * model.effects_noise_mm:
        yield (
            f"the fixes scatter by {left_mm:.2g} mm RMS where their standard deviations are "
            f"{model.effects_noise_mm:.2g} mm; too large ones make a loose fit: check the sigma columns or the rig "
            f"file's station, and its timing_sigma_s for fixes of a moving machine (simulated data without noise have "
            f"this effect too)"
        )


def _of_coverage(model: CalibratedModel, observations: Observations) -> Iterator[str]:
    for setup in sorted(model.placements):
        fixes = int((observations.setup == setup).sum())
        if fixes < _FEW_FIXES and len(model.placements) > 1:
            yield (
                f"set-up {setup!r} has only {fixes} fixes to determine its base; predicted positions of prisms there "
                f"are uncertain by {_seen_mm(model, observations, setup):.2g} mm RMS over the poses of all set-ups"
            )
    for prism, fixes in model.coverage.fixes.items():
        if fixes == 0:
            yield f"prism {prism!r} has no fixes; its offset stays at its nominal value"
    for joint in model.rig.joints:
        low, high = model.coverage.ranges[joint.name]
        if never_moved(joint, low, high):
            yield (
                f"{joint.name} never moved ({low:.2f} .. {high:.2f} {joint.unit}); "
                f"parameters that only its motion shows stay at their prior"
            )
        values = observations.joints[joint.name]
        beyond = int(beyond_limits(joint, values, _BEYOND_LIMITS).sum())
        if beyond:
            yield (
                f"{joint.name}: {beyond} of {len(values)} readings are beyond its limits {joint.limits[0]:g} .. "
                f"{joint.limits[1]:g} {joint.unit}; check column and unit"
            )


def _seen_mm(model: CalibratedModel, observations: Observations, setup: str) -> float:
    """Return the RMS 3-D standard deviation of prisms in a set-up's frame, due to parameters and effects."""
    there = replace(observations, setup=np.full(len(observations), setup))
    moved = Predictor.of(model).linearise(there).jacobian
    return math.sqrt(float(((moved @ model.covariance) * moved).sum()) / len(there))


def _of_outliers(model: CalibratedModel, observations: Observations, solution: Solution) -> Iterator[str]:
    outliers = Predictor.of(model).find_outliers(observations)
    if outliers:
        share = "were downweighted" if (solution.fit.weight < 1.0).any() else "have full weight in this method"
        yield (
            f"{len(outliers)} of {len(observations)} training fixes are outliers and {share}, "
            f"{farthest(observations, outliers)}{_where_together(observations, outliers)}"
        )


def _where_together(observations: Observations, outliers: Sequence[Outlier]) -> str:
    """Return a clause about a session, set-up or prism of nearly all outliers but not of most fixes; empty if none."""
    rows = [outlier.row for outlier in outliers]
    for what, labels, cause in (
        ("session", observations.session, "did the station move, or a joint's zero?"),
        ("set-up", observations.setup, "did the station move?"),
        ("prism", observations.prism, "does it sit tight, and was it always the prism that was measured?"),
    ):
        names, fixes = np.unique(labels[rows], return_counts=True)
        name, most = names[fixes.argmax()], int(fixes.max())
        if len(rows) >= _LISTED and most >= _TOGETHER * len(rows) and (labels == name).mean() < _NOT_ALL:
            return f"; {most} of them are of {what} {str(name)!r}: {cause}"
    return ""


def _of_result(model: CalibratedModel) -> Iterator[str]:
    for effect in model.effects:
        value = effect.coefficients[0].value
        if effect.family == "joint_compliance" and effect.where in model.coverage.torques and value < 0.0:
            yield (
                f"joint_compliance@{effect.where} is negative: {effect.where}_Nm seems to be the torque that holds the "
                f"load, not the load; the model uses it with that meaning"
            )
        scored = model.rig.masses or effect.where in model.coverage.torques
        if "joint_compliance" in library()[effect.family].confused_with and not scored:
            yield (
                f"{effect.family}@{effect.where} may be a deflection under load, which these data cannot show: give "
                f"masses in the rig file or measured torques in {effect.where}_Nm"
            )


def _of_corrections(model: CalibratedModel) -> Iterator[str]:
    held = model.prior == "recalibration"
    for parameter in model.parameters:
        size = f"{parameter.value:+.1f} mm"
        if parameter.unit == "rad":
            size = f"{math.degrees(parameter.value):+.2f} deg"
        if held and abs(parameter.pull) > ANOTHER_VALUE:
            yield (
                f"{parameter.name} is {size} off the rig file, {abs(parameter.pull):.0f} build tolerances, so it was "
                f"not held to them: was a zero set again, or a part mounted differently? correct the file"
            )
        elif parameter.kind == "row" and parameter.unit == "rad" and abs(parameter.value) > _FAR_RAD:
            yield (
                f"{parameter.name} is {size} from the rig file; check how the joint and its encoder are mounted, "
                f"and correct the file"
            )
    pulled = [p for p in model.parameters if BEYOND_BUILDING < abs(p.pull) <= ANOTHER_VALUE]
    if pulled and held:
        pulled.sort(key=lambda p: -abs(p.pull))
        names = ", ".join(f"{p.name} ({p.pull:+.1f})" for p in pulled[:_LISTED])
        size = f"{BEYOND_BUILDING:g} build tolerances"
        yield f"corrected by more than {size}: {names}; the cause may be an effect that is not in the model"
