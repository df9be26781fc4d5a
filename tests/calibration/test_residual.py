"""Residual learners: kept only where they help, never fooled by rows that know of each other."""

from __future__ import annotations

import builtins
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.observations import Floats
from calibration.pipeline import train_residual
from calibration.residual import boosting
from calibration.residual.boosting import Boosting, fit_boosting
from calibration.residual.features import Features, features, usable_signals
from calibration.residual.folds import folds, group_labels
from calibration.residual.hybrid import LOADERS, Decision, Kind, decide
from calibration.residual.rbfn import Shape, choose_shape, fit_shape
from tests.calibration.conftest import Session, rms, simulated


def made_up(n: int, seed: int = 0) -> tuple[Features, np.ndarray]:
    rng = np.random.default_rng(seed)
    geometry = rng.uniform(-1.0, 1.0, (n, 3))
    constant = np.full((n, 1), 7.0)
    cells = np.array([f"{a:.0f},{b:.0f}" for a, b in np.round(geometry[:, :2] * 5)])
    return Features(("a_deg", "b_deg", "c_deg", "k_mm"), np.hstack([geometry, constant]), np.empty((n, 0))), cells


def curve(table: Floats) -> Floats:
    return np.column_stack([np.sin(3 * table[:, 0]), table[:, 1] ** 2 - 0.3, 0.5 * np.cos(4 * table[:, 2])])


def choose(kind: Kind, noise: float, signal: float, n: int = 400, seed: int = 0, workers: int = 2) -> Decision:
    seen, cells = made_up(n, seed)
    target = signal * curve(seen.geometry) + np.random.default_rng(seed + 1).normal(0, noise, (n, 3))
    with ThreadPoolExecutor(workers) as pool:
        return decide(seen, target, cells, cells, kind=kind, seed=seed, executor=pool, progress=lambda share: None)


def test_rows_of_a_group_and_of_a_standstill_are_never_on_both_sides(session: Session) -> None:
    observations = simulated(session.truth, 200, 5, repeats=4)
    labels = group_labels(observations)
    split = folds(labels, 5, 0)
    for kind in (labels, observations.pose):
        for label in np.unique(kind):
            assert len(np.unique(split[kind == label])) == 1
    assert np.bincount(split).min() > 20


@pytest.mark.parametrize("kind", ["rbfn", "lightgbm", "chain"])
def test_a_learner_that_helps_is_kept_and_predicts_rows_it_never_saw(kind: Kind) -> None:
    decision = choose(kind, noise=0.1, signal=1.0)
    assert decision.residual is not None
    assert decision.residual.kind == kind
    (trial,) = decision.trials
    assert trial.after_mm < 0.5 * trial.before_mm
    unseen, _ = made_up(300, 99)
    left = curve(unseen.geometry) - decision.residual.predict(unseen)
    assert rms(left) < 0.5 * trial.before_mm
    noisy = left + np.random.default_rng(5).normal(0, 0.1, left.shape)
    assert 0.7 < (noisy**2).sum() / (300 * decision.variance_mm2.sum()) < 1.3
    assert 0.5 * trial.after_mm**2 <= decision.variance_mm2.sum() <= trial.after_mm**2


def test_the_default_is_the_best_of_all_on_held_out_groups() -> None:
    decision = choose("default", noise=0.1, signal=1.0)
    assert decision.residual is not None
    best = min(decision.trials, key=lambda t: t.after_mm)
    assert decision.residual.kind == best.kind
    assert {t.kind for t in decision.trials} == {"rbfn", "lightgbm", "chain"}


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_learned_from_noise(seed: int) -> None:
    decision = choose("default", noise=1.0, signal=0.0, n=250, seed=seed)
    assert decision.residual is None
    assert decision.reason == "in cross-validation of the training data no learner lowers the error beyond chance"


def test_too_few_groups_are_a_reason_to_learn_nothing() -> None:
    seen, _ = made_up(60)
    one = np.full(60, "s")
    with ThreadPoolExecutor(1) as pool:
        decision = decide(
            seen, seen.geometry[:, :3], one, one, kind="default", seed=0, executor=pool, progress=lambda share: None
        )
    assert decision.residual is None
    assert decision.reason == "60 fixes in 1 groups are too few to learn a residual from"


@pytest.mark.parametrize("kind", ["rbfn", "lightgbm", "chain"])
def test_a_learner_survives_being_written_and_read(kind: Kind) -> None:
    residual = choose(kind, noise=0.1, signal=1.0, n=200).residual
    assert residual is not None
    again = LOADERS[kind](residual.to_files())
    unseen, _ = made_up(50, 3)
    np.testing.assert_array_equal(again.predict(unseen), residual.predict(unseen))
    assert again.fits(unseen.names, 4)
    assert not again.fits((*unseen.names, "extra"), 5)


def test_the_network_fades_to_zero_far_from_everything_it_saw() -> None:
    seen, _ = made_up(200)
    network = fit_shape(seen, curve(seen.geometry), Shape(30, 0.7, 0.1), 0)
    far = Features(seen.names, seen.geometry + 1000.0, seen.signals)
    assert np.abs(network.predict(far)).max() == 0.0


