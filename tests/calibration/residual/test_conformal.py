"""Intervals of 90 % cover 90 % of fixes that no part of the model was fitted to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.evaluation.evaluation import evaluate
from calibration.identification.refinement import refine
from calibration.identification.samples import left_out_errors
from calibration.identification.solve import place
from calibration.model.files import model_from_files, model_to_files
from calibration.model.intervals import with_intervals
from calibration.observations import Floats, parse_observations
from calibration.pipeline.calibrate import identify
from calibration.residual.conformal import Coverage, Intervals, StageIntervals, conformal_intervals, coverage
from calibration.rig.description import shipped_rig
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import Session, rig_text, simulated
from tests.simulated.observations import simulate_observations


def draw(seed: int, n: int, freedom: float) -> tuple[Floats, Floats]:
    """Errors of Student's t, twice as large along the plumb line as their standard deviations say."""
    rng = np.random.default_rng(seed)
    sigma = rng.uniform(1.0, 5.0, (n, 3))
    return sigma * rng.standard_t(freedom, (n, 3)) * [1.0, 1.0, 2.0], sigma


def covered_by(intervals: Intervals, error: Floats, formal: Floats) -> Coverage:
    return coverage(error, intervals.half_mm(formal), intervals.radius_mm(formal))


def test_without_data_intervals_are_those_of_normal_errors() -> None:
    rng = np.random.default_rng(0)
    covered = covered_by(Intervals(), rng.normal(0.0, 2.0, (100_000, 3)), np.full((100_000, 3), 2.0))
    assert covered.axes == pytest.approx((0.9, 0.9, 0.9), abs=0.005)
    assert covered.radius == pytest.approx(0.9, abs=0.005)


@pytest.mark.parametrize("freedom", [2.5, 100.0])
def test_errors_of_any_shape_and_size_are_covered(freedom: float) -> None:
    shares = []
    for seed in range(20):
        error, sigma = draw(seed, 200, freedom)
        intervals = conformal_intervals(error, sigma, 200)
        covered = covered_by(intervals, *draw(seed + 100, 2000, freedom))
        shares.append([*covered.axes, covered.radius])
    assert np.mean(shares, axis=0) == pytest.approx(0.9, abs=0.01)
    normal = covered_by(Intervals(), *draw(0, 20_000, freedom))
    assert normal.axes[2] < 0.65


def test_few_independent_rows_make_intervals_wider() -> None:
    error, sigma = draw(1, 400, 5.0)
    many, few = (conformal_intervals(error, sigma, count) for count in (400, 20))
    assert all(a > b for a, b in zip(few.axes, many.axes, strict=True))
    assert few.radius > many.radius


def test_errors_left_out_are_those_of_a_fit_that_never_saw_the_standstill() -> None:
    """Against the fit itself, made again without each of some standstills of four prisms."""
    rig = shipped_rig("swdt82")
    rows = simulated(RigTruth(rig, 3), 100, 3)
    pose = np.array([str(row // 4) for row in range(100)])
    rows = replace(rows, pose=pose, joints={k: v[np.arange(100) // 4 * 4] for k, v in rows.joints.items()})
    chain, samples, start = place(rig, rows)
    # Prisms that were measured in other poses than these readings say would be outliers: positions of the fit instead.
    at = chain.linearise(start.x, samples.data).position_mm + np.random.default_rng(0).normal(0.0, 3.0, (100, 3))
    samples = replace(samples, position_mm=at)
    nominal = np.isinf(chain.prior_sigma)
    first = refine(chain, samples, start.x, free=nominal)
    fit = refine(chain, samples, first.x, excess_variance=9.0)
    lin = chain.linearise(fit.x, samples.data)
    error = samples.position_mm - lin.position_mm
    apart = left_out_errors(rig, samples, error, lin.jacobian, lin.joint_jacobian, fit.covariance, 9.0)
    assert samples.standstill is not None
    for number in np.unique(samples.standstill)[::6]:
        out = samples.standstill == number
        assert out.sum() == 4
        rest = replace(
            samples,
            data=samples.data.select(~out),
            position_mm=samples.position_mm[~out],
            station_covariance=samples.station_covariance[~out],
            rates=samples.rates[~out],
            of_row=np.arange((~out).sum()),
            fixes=samples.fixes[~out],
            standstill=samples.standstill[~out],
        )
        again = refine(chain, rest, fit.x, excess_variance=9.0)
        true = samples.position_mm[out] - chain.linearise(again.x, samples.data.select(out)).position_mm
        assert np.linalg.norm(true - error[out]) > 1.0
        np.testing.assert_allclose(apart[out], true, atol=0.15 * np.abs(true - error[out]).max())


def test_a_calibrated_model_covers_held_out_fixes(session: Session) -> None:
    covered = evaluate(session.model, session.held_out).as_dict(0.0)["intervals"]
    assert isinstance(covered, dict)
    assert covered["level"] == 0.9
    assert np.mean(covered["axis_coverage"]) == pytest.approx(0.9, abs=0.03)
    assert covered["radius_coverage"] == pytest.approx(0.9, abs=0.04)


def test_at_another_set_up_x_and_y_are_alike_and_nothing_is_surer_than_at_home(session: Session) -> None:
    trained = session.model.intervals.hybrid
    home = trained.at_other_setups()
    assert home.axes[0] == home.axes[1]
    assert min(trained.axes[:2]) < home.axes[0] < max(trained.axes[:2])
    assert home.axes[2] == trained.axes[2]
    there = evaluate(session.model, session.held_out, refit_base=True).model.intervals
    assert there == there.or_wider(home)


@pytest.mark.long
def test_outliers_are_covered_like_other_fixes() -> None:
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, 12)
    rng = np.random.default_rng(5)
    found = []
    for seed, fixes in ((12, 250), (13, 800)):
        rows = simulated(truth, fixes, seed)
        bad = rng.permutation(fixes)[: fixes // 8]
        position = rows.position_mm.copy()
        position[bad] += rng.normal(0.0, 300.0, (len(bad), 3))
        found.append(replace(rows, position_mm=position))
    model = identify(rig, rig_text("swdt82"), found[0])
    evaluation = evaluate(model, found[1])
    assert evaluation.coverage.radius == pytest.approx(0.9, abs=0.04)
    assert model.intervals.hybrid.radius > 3.0  # an eighth of all fixes is anywhere


def test_an_outlier_makes_no_wider_what_stands_beside_it(session: Session) -> None:
    """A quarter of the standstills have one prism of four far off: 6 % of the fixes, fewer than intervals leave out."""
    data = simulate_observations(session.truth, 80, 14, prisms_per_pose="all", noise_mm=3.0)
    rows = parse_observations(data.csv_text().encode(), session.rig, "simulated.csv")
    position = rows.position_mm.copy()
    position[::16] += np.random.default_rng(0).normal(0.0, 10_000.0, position[::16].shape)
    wide = with_intervals(session.model, replace(rows, position_mm=position)).intervals.hybrid
    assert wide.radius == pytest.approx(with_intervals(session.model, rows).intervals.hybrid.radius, rel=0.4)


def test_intervals_travel_with_the_model(session: Session) -> None:
    model = session.model
    assert model.intervals != StageIntervals()
    assert with_intervals(model, session.training).intervals == model.intervals
    assert model_from_files(model_to_files(model)).intervals == model.intervals
