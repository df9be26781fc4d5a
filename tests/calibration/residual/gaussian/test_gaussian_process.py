"""The joint-space Gaussian process: finds which joint errs with what, and says nothing where there is nothing."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from calibration.observations import Floats
from calibration.residual.features import Features
from calibration.residual.gaussian.curves import Curve, CurveSum, Variable, products, waves
from calibration.residual.gaussian.process import GaussianProcess, fit_gaussian_process

JOINTS = 3
LENGTHS = (4000.0, 3000.0, 2000.0)


def arm(n: int, seed: int, *, turn: float = 60.0) -> Features:
    """A planar arm with two irrelevant signals, a pressure that matters and a direction."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-turn, turn, (n, JOINTS))
    angle = np.radians(np.cumsum(q, axis=1))
    along = np.stack([np.cos(angle), np.sin(angle)], axis=2) * np.array(LENGTHS)[:, None]
    beyond = np.cumsum(along[:, ::-1], axis=1)[:, ::-1]
    jacobian = np.zeros((n, 3, JOINTS))
    jacobian[:, 0], jacobian[:, 1] = -np.radians(beyond[:, :, 1]), np.radians(beyond[:, :, 0])
    signals = np.column_stack(
        [rng.uniform(40, 200, n), rng.choice([-1.0, 1.0], n), rng.normal(size=n), np.sort(rng.uniform(-10, 30, n))]
    )
    names = ("q1_deg", "q2_deg", "q3_deg", "frame1_x_mm", "lift_bar", "q2_dir", "idle_mA", "air_degC")
    geometry = np.hstack([q, np.full((n, 1), 7.0)])
    return Features(names, geometry, signals, jacobian, jacobian.copy())


def truth(seen: Features) -> Floats:
    """Encoder eccentricity at q1, slack at q2, q3 yields with the pressure."""
    q, bar, direction = seen.geometry[:, 0], seen.signals[:, 0], seen.signals[:, 1]
    error = np.column_stack([0.06 * np.sin(np.radians(2 * q)), 0.03 * direction, 1e-5 * (bar - 100.0) ** 2])
    moved: Floats = (seen.joint_jacobian @ error[:, :, None])[:, :, 0]
    return moved


def rms(error: Floats) -> float:
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def learned(n: int = 500, noise_mm: float = 1.0, seed: int = 1) -> tuple[GaussianProcess, Floats]:
    seen, unseen = arm(n, seed), arm(1000, seed + 1000)
    process = fit_gaussian_process(seen, truth(seen) + np.random.default_rng(seed).normal(0, noise_mm, (n, 3)), 0)
    assert process is not None
    return process, truth(unseen) - process.predict(unseen)


def test_it_finds_which_joint_errs_with_what_and_nothing_else() -> None:
    process, left = learned()
    found = {(c.lever, tuple(process.names[a] for a in c.axes)) for c in process.curves}
    assert found == {(0, ("q1_deg",)), (1, ("q2_dir",)), (2, ("lift_bar",))}
    assert rms(left) < 0.1 * rms(truth(arm(1000, 1001)))


def test_a_start_at_what_similar_rows_showed_comes_to_the_same_and_keeps_nothing_else() -> None:
    process, _ = learned()
    seen, unseen = arm(500, 7), arm(1000, 1007)
    target = truth(seen) + np.random.default_rng(7).normal(0, 1.0, (500, 3))
    alone, begun = (fit_gaussian_process(seen, target, 0, start) for start in (None, process.found))
    assert alone is not None
    assert begun is not None
    assert rms(alone.predict(unseen) - begun.predict(unseen)) < 0.02 * rms(truth(unseen))
    of_noise = fit_gaussian_process(seen, np.random.default_rng(8).normal(0, 1.0, (500, 3)), 0, process.found)
    assert of_noise is not None
    assert rms(of_noise.predict(unseen)) < 0.15  # of noise of 1 mm


@pytest.mark.parametrize("seed", range(5))
def test_it_finds_nothing_in_noise(seed: int) -> None:
    seen = arm(300, seed)
    assert fit_gaussian_process(seen, np.random.default_rng(seed).normal(0, 1.0, (300, 3)), 0) is None


def test_it_finds_an_error_that_needs_two_variables_at_once() -> None:
    seen, unseen = arm(800, 3), arm(500, 4)

    def product(of: Features) -> Floats:
        error = 4e-4 * of.signals[:, 1] * (of.signals[:, 0] - 40.0)
        return np.asarray(of.joint_jacobian[:, :, 1] * error[:, None])

    process = fit_gaussian_process(seen, product(seen) + np.random.default_rng(0).normal(0, 1.0, (800, 3)), 0)
    assert process is not None
    assert rms(product(unseen) - process.predict(unseen)) < 0.2 * rms(product(unseen))


