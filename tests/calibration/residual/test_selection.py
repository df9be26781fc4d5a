"""Residual learners: kept only where they help, never fooled by rows that know of each other."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from calibration.observations import Floats
from calibration.pipeline.calibrate import train_residual
from calibration.residual.cross_validation import CrossValidation, Data
from calibration.residual.features import Features, usable_signals
from calibration.residual.folds import folds, group_labels
from calibration.residual.learners import LOADERS
from calibration.residual.selection import Kind, Selection, select_residual
from tests.calibration.conftest import Session, features, rms, simulated


def made_up(n: int, seed: int = 0) -> tuple[Features, np.ndarray]:
    rng = np.random.default_rng(seed)
    geometry = rng.uniform(-1.0, 1.0, (n, 3))
    constant = np.full((n, 1), 7.0)
    cells = np.array([f"{a:.0f},{b:.0f}" for a, b in np.round(geometry[:, :2] * 5)])
    names = ("a_deg", "b_deg", "c_deg", "k_mm")
    none = np.empty((n, 3, 0))
    return Features(names, np.hstack([geometry, constant]), np.empty((n, 0)), none, none), cells


def curve(table: Floats) -> Floats:
    return np.column_stack([np.sin(3 * table[:, 0]), table[:, 1] ** 2 - 0.3, 0.5 * np.cos(4 * table[:, 2])])


def choose(kind: Kind, noise: float, signal: float, n: int = 400, seed: int = 0, workers: int = 2) -> Selection:
    seen, cells = made_up(n, seed)
    target = signal * curve(seen.geometry) + np.random.default_rng(seed + 1).normal(0, noise, (n, 3))
    return select(seen, target, cells, cells, kind, seed, workers)


def select(
    seen: Features,
    target: Floats,
    groups: np.ndarray,
    standstills: np.ndarray,
    kind: Kind = "default",
    seed: int = 0,
    workers: int = 2,
) -> Selection:
    with ThreadPoolExecutor(workers) as pool:
        return select_residual(
            seen, target, groups, standstills, kind=kind, seed=seed, executor=pool, progress=lambda share: None
        )


def test_rows_of_a_group_and_of_a_standstill_are_never_on_both_sides(session: Session) -> None:
    observations = simulated(session.truth, 200, 5, repeats=4)
    labels = group_labels(observations)
    split = folds(labels, 5, 0)
    for kind in (labels, observations.pose):
        for label in np.unique(kind):
            assert len(np.unique(split[kind == label])) == 1
    assert np.bincount(split).min() > 20


@pytest.mark.long
@pytest.mark.parametrize("kind", ["rbfn", "lightgbm", "chain", "gp"])
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
    assert 0.5 * trial.after_mm**2 <= decision.variance_mm2.sum() <= 1.05 * trial.after_mm**2


@pytest.mark.long
def test_the_default_is_the_best_of_all_on_held_out_groups() -> None:
    decision = choose("default", noise=0.1, signal=1.0)
    assert decision.residual is not None
    best = min(decision.trials, key=lambda t: t.after_mm)
    assert decision.residual.kind == best.kind
    assert {t.kind for t in decision.trials} >= {"gp", "rbfn", "lightgbm"}


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_learned_from_noise(seed: int) -> None:
    decision = choose("default", noise=1.0, signal=0.0, n=250, seed=seed)
    assert decision.residual is None
    assert decision.reason == "in cross-validation of the training data no learner lowers the error beyond chance"


def test_one_learner_that_does_not_help_is_left_out_by_its_name() -> None:
    decision = choose("gp", noise=1.0, signal=0.0, n=250)
    assert decision.residual is None
    assert decision.reason.startswith("gp was requested and is left out: in cross-validation of the training data")
    assert "no gain beyond chance" in decision.reason


def test_too_few_groups_are_a_reason_to_learn_nothing() -> None:
    seen, _ = made_up(60)
    one = np.full(60, "s")
    decision = select(seen, seen.geometry[:, :3], one, one)
    assert decision.residual is None
    assert decision.reason == "60 fixes in 1 groups are too few to learn a residual from"


@pytest.mark.long
@pytest.mark.parametrize("kind", ["rbfn", "lightgbm", "chain", "gp"])
def test_a_learner_survives_being_written_and_read(kind: Kind) -> None:
    residual = choose(kind, noise=0.1, signal=1.0, n=200).residual
    assert residual is not None
    again = LOADERS[kind](residual.to_files())
    unseen, _ = made_up(50, 3)
    np.testing.assert_array_equal(again.predict(unseen), residual.predict(unseen))
    assert again.fits(unseen)
    assert not again.fits(replace(unseen, names=("other", *unseen.names[1:])))


@pytest.mark.long
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
    decision = select(seen, curve(seen.geometry), session, cells)
    assert decision.residual is not None


def test_prisms_of_a_few_standstills_are_no_more_draws_than_the_standstills(session: Session) -> None:
    rows = np.arange(64)
    few = replace(
        session.training.select(rows),
        session=np.where(rows < 32, "first", "second"),
        pose=np.array([str(row // 8) for row in rows]),
    )
    model = train_residual(session.model, few, kind="rbfn")
    assert model.residual is None
    assert model.residual_reason.endswith("fixes in 2 groups are too few to learn a residual from")


@pytest.mark.parametrize("groups", [2, 3])
def test_what_all_rows_gain_is_told_from_the_rows_that_the_folds_really_had(groups: int) -> None:
    """Squared error against one over the number of rows is a straight line: 1, 3/2 and 2 of three, 2 of two folds."""
    seen, cells = made_up(120)
    target = curve(seen.geometry) + np.random.default_rng(1).normal(0.0, 0.5, (120, 3))
    label = np.array([f"g{row % groups}" for row in range(120)])
    with ThreadPoolExecutor(2) as pool:
        found = select_residual(
            seen, target, label, cells, kind="gp", seed=0, executor=pool, progress=lambda share: None
        )
        units = np.char.add(np.char.add(label, "|"), cells)
        half = CrossValidation(Data(seen, target, label, units), 2, 0, pool).estimate("gp")[0]
    most = (found.left_mm**2).sum()
    expected = 2.0 * most - ((target - half) ** 2).sum() if groups == 3 else most
    assert 0.5 * most < expected < 1.02 * most
    assert 120 * found.variance_mm2.sum() == pytest.approx(expected)


@pytest.mark.parametrize("kind", ["gp", "rbfn"])
def test_what_folds_of_many_rows_share_flatters_no_learner(kind: str) -> None:
    """The error on folds is that on rows which no learner has seen, though terms and shape are found once."""
    rng = np.random.default_rng(3)
    seen, cells = made_up(3000)
    target = curve(seen.geometry) + rng.normal(0.0, 0.5, (3000, 3))
    rows = np.arange(3000) < 1500
    with ThreadPoolExecutor(2) as pool:
        data = Data(seen.select(rows), target[rows], cells[rows], cells[rows])
        left = target[rows] - CrossValidation(data, 5, 0, pool).estimate(kind)[0]
        found = select_residual(
            data.features,
            data.target_mm,
            data.groups,
            data.groups,
            kind=kind,  # type: ignore[arg-type]
            seed=0,
            executor=pool,
            progress=lambda share: None,
        )
    assert found.residual is not None
    unseen = target[~rows] - found.residual.predict(seen.select(~rows))
    assert (left**2).mean() > 0.97 * (unseen**2).mean()


@pytest.mark.long
def test_a_chain_that_cannot_win_is_not_trained() -> None:
    decision = choose("default", noise=0.01, signal=5.0)
    assert [t.kind for t in decision.trials] == ["gp", "rbfn", "lightgbm"]
    best = min(t.after_mm for t in decision.trials)
    assert next(t.after_mm for t in decision.trials if t.kind == "lightgbm") > 1.5 * best


def test_time_and_constant_columns_are_no_features(session: Session) -> None:
    signals = usable_signals(session.training)
    assert "theta1_dir" in signals
    assert "time_s" not in signals
    assert "theta1_rate" not in signals  # zero throughout
    seen = features(session.model.chain, session.model.values, session.training, signals)
    assert seen.table().shape == (250, len(seen.names))
    assert seen.geometry.shape[1] == 9 + 27 + 3


@pytest.mark.long
def test_one_group_that_holds_most_rows_is_no_obstacle() -> None:
    """As in single-joint sweeps: a prism that stands still while others move ties all of a sweep together."""
    seen, _ = made_up(400)
    target = curve(seen.geometry) + np.random.default_rng(1).normal(0, 0.05, (400, 3))
    groups = np.array([f"{max(row - 280, 0) // 8}" for row in range(400)])  # 288 rows, then fourteen groups of 8
    with ThreadPoolExecutor(2) as pool:
        for kind in ("rbfn", "chain"):
            found = select_residual(
                seen, target, groups, groups, kind=kind, seed=0, executor=pool, progress=lambda share: None
            )
            assert found.residual is not None