def test_one_decomposition_gives_the_ridge_that_solving_gives() -> None:
    seen, cells = made_up(200)
    target = curve(seen.geometry) + np.random.default_rng(3).normal(0, 0.1, (200, 3))
    chosen = choose_shape(seen, target, cells, 0)
    error = {}
    for ridge in (1e-3, 1e-2, 1e-1, 1.0, 10.0):
        split = folds(cells, 3, 0)
        squares = 0.0
        for fold in range(3):
            held = split == fold
            network = fit_shape(seen.select(~held), target[~held], replace(chosen, ridge=ridge), 0)
            squares += ((target[held] - network.predict(seen.select(held))) ** 2).sum()
        error[ridge] = squares
    assert chosen.ridge == min(error, key=lambda ridge: error[ridge])


def test_the_decision_does_not_depend_on_the_number_of_workers() -> None:
    one, three = (choose("chain", noise=0.1, signal=1.0, n=150, workers=workers) for workers in (1, 3))
    assert one.residual is not None
    assert three.residual is not None
    assert one.residual.to_files() == three.residual.to_files()
    assert one.trials == three.trials
    np.testing.assert_array_equal(one.variance_mm2, three.variance_mm2)


def test_two_sessions_are_enough_to_compare_learners_between_them() -> None:
    seen, cells = made_up(300)
    session = np.where(np.arange(300) < 150, "first", "second")
    with ThreadPoolExecutor(2) as pool:
        decision = decide(
            seen,
            curve(seen.geometry),
            session,
            cells,
            kind="default",
            seed=0,
            executor=pool,
            progress=lambda share: None,
        )
    assert decision.residual is not None


def test_a_network_that_does_not_help_is_not_chained() -> None:
    seen, cells = made_up(400)
    step = np.sign(np.random.default_rng(4).normal(size=(400, 1)))
    with ThreadPoolExecutor(2) as pool:
        decision = decide(
            seen.with_signals(["a_dir"], step),
            step + np.random.default_rng(5).normal(0, 0.2, (400, 3)),
            cells,
            cells,
            kind="default",
            seed=0,
            executor=pool,
            progress=lambda share: None,
        )
    assert [t.kind for t in decision.trials] == ["rbfn", "lightgbm"]
    assert decision.residual is not None
    assert decision.residual.kind == "lightgbm"


def test_trees_read_a_signal_that_is_not_measured_everywhere() -> None:
    seen, _ = made_up(300)
    signal = np.where(np.arange(300) % 7 == 0, np.nan, np.sign(seen.geometry[:, 2]))[:, None]
    target = np.nan_to_num(signal) * np.ones(3)
    with ThreadPoolExecutor(1) as pool:
        grown = fit_boosting(seen.with_signals(["theta1_dir"], signal), target, (20, 20, 20), 0, pool)
    assert np.isfinite(grown.predict(seen.with_signals(["theta1_dir"], np.full((300, 1), np.nan)))).all()


def test_trees_leave_the_origins_of_frames_to_the_network(session: Session) -> None:
    seen = features(session.model.chain, session.model.values, session.training, ["theta1_dir"])
    with ThreadPoolExecutor(1) as pool:
        grown = fit_boosting(seen, session.training.position_mm, (3, 3, 3), 0, pool)
    assert grown.names == (*(j.column for j in session.rig.joints), *(f"prism_{a}_mm" for a in "xyz"), "theta1_dir")


def test_time_and_constant_columns_are_no_features(session: Session) -> None:
    signals = usable_signals(session.training)
    assert "theta1_dir" in signals
    assert "time_s" not in signals
    assert "theta1_rate" not in signals  # zero throughout
    seen = features(session.model.chain, session.model.values, session.training, signals)
    assert seen.table().shape == (250, len(seen.names))
    assert seen.geometry.shape[1] == 9 + 27 + 3


def test_a_damaged_tree_text_that_lightgbm_refuses_is_a_value_error() -> None:
    files = choose("lightgbm", noise=0.1, signal=1.0, n=200).residual.to_files()  # type: ignore[union-attr]  # kept
    with pytest.raises(ValueError, match="LightGBM refuses"):
        Boosting.from_files(files | {"lightgbm_x.txt": b"not a tree"})


def test_a_missing_libgomp_ends_in_the_command_that_installs_it(
    monkeypatch: pytest.MonkeyPatch, session: Session
) -> None:
    original: Callable[..., object] = builtins.__import__

    def without_libgomp(name: str, *rest: object, **more: object) -> object:
        if name == "lightgbm":
            raise OSError("libgomp.so.1: cannot open shared object file: No such file or directory")
        return original(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without_libgomp)
    with pytest.raises(CalibrationError, match="apt-get install libgomp1"):
        boosting.import_lightgbm()
    with pytest.raises(CalibrationError, match="libgomp1"):
        train_residual(session.model, session.training, kind="lightgbm")


def test_one_group_that_holds_most_rows_is_no_obstacle() -> None:
    """As in single-joint sweeps: a prism that stands still while others move ties all of a sweep together."""
    seen, _ = made_up(400)
    target = curve(seen.geometry) + np.random.default_rng(1).normal(0, 0.05, (400, 3))
    groups = np.array([f"{max(row - 280, 0) // 8}" for row in range(400)])  # 288 rows, then fourteen groups of 8
    with ThreadPoolExecutor(2) as pool:
        for kind in ("rbfn", "chain"):
            found = decide(seen, target, groups, groups, kind=kind, seed=0, executor=pool, progress=lambda share: None)
            assert found.residual is not None
