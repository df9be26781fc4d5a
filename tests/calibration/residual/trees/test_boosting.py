"""LightGBM: tuned on held-out groups within a budget that is counted, stored as its own text, read without it."""

from __future__ import annotations

import builtins
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.observations import Floats
from calibration.pipeline.calibrate import train_residual
from calibration.residual.features import Features
from calibration.residual.folds import folds
from calibration.residual.learners import tree_importance
from calibration.residual.trees import boosting
from calibration.residual.trees.boosting import Boosting, BoostingSettings, Tuned, cross_validate, fit_boosting
from tests.calibration.conftest import Session, features, rms

NAMES = ("a_deg", "b_deg", "c_deg", "frame1_x_mm")


def seen(n: int, seed: int) -> Features:
    rng = np.random.default_rng(seed)
    geometry, none = rng.uniform(-1.0, 1.0, (n, 4)), np.empty((n, 3, 0))
    return Features((*NAMES, "a_dir"), geometry, np.sign(rng.normal(size=(n, 1))), none, none)


def truth(rows: Features) -> Floats:
    a, b, c, _ = rows.geometry.T
    return np.column_stack([np.sin(3.0 * a), rows.signals[:, 0] * b, 0.5 * np.cos(4.0 * c)])


def validated(rows: Features, target: Floats, workers: int = 2, **more: object) -> tuple[Floats, Tuned]:
    cells = np.array([f"{a:.0f},{b:.0f}" for a, b in np.round(rows.geometry[:, :2] * 5)])
    split = folds(cells, 5, 0)
    parts = [(rows.select(split != fold), rows.select(split == fold)) for fold in range(5)]
    with ThreadPoolExecutor(workers) as pool:
        return cross_validate(parts, target, split, 0, pool, **more)  # type: ignore[arg-type]  # the tests' own


def fitted(rows: Features, target: Floats, tuned: Tuned) -> Boosting:
    with ThreadPoolExecutor(2) as pool:
        return fit_boosting(rows, target, tuned, 0, pool)


def few(rounds: int, names: tuple[str, ...] = (*NAMES[:3], "a_dir")) -> Tuned:
    return Tuned(names, BoostingSettings(rate=0.1), (rounds,) * 3)


def test_out_of_fold_errors_are_those_of_rows_that_nothing_was_trained_on() -> None:
    rows, unseen = seen(500, 0), seen(2000, 1)
    noise = np.random.default_rng(2).normal(0.0, 0.2, (500, 3))
    target = truth(rows) + noise
    estimate, tuned = validated(rows, target)
    trees = fitted(rows, target, tuned)
    left, elsewhere = rms(truth(rows) - estimate), rms(truth(unseen) - trees.predict(unseen))
    assert left < 0.45 * rms(truth(rows))
    assert 0.6 * left < elsewhere < 1.1 * left  # with a quarter more rows, and no cell left out
    assert rms(target - trees.predict(rows)) < 0.9 * rms(target - estimate)  # which rows it was trained on flatter


@pytest.mark.long
def test_out_of_fold_errors_are_not_flattered_by_the_choice_of_rounds() -> None:
    """Whatever trees say of pure noise, rows that had no part in them show a larger error than saying nothing."""
    shares = []
    for seed in range(40):
        rows, target = seen(40, seed), np.random.default_rng(1000 + seed).normal(size=(40, 3))
        estimate, _ = validated(rows, target, settings=BoostingSettings())
        shares.append(rms(target - estimate) / rms(target))
    assert np.mean(shares) > 1.003  # 0.997 where a fold's own rows choose


@pytest.mark.long
def test_neither_the_number_of_workers_nor_a_second_run_changes_a_tree() -> None:
    rows = seen(200, 3)
    one, two = (validated(rows, truth(rows), workers) for workers in (1, 3))
    np.testing.assert_array_equal(one[0], two[0])
    assert one[1] == two[1]
    assert fitted(rows, truth(rows), one[1]) == fitted(rows, truth(rows), two[1])


def test_settings_are_kept_where_they_are_given() -> None:
    rows, settings = seen(150, 4), BoostingSettings(rate=0.1, leaves=4)
    _, tuned = validated(rows, truth(rows), settings=settings)
    assert tuned.settings == settings


def test_sums_get_small_trees_and_products_large_ones() -> None:
    def leaves(n: int, component: Callable[[Features], Floats], noise: float) -> int:
        rows = seen(n, 5)
        target = component(rows)[:, None] + np.random.default_rng(5).normal(0.0, noise, (n, 3))
        return validated(rows, target)[1].settings.leaves

    assert leaves(600, lambda rows: rows.geometry[:, :3].sum(axis=1), 1.0) < BoostingSettings().leaves
    assert leaves(300, lambda rows: np.sign(rows.geometry[:, :3].prod(axis=1) * rows.signals[:, 0]), 0.05) > 15


