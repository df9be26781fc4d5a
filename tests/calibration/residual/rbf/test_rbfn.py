"""The default network: a width per input, all of it chosen on rows held out, zero far from everything it saw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.observations import Floats
from calibration.residual.features import Features
from calibration.residual.rbf.rbfn import Hyperparameters, Rbfn, Shape, choose_hyperparameters, choose_shape, fit_shape
from calibration.residual.rbf.relevance import relevance, spread_rows
from tests.calibration.conftest import rms


def drawn(n: int, seed: int, columns: int = 6) -> Floats:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (n, columns))


def curve(x: Floats) -> Floats:
    """Quick along the first input, slow along the second, deaf to all others."""
    return np.column_stack([np.sin(6.0 * x[:, 0]), x[:, 1] ** 2 - 0.3, np.cos(5.0 * x[:, 0]) * x[:, 1]])


def as_features(x: Floats, signals: Floats | None = None) -> Features:
    signals = np.empty((len(x), 0)) if signals is None else signals
    names = (*(f"q{i + 1}_deg" for i in range(x.shape[1])), *(f"s{i + 1}_bar" for i in range(signals.shape[1])))
    return Features(names, x, signals, np.empty((len(x), 3, 0)), np.empty((len(x), 3, 0)))


def fitted(x: Floats, y: Floats, hyperparameters: Hyperparameters | None = None) -> Rbfn:
    given = hyperparameters or choose_hyperparameters(x, y)[0]
    return fit_shape(as_features(x), y, Shape(as_features(x).names, given), 0)


def test_widths_tell_what_the_outputs_depend_on() -> None:
    x = drawn(250, 0)
    noisy = curve(x) + np.random.default_rng(1).normal(0, 0.1, (250, 3))
    found = relevance((x - x.mean(axis=0)) / x.std(axis=0), noisy)
    assert found.widths[0] < found.widths[1] < 0.3 * found.widths[2:].min()
    assert 0.001 < found.noise / found.signal < 0.1


def test_widths_do_not_depend_on_the_unit_of_the_outputs() -> None:
    x = drawn(120, 2, 3)
    y = curve(x) + np.random.default_rng(3).normal(0, 0.1, (120, 3))
    once, thousandfold = relevance(x / x.std(axis=0), y), relevance(x / x.std(axis=0), 1000.0 * y)
    np.testing.assert_allclose(thousandfold.widths, once.widths, rtol=0.05)
    assert thousandfold.noise == pytest.approx(once.noise, rel=0.1)


def test_a_constant_input_is_left_out_and_zeros_are_learned_as_zeros() -> None:
    x = drawn(100, 4)
    x[:, 3] = 7.0
    network = fitted(x, curve(x))
    elsewhere = x.copy()
    elsewhere[:, 3] = -50.0
    np.testing.assert_array_equal(network.predict(as_features(elsewhere)), network.predict(as_features(x)))
    assert np.abs(fitted(x, np.zeros((100, 3))).predict(as_features(x))).max() == 0.0


def test_inputs_that_say_nothing_cost_little() -> None:
    def held_out(columns: int) -> float:
        x, unseen = drawn(400, 5, columns), drawn(500, 6, columns)
        noisy = curve(x) + np.random.default_rng(7).normal(0, 0.1, (400, 3))
        return rms(curve(unseen) - fitted(x, noisy).predict(as_features(unseen)))

    assert held_out(2) < 0.06
    assert held_out(30) < 0.1  # the noise of each output of one row


def test_the_network_fades_to_zero_far_from_everything_it_saw() -> None:
    x = drawn(200, 8)
    network = fitted(x, curve(x))
    assert np.abs(network.predict(as_features(x + 1000.0))).max() == 0.0


def test_hyperparameters_do_not_memorise_groups() -> None:
    """Rows of a group repeat each other's noise; a network that follows it looks good only where groups are split."""
    rng = np.random.default_rng(9)
    x = np.repeat(drawn(60, 10, 2), 6, axis=0) + rng.normal(0, 1e-3, (360, 2))
    groups = np.repeat(np.arange(60), 6).astype(np.str_)
    noise = np.repeat(rng.normal(0, 1.0, (60, 3)), 6, axis=0)
    _, by_rows = choose_hyperparameters(x, noise)
    _, by_groups = choose_hyperparameters(x, noise, groups)
    variance = float((noise**2).sum(axis=1).mean())
    assert by_rows < 0.1 * variance
    assert by_groups > 0.9 * variance


