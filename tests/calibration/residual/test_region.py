"""Outside the region that a residual was trained on its estimate fades to zero, and the model says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.evaluation.evaluation import evaluate
from calibration.model.files import model_from_files, model_to_files
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.model.warnings import model_warnings
from calibration.observations import Floats, Observations
from calibration.pipeline.calibrate import identify, train_residual
from calibration.residual.features import Features
from calibration.residual.folds import folds
from calibration.residual.region import Region, fit_region
from calibration.rig.description import Joint, shipped_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import rig_text, rms, simulated

JOINTS = (
    Joint(name="a", kind="revolute", limits=(-170.0, 170.0), sigma=0.01),
    Joint(name="b", kind="revolute", limits=(-170.0, 170.0), sigma=0.01),
    Joint(name="c", kind="prismatic", limits=(0.0, 2000.0), sigma=0.1),
)
TURNS = np.array([360.0, 360.0, 0.0])
SIGNALS = ("oil_bar", "valve_mA")


def seen(readings: Floats, signals: Floats | None = None) -> Features:
    count = len(readings)
    given = np.column_stack([np.full(count, 100.0), np.full(count, 12.0)]) if signals is None else signals
    blank = np.zeros((count, 3, 0))
    return Features(("a_deg", "b_deg", "c_mm", *SIGNALS), readings, given, blank, blank)


def predict(features: Features) -> Floats:
    """Depends on the first joint and on the pressure; the valve current matters nothing."""
    pressure = np.nan_to_num(features.signals[:, 0], nan=1e6)
    return np.column_stack([features.geometry[:, 0] / 50.0, (pressure - 100.0) / 50.0, np.zeros(len(features))])


@pytest.fixture(scope="module")
def training() -> Features:
    rng = np.random.default_rng(0)
    readings = rng.uniform([-50.0, 150.0, 0.0], [50.0, 250.0, 1000.0], (400, 3))
    signals = rng.uniform([50.0, 4.0], [150.0, 20.0], (400, 2))
    signals[rng.uniform(size=400) < 0.2, 1] = np.nan
    return seen(readings, signals)


@pytest.fixture(scope="module")
def region(training: Features) -> Region:
    cells = np.array([f"{a:.0f},{b:.0f}" for a, b in np.round(training.geometry[:, :2] / 20.0)])
    return fit_region(training, JOINTS, TURNS, SIGNALS, folds(cells, 5, 0), predict, 1.0)


def weights(region: Region, readings: Floats, signals: Floats | None = None) -> Floats:
    return region.confine(seen(readings, signals))[1]


def test_rows_like_those_of_training_count_in_full(region: Region, training: Features) -> None:
    settled, weight = region.confine(training)
    np.testing.assert_array_equal(weight, 1.0)
    np.testing.assert_array_equal(settled.geometry, training.geometry)
    np.testing.assert_array_equal(settled.signals, training.signals)
    between = np.random.default_rng(1).uniform([-50.0, 150.0, 0.0], [50.0, 250.0, 1000.0], (500, 3))
    assert (weights(region, between) == 1.0).mean() > 0.98


def test_a_hole_the_size_of_held_out_cells_does_not_fade_and_a_large_one_does() -> None:
    everywhere = np.random.default_rng(2).uniform([-50.0, 150.0, 0.0], [50.0, 250.0, 1000.0], (3000, 3))

    def at_middle(hole: float) -> float:
        away = np.abs(everywhere - [0.0, 200.0, 500.0]) / [100.0, 100.0, 1000.0]
        kept = seen(everywhere[(away > hole).any(axis=1)])
        cells = np.array([f"{a:.0f},{b:.0f},{c:.0f}" for a, b, c in np.round(kept.geometry / [20.0, 20.0, 200.0])])
        found = fit_region(kept, JOINTS, TURNS, SIGNALS, folds(cells, 5, 0), predict, 1.0)
        return float(weights(found, np.array([[0.0, 200.0, 500.0]]))[0])

    assert at_middle(0.1) == 1.0
    assert at_middle(0.45) < 0.7


def test_beyond_a_joints_range_the_weight_falls_smoothly_to_zero(region: Region) -> None:
    a = np.arange(-50.0, 120.0, 0.25)
    weight = weights(region, np.column_stack([a, np.full(len(a), 200.0), np.full(len(a), 500.0)]))
    assert (np.diff(weight[a > 0.0]) <= 1e-12).all()
    assert np.abs(np.diff(weight)).max() < 0.03
    assert weight[a < 55.0].min() == 1.0
    assert weight[a > 85.0].max() == 0.0


def test_angles_are_the_same_after_whole_turns(region: Region) -> None:
    readings = np.array([[10.0, 200.0, 500.0], [80.0, 200.0, 500.0]])
    turned = readings + np.array([[360.0, -360.0, 0.0], [-720.0, -360.0, 0.0]])
    settled, weight = region.confine(seen(turned))
    np.testing.assert_allclose(settled.geometry, readings, atol=1e-9)
    np.testing.assert_allclose(weight, weights(region, readings), atol=1e-9)
    assert weight[0] == 1.0
    assert weight[1] < 1.0


def test_a_joint_trained_over_more_than_a_turn_is_the_same_after_whole_turns(training: Features) -> None:
    low, high = training.geometry.min(axis=0), training.geometry.max(axis=0)
    wide = -190.0 + 380.0 * (training.geometry - low) / (high - low)
    region = fit_region(replace(training, geometry=wide), JOINTS, TURNS, SIGNALS, np.arange(400) % 5, predict, 1.0)
    inside = wide[:5].copy()
    inside[:, 0] = [-185.0, -150.0, 0.0, 160.0, 185.0]
    away = inside.copy()
    away[:, 0] += [720.0, 360.0, -360.0, -360.0, 360.0]
    settled, weight = region.confine(seen(away))
    np.testing.assert_allclose(weight, weights(region, inside), atol=1e-9)
    np.testing.assert_allclose(settled.geometry[:, 0], [175.0, -150.0, 0.0, 160.0, -175.0], atol=1e-9)
    assert not [text for text in region.warnings(seen(away), JOINTS) if "a above" in text or "a below" in text]


def test_behind_a_gear_a_whole_turn_is_another_place(training: Features) -> None:
    geared = np.array([0.0, 360.0, 0.0])
    region = fit_region(training, JOINTS, geared, SIGNALS, np.arange(400) % 5, predict, 1.0)
    readings = np.array([[0.0, 200.0, 500.0], [0.0, -160.0, 500.0], [360.0, 200.0, 500.0]])
    assert weights(region, readings).tolist() == [1.0, 1.0, 0.0]


def test_a_joint_that_never_moved_in_training_fades_when_it_does(training: Features) -> None:
    readings = training.geometry.copy()
    readings[:, 1] = 200.0
    region = fit_region(replace(training, geometry=readings), JOINTS, TURNS, SIGNALS, np.arange(400) % 5, predict, 1.0)
    weight = weights(region, np.array([[0.0, 200.0, 500.0], [0.0, 200.5, 500.0], [0.0, 210.0, 500.0]]))
    np.testing.assert_array_equal(weight, [1.0, 1.0, 0.0])


def test_a_missing_signal_costs_what_it_gave(region: Region) -> None:
    middle = np.tile([0.0, 200.0, 500.0], (2, 1))
    settled, weight = region.confine(seen(middle, np.array([[np.nan, 12.0], [100.0, np.nan]])))
    # The pressure's estimates scatter by 100 / 50 / sqrt(12) mm; all of the gain were 1 mm^2.
    assert weight[0] == pytest.approx(1.0 - 1.0 / 3.0, abs=0.05)
    assert settled.signals[0, 0] == pytest.approx(100.0, abs=10.0)
    assert weight[1] == 1.0
    assert np.isnan(settled.signals[1, 1])  # as in every fifth row of training


def test_beyond_what_a_signal_read_in_training_nothing_is_estimated(region: Region) -> None:
    pressure = np.linspace(100.0, 250.0, 301)
    middle = np.tile([0.0, 200.0, 500.0], (301, 1))
    settled, weight = region.confine(seen(middle, np.column_stack([pressure, np.full(301, 12.0)])))
    estimate = predict(settled)[:, 1]
    assert np.abs(np.diff(estimate)).max() < 0.06
    assert np.abs(np.diff(weight)).max() < 0.06
    assert estimate[pressure < 155.0] == pytest.approx((pressure[pressure < 155.0] - 100.0) / 50.0)
    far = pressure > 185.0
    np.testing.assert_array_equal(weight[far], 0.0)


def test_a_valve_current_that_matters_nothing_is_not_spoken_of(region: Region, training: Features) -> None:
    strange = np.column_stack([np.full(3, 100.0), np.full(3, 1e6)])
    middle = np.tile([0.0, 200.0, 500.0], (3, 1))
    assert list(region.warnings(seen(middle, strange), JOINTS)) == []
    assert list(region.warnings(training, JOINTS)) == []
    assert list(region.warnings(training.select(np.zeros(400, dtype=bool)), JOINTS)) == []


def test_what_is_outside_is_named(region: Region) -> None:
    readings = np.array([[100.0, 200.0, 500.0], [0.0, 90.0, 500.0], [0.0, 200.0, 500.0], [0.0, 200.0, 500.0]])
    signals = np.array([[100.0, 12.0], [100.0, 12.0], [np.nan, 12.0], [1e7, 12.0]])
    shifted, fades = region.warnings(seen(readings, signals), JOINTS)
    assert shifted.startswith("oil_bar: 1 of 4 readings are outside the 5")
    assert "(another site, a shifted sensor, or another unit?)" in shifted
    assert fades.startswith("the residual fades: 4 of 4 rows lie outside the region of its training data (a above 4")
    for reason in (
        "b below 15",
        "deg in 1",
        "oil_bar missing in 1",
        "oil_bar out of range in 1",
        "3 rows (75%) are not corrected at all",
    ):
        assert reason in fades


def test_a_region_survives_being_written_and_read(region: Region, training: Features) -> None:
    again = Region.from_files(region.to_files())
    assert again.fits(3)
    assert not again.fits(4)
    far = training.geometry * 1.7
    np.testing.assert_array_equal(weights(again, far), weights(region, far))


@pytest.mark.parametrize("change", ["nan", "shape", "signals", "margin"])
def test_tables_that_do_not_fit_are_seen(region: Region, change: str) -> None:
    damaged = {
        "nan": replace(region, poses=region.poses * np.nan),
        "shape": replace(region, poses=region.poses[:, :2]),
        "signals": replace(region, signals=("oil_bar",)),
        "margin": replace(region, joints=region.joints * 0.0),
    }[change]
    assert not damaged.fits(3)


@pytest.fixture(scope="module")
def half_trained() -> tuple[CalibratedModel, Observations]:
    """Trained where theta4 is below 25 deg, and rows over all of its range."""
    rig = shipped_rig("swdt82")
    truth = RigTruth(
        rig, 31, effects=parse_effects("boom_droop@boom,joint_compliance@theta4:compliance_rad_per_Nm=3e-8")
    )
    rows = simulated(truth, 450, 31)
    training = rows.select(rows.joints["theta4"] < 25.0)
    model = identify(rig, rig_text("swdt82"), training, effects="none")
    return train_residual(model, training, kind="rbfn"), simulated(truth, 400, 32)


def test_far_outside_the_model_is_the_one_without_a_residual(
    half_trained: tuple[CalibratedModel, Observations],
) -> None:
    model, rows = half_trained
    assert model.residual is not None
    bare = replace(model, residual=None)
    far, within = rows.joints["theta4"] > 48.0, rows.joints["theta4"] < 25.0
    with_, without = Predictor.of(model).predict(rows), Predictor.of(bare).predict(rows)
    np.testing.assert_allclose(with_.position_mm[far], without.position_mm[far], atol=1e-9)
    np.testing.assert_allclose(with_.formal_mm[far], without.formal_mm[far], atol=1e-9)
    # Intervals that were counted where the residual is used say nothing of where it is not.
    assert model.intervals.hybrid.radius < model.intervals.effects.radius
    np.testing.assert_allclose(with_.half_mm[far], without.half_mm[far], rtol=1e-9)
    np.testing.assert_allclose(with_.radius_mm[far], without.radius_mm[far], rtol=1e-9)
    assert np.linalg.norm(with_.position_mm - without.position_mm, axis=1)[within].mean() > 0.5
    errors = evaluate(model, rows.select(within)).errors_mm
    assert rms(errors["hybrid"]) < 0.95 * rms(errors["effects"])


def test_the_model_says_where_its_residual_fades(half_trained: tuple[CalibratedModel, Observations]) -> None:
    model, rows = half_trained
    (said,) = (warning for warning in model_warnings(model, rows) if warning.startswith("the residual fades"))
    assert "theta4 above 2" in said
    assert not any("residual fades" in d for d in model_warnings(model, rows.select(rows.joints["theta4"] < 20.0)))
    again = model_from_files(model_to_files(model))
    assert model_warnings(again, rows) == model_warnings(model, rows)
    np.testing.assert_array_equal(
        Predictor.of(again).predict(rows).position_mm, Predictor.of(model).predict(rows).position_mm
    )