def test_what_the_kinematics_took_for_an_error_of_their_own_comes_back() -> None:
    seen, unseen = arm(500, 5), arm(500, 6)

    def left_by_kinematics(of: Features) -> Floats:
        """The offset of q1 was fitted to the eccentricity's mean."""
        return truth(of) - of.parameter_jacobian[:, :, 0] * 0.02

    target = left_by_kinematics(seen) + np.random.default_rng(0).normal(0, 0.5, (500, 3))
    process = fit_gaussian_process(seen, target, 0)
    assert process is not None
    assert rms(left_by_kinematics(unseen) - process.predict(unseen)) < 0.1 * rms(left_by_kinematics(unseen))


def test_a_signal_that_is_missing_leaves_its_curve_out_and_the_others_in() -> None:
    process, _ = learned()
    unseen = arm(200, 7)
    blind = unseen.signals.copy()
    blind[:, 0] = np.nan
    without = Features(unseen.names, unseen.geometry, blind, unseen.joint_jacobian, unseen.parameter_jacobian)
    left = truth(unseen) - process.predict(without)
    assert np.isfinite(left).all()
    assert rms(left) < rms(truth(unseen))


def test_it_reads_back_bit_for_bit_and_refuses_what_does_not_fit() -> None:
    process, _ = learned()
    files = process.to_files()
    unseen = arm(100, 8)
    assert np.array_equal(GaussianProcess.from_files(files).predict(unseen), process.predict(unseen))
    text = files["gaussian_process.json"]
    broken: list[tuple[str, dict[str, object]]] = [
        ("curves", {"lever": -1}),
        ("curves", {"axes": [99]}),
        ("curves", {"counts": [10**6]}),
        ("curves", {"axes": []}),
        ("axes", {"low": math.nan}),
        ("axes", {"low": 9.0, "high": -9.0}),
    ]
    for part, change in broken:
        other = json.loads(text)
        other[part][0].update(change)
        with pytest.raises(ValueError, match="Gaussian process"):
            GaussianProcess.from_files(files | {"gaussian_process.json": json.dumps(other).encode()})
    lost = replace(process, weights=np.full_like(process.weights, np.nan))
    with pytest.raises(ValueError, match="weights that are not finite"):
        GaussianProcess.from_files(lost.to_files())


def test_it_fits_no_rig_with_other_joints_or_parameters() -> None:
    process, _ = learned()
    seen = arm(5, 1)
    assert process.fits(seen)
    assert not process.fits(replace(seen, names=("other", *seen.names[1:])))
    assert not process.fits(replace(seen, parameter_jacobian=np.empty((5, 3, JOINTS + 1))))


def test_nothing_to_learn_from_is_no_process() -> None:
    seen = arm(60, 1)
    still = replace(seen, geometry=np.ones_like(seen.geometry), signals=np.ones_like(seen.signals))
    assert fit_gaussian_process(still, np.ones((60, 3)), 0) is None
    assert fit_gaussian_process(seen, np.zeros((60, 3)), 0) is None


def test_the_same_rows_give_the_same_process() -> None:
    one, other = learned()[0], learned()[0]
    assert one.curves == other.curves
    assert np.array_equal(one.weights, other.weights)


@pytest.mark.parametrize("is_periodic", [False, True])
def test_compiled_curves_are_the_sum_of_their_waves(is_periodic: bool) -> None:
    rng = np.random.default_rng(0)
    axes = (Variable(-3.0, 5.0, False), Variable(-180.0, 180.0, is_periodic))
    curves = (Curve(0, (1,), (6,)), Curve(3, (0, 1), (3, 4)), Curve(4, (0,), (1,)))
    weights = rng.normal(size=6 + 12 + 1)
    values, jacobian = rng.uniform(-200, 200, (50, 2)), rng.normal(size=(50, 3, JOINTS))
    values[3, 0], values[4, 1] = np.nan, np.nan
    expected = np.zeros((50, 3))
    at = 0
    for curve in curves:
        parts = [
            waves(axes[a], axes[a].scaled(values[:, a]), c)[0] for a, c in zip(curve.axes, curve.counts, strict=True)
        ]
        basis = parts[0] if len(parts) == 1 else products(*parts)
        error = basis @ weights[at : at + curve.size]
        at += curve.size
        lever = np.eye(3)[curve.lever - JOINTS] if curve.lever >= JOINTS else jacobian[:, :, curve.lever]
        expected += error[:, None] * lever
    np.testing.assert_allclose(CurveSum(axes, curves, weights).moved_mm(values, jacobian), expected, atol=1e-11)
