"""Compiled trees: they say what LightGBM says, and no text makes them say anything else or do harm."""

from __future__ import annotations

from typing import Any

import lightgbm
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from calibration.observations import Floats
from calibration.residual.trees.forest import Forest
from calibration.residual.trees.tree_text import read_trees

COLUMNS = 6
VARIANTS: dict[str, dict[str, Any]] = {
    "NaN is missing": {},
    "zero is missing": {"zero_as_missing": True},
    "nothing is missing": {"use_missing": False},
    "stumps": {"min_data_in_leaf": 200},
    "many leaves": {"num_leaves": 200, "min_data_in_leaf": 1, "max_bin": 1500, "min_data_in_bin": 1},
}


def table(n: int, seed: int) -> Floats:
    """Columns with NaN, with zeros, of signs, of whole numbers."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(n, COLUMNS))
    values[rng.random(n) < 0.2, 0] = np.nan
    values[rng.random(n) < 0.3, 1] = 0.0
    values[:, 2] = np.sign(values[:, 2])
    values[:, 3] = np.round(3.0 * values[:, 3])
    return values


def grown(trees: int = 30, seed: int = 0, **more: Any) -> Any:
    rows = table(900, seed)
    label = np.nan_to_num(rows[:, 0]) * rows[:, 2] + np.abs(rows[:, 1]) + np.sin(rows[:, 4])
    label += (rows[:, 1] == 0.0) + 2.0 * np.isnan(rows[:, 0])
    parameters = {"objective": "l2", "verbose": -1, "num_threads": 1, "boost_from_average": False, "seed": seed}
    parameters |= {"learning_rate": 0.1, "num_leaves": 15, "bagging_fraction": 0.8, "bagging_freq": 1} | more
    return lightgbm.train(parameters, lightgbm.Dataset(rows, label=label, params=parameters), trees)


def text_of(booster: Any) -> bytes:
    return str(booster.model_to_string()).encode()


def forest_of(*boosters: Any) -> Forest:
    return Forest.build([read_trees(text_of(booster), COLUMNS) for booster in boosters])


def everything(booster: Any) -> Floats:
    """Rows with random values, missing ones, and values at, just below and just above every threshold."""
    rows = table(2000, 99)
    rows[::7] = np.nan
    rows[1::7, 1] = np.resize([0.0, -0.0, 1e-36, -1e-36, 1e-35, 1.0000001e-35, 2e-35, -2e-35], len(rows[1::7]))
    rows[2::7, 5] = np.resize([np.inf, -np.inf, 1e300, -1e300], len(rows[2::7]))
    thresholds = [(int(f), t) for tree in read_trees(text_of(booster), COLUMNS) for f, t in zip(tree.feature, tree.threshold, strict=True)]  # fmt: skip  # noqa: E501
    at = table(3 * len(thresholds), 5)
    for k, (feature, threshold) in enumerate(thresholds):
        for side, value in enumerate((threshold, np.nextafter(threshold, -np.inf), np.nextafter(threshold, np.inf))):
            at[3 * k + side, feature] = value
    return np.vstack([rows, at])


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_forest_predicts_what_lightgbm_predicts(variant: str) -> None:
    booster = grown(**VARIANTS[variant])
    rows = everything(booster)
    expected = booster.predict(rows)
    forest = forest_of(booster)
    assert np.ptp(expected) > 0.0 or variant == "stumps"
    np.testing.assert_allclose(forest.predict(rows, np.arange(COLUMNS))[:, 0], expected, rtol=0.0, atol=1e-12)


def test_one_row_gets_what_it_gets_among_many() -> None:
    booster = grown(trees=40)
    rows, columns, forest = table(700, 3), np.arange(COLUMNS), forest_of(booster)
    together = forest.predict(rows, columns)
    alone = np.vstack([forest.predict(rows[k : k + 1], columns) for k in range(0, 700, 9)])
    np.testing.assert_array_equal(alone, together[::9])
    np.testing.assert_array_equal(forest.predict(rows[:300], columns), together[:300])
    assert forest.predict(rows[:0], columns).shape == (0, 1)


def test_each_output_is_the_sum_of_its_own_trees() -> None:
    boosters = [grown(trees=trees, seed=seed) for seed, trees in enumerate((5, 30, 12))]
    rows = table(200, 8)
    expected = np.column_stack([booster.predict(rows) for booster in boosters])
    np.testing.assert_allclose(forest_of(*boosters).predict(rows, np.arange(COLUMNS)), expected, rtol=0.0, atol=1e-12)


def test_features_are_found_wherever_they_stand_in_the_table() -> None:
    booster = grown()
    rows, order = table(100, 4), np.array([5, 0, 3, 1, 4, 2])
    wide = np.full((100, 9), 1e9)
    wide[:, 2 + order] = rows
    np.testing.assert_array_equal(
        forest_of(booster).predict(wide, 2 + order), forest_of(booster).predict(rows, np.arange(COLUMNS))
    )


def test_trees_of_another_kind_are_refused_by_name() -> None:
    rows = table(300, 1)
    rows[:, 2] = np.abs(rows[:, 2])
    label = np.sin(rows[:, 4])
    quiet = {"verbose": -1, "num_threads": 1, "num_leaves": 7}

    def refused(message: str, features: int = COLUMNS, **parameters: Any) -> None:
        target = np.abs(label) if parameters.get("objective") == "poisson" else label
        data = lightgbm.Dataset(rows, label=target, params=quiet | parameters, categorical_feature=[2])
        if "categorical" not in message:
            data = lightgbm.Dataset(rows, label=target, params=quiet | parameters)
        with pytest.raises(ValueError, match=message):
            read_trees(text_of(lightgbm.train(quiet | parameters, data, 3)), features)

    refused("objective 'poisson'", objective="poisson")
    refused("random forest", boosting="rf", bagging_freq=1, bagging_fraction=0.5)
    refused("linear leaves", linear_tree=True)
    refused("number of features of the trees differs", features=COLUMNS + 1)
    refused("300 leaves|2[5-9][0-9] leaves", num_leaves=300, min_data_in_leaf=1, min_data_in_bin=1, objective="l2")


TEXT = text_of(grown(trees=2, num_leaves=5))
LINES = TEXT.decode().splitlines()[: TEXT.decode().splitlines().index("end of trees") + 1]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("left_child", "0 -1 -2 -3"),  # a circle
        ("left_child", "1 -1 -2"),
        ("right_child", "-9 -8 -7 -6"),
        ("split_feature", "0 1 2 6"),
        ("split_feature", "0 1 2 -1"),
        ("decision_type", "1 2 2 2"),
        ("decision_type", "12 2 2 2"),
        ("threshold", "nan 0 0 0"),
        ("leaf_value", "1 2 3 4 1e999"),
        ("leaf_value", "1 2 3 4 " + "9" * 5000),
        ("num_leaves", "1000000000000"),
        ("num_leaves", "0"),
        ("num_leaves", "six"),
        ("num_cat", "1"),
        ("tree_sizes", "1"),
        ("version", "v9"),
    ],
)
def test_an_edited_text_is_refused(name: str, value: str) -> None:
    edited = [f"{name}={value}" if line.startswith(f"{name}=") else line for line in LINES]
    assert edited != LINES
    with pytest.raises(ValueError, match="tree"):
        read_trees("\n".join(edited).encode(), COLUMNS)


def test_a_text_that_ends_anywhere_before_its_end_is_refused() -> None:
    whole = "\n".join(LINES).encode()
    assert len(read_trees(whole, COLUMNS)) == 2
    for length in range(0, len(whole), 11):
        with pytest.raises(ValueError, match=r"tree|start"):
            read_trees(whole[:length], COLUMNS)


@pytest.mark.long
@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_a_hostile_text_is_refused_or_gives_finite_sums(data: st.DataObject) -> None:
    lines = list(LINES)
    for _ in range(data.draw(st.integers(1, 4))):
        where = data.draw(st.integers(0, len(lines) - 1))
        how = data.draw(st.sampled_from(["drop", "repeat", "words", "noise"]))
        if how == "drop":
            del lines[where]
        elif how == "repeat":
            lines.insert(where, lines[data.draw(st.integers(0, len(lines) - 1))])
        elif how == "words":
            name, _, words = lines[where].partition("=")
            numbers = st.sampled_from(
                ["0", "1", "2", "3", "4", "-1", "-2", "-3", "-5", "1e300", "inf", "nan", "-6", ""]
            )
            lines[where] = f"{name}=" + " ".join(data.draw(numbers) for _ in words.split())
        else:
            lines[where] = data.draw(st.text(max_size=30))
        if not lines:
            break
    try:
        trees = read_trees("\n".join(lines).encode(), COLUMNS)
    except ValueError:
        return
    assert np.isfinite(Forest.build([trees]).predict(table(20, 0), np.arange(COLUMNS))).all()


@settings(max_examples=100, deadline=None)
@given(noise=st.binary(max_size=200), where=st.integers(0, len(TEXT)))
def test_noise_in_a_text_never_does_more_than_raise_a_value_error(noise: bytes, where: int) -> None:
    try:
        trees = read_trees(TEXT[:where] + noise + TEXT[where + len(noise) :], COLUMNS)
    except ValueError:
        return
    assert Forest.build([trees]).predict(table(20, 0), np.arange(COLUMNS)).shape == (20, 1)