def test_the_work_is_counted_and_stays_within_its_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of the budget: fewer settings are compared, and the learning rate is higher."""
    rows = seen(300, 7)
    target = truth(rows) + np.random.default_rng(8).normal(0.0, 0.1, (300, 3))
    plenty = validated(rows, target)[1]
    monkeypatch.setattr(boosting, "_budget", lambda values: 0.15)
    scarce = validated(rows, target)[1]
    assert plenty.settings.rate == pytest.approx(0.05)
    assert scarce.settings.rate == pytest.approx(0.1)
    assert scarce.settings.leaves == BoostingSettings().leaves
    assert sum(scarce.rounds) < sum(plenty.rounds)


def test_trees_leave_the_origins_of_frames_out_unless_they_are_named() -> None:
    rows = seen(150, 9)
    assert validated(rows, truth(rows), settings=BoostingSettings())[1].names == (*NAMES[:3], "a_dir")
    tuned = validated(rows, truth(rows), settings=BoostingSettings(), names=rows.names)[1]
    trees = fitted(rows, truth(rows), tuned)
    assert trees.names == rows.names
    assert trees.fits(rows)
    assert not trees.fits(rows.with_signals(["extra"], np.zeros((len(rows), 1))))
    assert fitted(rows, truth(rows), few(3)).fits(rows)


def test_the_rig_s_frames_are_known_by_name(session: Session) -> None:
    rows = features(session.model.chain, session.model.values, session.training, ["theta1_dir"])
    joints = tuple(j.column for j in session.rig.joints)
    assert boosting.tree_columns(rows.names) == (*joints, *(f"prism_{a}_mm" for a in "xyz"), "theta1_dir")


def test_trees_read_a_signal_that_is_not_measured_everywhere() -> None:
    rows = seen(300, 10)
    rows.signals[::7] = np.nan
    trees = fitted(rows, np.nan_to_num(rows.signals) * np.ones(3), few(40))
    estimate = trees.predict(rows)
    np.testing.assert_allclose(estimate[::7], 0.0, atol=0.15)
    np.testing.assert_allclose(estimate[1::7], np.broadcast_to(rows.signals[1::7], (43, 3)), atol=0.15)


def test_a_feature_that_is_missing_is_a_value_error() -> None:
    rows = seen(100, 11)
    trees = fitted(rows, truth(rows), few(3))
    without = Features(NAMES, rows.geometry, np.empty((100, 0)), rows.joint_jacobian, rows.parameter_jacobian)
    with pytest.raises(ValueError, match=r"a_dir|tuple"):
        trees.predict(without)


def test_importance_is_the_share_of_what_splits_gain() -> None:
    import lightgbm

    rows = seen(400, 12)
    target = np.column_stack([3.0 * rows.geometry[:, 1], rows.signals[:, 0], np.zeros(400)])
    trees = fitted(rows, target, few(30))
    shares = {line.feature: line.share for line in trees.importance}
    assert list(shares)[:2] == ["b_deg", "a_dir"]
    assert sum(shares.values()) == pytest.approx(1.0)
    boosters = [lightgbm.Booster(model_str=text.decode()) for text in trees.texts]
    gain = np.sum([b.feature_importance("gain") for b in boosters], axis=0)
    assert [shares[name] for name in trees.names] == pytest.approx(list(gain / gain.sum()), rel=1e-4)
    assert tree_importance(trees) == trees.importance
    assert tree_importance(None) is None


def test_trees_are_read_and_used_without_lightgbm() -> None:
    rows = seen(120, 13)
    trees = fitted(rows, truth(rows), few(8))
    again = Boosting.from_files(trees.to_files())
    assert again == trees
    np.testing.assert_array_equal(again.predict(rows), trees.predict(rows))
    code = (
        "import sys; sys.modules['lightgbm'] = None\n"
        "from calibration.residual.trees.boosting import Boosting\n"
        "import json; print(len(Boosting.from_files({k: v.encode() for k, v in json.load(sys.stdin).items()}).names))"
    )
    import json

    files = json.dumps({name: data.decode() for name, data in trees.to_files().items()})
    done = subprocess.run([sys.executable, "-c", code], input=files, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "4"


@pytest.mark.parametrize("damage", [b"", b"not a tree", b"tree\nversion=v4\n"])
def test_a_damaged_text_is_a_value_error(damage: bytes) -> None:
    rows = seen(100, 14)
    files = fitted(rows, truth(rows), few(2)).to_files()
    with pytest.raises(ValueError, match=r"tree|start"):
        Boosting.from_files(files | {"lightgbm_x.txt": damage})
    with pytest.raises(ValueError, match="number of features of the trees differs"):
        Boosting.from_files(files | {"lightgbm.json": b'{"features": ["a_deg"]}'})


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