def test_one_group_is_no_ground_for_hyperparameters() -> None:
    x = drawn(50, 11)
    with pytest.raises(ValueError, match="one group"):
        choose_hyperparameters(x, curve(x), np.full(50, "a"))
    assert fitted(x, curve(x), Hyperparameters((1.0,) * 6, 20, 0.1)).units.shape == (20, 6)


def test_few_rows_are_drawn_from_all_groups() -> None:
    groups = np.array(["large"] * 90 + ["small"] * 10)
    rows = spread_rows(groups, 20, 0)
    assert len(np.unique(rows)) == 20
    assert (groups[rows] == "small").sum() == 10
    np.testing.assert_array_equal(np.sort(spread_rows(groups, 1000, 0)), np.arange(100))


def test_a_signal_is_an_input_where_the_residual_depends_on_it() -> None:
    x, signals = drawn(250, 12), drawn(250, 13, 4)
    groups = np.arange(250).astype(np.str_)
    noise = np.random.default_rng(14).normal(0, 0.1, (250, 3))
    without = choose_shape(as_features(x, signals), curve(x) + noise, groups, 0)
    assert without.names == ("q1_deg", "q2_deg", "q3_deg", "q4_deg", "q5_deg", "q6_deg")
    leaning = curve(x) + np.sin(4.0 * signals[:, [2]]) + noise
    shape = choose_shape(as_features(x, signals), leaning, groups, 0)
    assert shape.names[6:] == ("s1_bar", "s2_bar", "s3_bar", "s4_bar")
    network = fit_shape(as_features(x, signals), leaning, shape, 0)
    signals[::2, 2] = np.nan  # not measured: the mean, and never no estimate
    assert np.isfinite(network.predict(as_features(x, signals))).all()


def test_frames_are_no_inputs_and_the_files_hold_all() -> None:
    x = drawn(120, 15)
    seen = as_features(x, np.empty((120, 0)))
    seen = Features((*seen.names[:5], "frame1_x_mm"), x, seen.signals, seen.joint_jacobian, seen.parameter_jacobian)
    network = fit_shape(seen, curve(x), choose_shape(seen, curve(x), np.arange(120).astype(np.str_), 0), 0)
    assert network.names == seen.names[:5]
    again = Rbfn.from_files(network.to_files())
    np.testing.assert_array_equal(again.predict(seen), network.predict(seen))
    assert again.fits(seen)
    assert not again.fits(replace(seen, names=("other", *seen.names[1:])))


def test_rows_in_blocks_are_predicted_as_rows_alone() -> None:
    x = drawn(600, 16)
    network = fitted(x, curve(x), Hyperparameters((0.5,) * 6, 50, 0.01))
    alone = np.concatenate([network.predict(as_features(row[None])) for row in x[250:270]])
    np.testing.assert_allclose(network.predict(as_features(x))[250:270], alone, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("part", ["scale", "units", "output"])
def test_files_that_do_not_fit_are_refused(part: str) -> None:
    import io

    x = drawn(60, 17)
    files = fitted(x, curve(x), Hyperparameters((0.5,) * 6, 9, 0.01)).to_files()
    with np.load(io.BytesIO(files["rbfn.npz"])) as stored:
        parts = dict(stored)
    for damaged in (parts[part][:-1], np.full_like(parts[part], np.nan)):
        buffer = io.BytesIO()
        np.savez(buffer, **(parts | {part: damaged}))
        with pytest.raises(ValueError, match="network"):
            Rbfn.from_files({"rbfn.npz": buffer.getvalue()})
