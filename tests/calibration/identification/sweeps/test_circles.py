"""Axes from single-joint sweeps: what they are, how sure, the start they give and what they find wrong in a model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.identification.refinement import Fit, refine
from calibration.identification.samples import Samples, averaged
from calibration.identification.start import rough_start
from calibration.identification.sweeps.axis_start import start_from_axes
from calibration.identification.sweeps.circle_fit import Kind, fit_curve, without_outliers
from calibration.identification.sweeps.circles import Axis, find_axes, predicted_curve
from calibration.identification.sweeps.cross_check import cross_check, disagreements
from calibration.kinematics.chain import Chain, Placement
from calibration.observations import Floats, Observations, parse_observations
from calibration.rig.description import Rig, shipped_rig
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

KINDS: tuple[Kind, ...] = ("revolute", "prismatic")
NOISE_MM = {"swdt82": 3.0, "ys100": 0.03, "ur10": 0.03}


def sweep_poses(rig: Rig, seed: int, places: int = 9) -> dict[str, Floats]:
    """Each joint in turn through its limits (240 deg at most), the others where they stood."""
    rng = np.random.default_rng(seed)
    home = {j.name: float(np.mean(j.limits) + rng.uniform(-0.3, 0.3) * np.ptp(j.limits)) for j in rig.joints}
    poses: dict[str, list[float]] = {name: [] for name in home}
    for joint in rig.joints:
        middle, half = float(np.mean(joint.limits)), 0.5 * float(np.ptp(joint.limits))
        reach = half if joint.kind == "prismatic" else min(half, 120.0)
        for value in np.linspace(middle - reach, middle + reach, places):
            for name, rest in home.items():
                poses[name].append(float(value) if name == joint.name else rest)
    return {name: np.array(values) for name, values in poses.items()}


def sweeps(truth: RigTruth, seed: int, setup: str = "") -> Observations:
    rig, poses = truth.rig, sweep_poses(truth.rig, seed)
    count = len(next(iter(poses.values())))
    data = simulate_observations(truth, count, seed, poses=poses, noise_mm=NOISE_MM[rig.name], setup=setup)
    return parse_observations(data.csv_text().encode(), rig, "sweeps.csv")


def spread_poses(truth: RigTruth, count: int, seed: int) -> Observations:
    data = simulate_observations(truth, count, seed, noise_mm=NOISE_MM[truth.rig.name])
    return parse_observations(data.csv_text().encode(), truth.rig, "poses.csv")


def placed(rig: Rig, observations: Observations) -> tuple[Chain, Samples, Floats]:
    blank = Chain(rig, {s: Placement.identity() for s in sorted(set(observations.setup.tolist()))})
    samples = averaged(blank, observations)
    start = rough_start(blank, samples, np.zeros(len(blank)))
    return Chain(rig, start.placements), samples, start.x


def axes_of(truth: RigTruth, seed: int) -> tuple[Chain, Samples, tuple[Axis, ...]]:
    chain, samples, _ = placed(truth.rig, sweeps(truth, seed))
    return chain, samples, find_axes(chain, samples)


def true_curve(truth: RigTruth, axis: Axis) -> Floats:
    """Features of the circle through the true places of the sweep."""
    names = truth.rig.joint_names
    joints = {name: axis.sweep.readings[:, i] for i, name in enumerate(names)}
    values = joints[axis.joint]
    values = np.radians(values) if truth.rig.joint(axis.joint).kind == "revolute" else values
    return fit_curve(axis.kind, truth.prism_mm(axis.prism, joints), values).features


def identified(truth: RigTruth, seed: int, count: int = 80) -> tuple[Chain, Fit]:
    chain, samples, x = placed(truth.rig, spread_poses(truth, count, seed))
    return chain, refine(chain, samples, x)


# -- circles and lines -----------------------------------------------------------------------------------------------


def arc_places(arc_deg: float, count: int) -> tuple[Floats, Floats]:
    """Places on a circle of 2 m about z through (100, 200, 300), and the readings in rad."""
    angle = np.radians(np.linspace(20.0, 20.0 + arc_deg, count))
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    return np.array([100.0, 200.0, 300.0]) + 2000.0 * circle, angle


def test_a_circle_is_found_exactly_with_its_sense_and_travel() -> None:
    places, angle = arc_places(70.0, 8)
    curve = fit_curve("revolute", places, angle)
    np.testing.assert_allclose(curve.features, [0, 0, 1, 100, 200, 300, 2000, 1], atol=1e-6)
    reverse = fit_curve("revolute", places, -2.0 * angle)
    np.testing.assert_allclose(reverse.features, [0, 0, -1, 100, 200, 300, 2000, 0.5], atol=1e-6)


def test_a_line_is_found_exactly_with_its_sense_and_travel() -> None:
    stroke = np.linspace(0.0, 1500.0, 6)
    curve = fit_curve("prismatic", np.array([1.0, 2.0, 3.0]) + np.outer(stroke, [0.0, 0.6, 0.8]), stroke)
    np.testing.assert_allclose(curve.features, [0, 0.6, 0.8, 1, 452, 603, 0, 1], atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_place_does_to_the_curve_agrees_with_finite_differences(kind: Kind) -> None:
    places, angle = arc_places(60.0, 7)
    if kind == "prismatic":
        places = np.outer(1000.0 * angle, [0.0, 0.6, 0.8])
    curve = fit_curve(kind, places, angle)
    for index in np.ndindex(places.shape):
        ends = []
        for step in (-1e-3, 1e-3):
            moved = places.copy()
            moved[index] += step
            ends.append(fit_curve(kind, moved, angle).features)
        numeric = (ends[1] - ends[0]) / 2e-3
        np.testing.assert_allclose(curve.sensitivity[(slice(None), *index)], numeric, rtol=1e-4, atol=2e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_gross_outliers_are_left_out_and_nothing_else(kind: Kind) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        places, angle = arc_places(50.0, 10)
        if kind == "prismatic":
            places = np.outer(1000.0 * angle, [0.0, 0.6, 0.8])
        places = places + rng.normal(0.0, 3.0, places.shape)
        bad = rng.choice(10, 2, replace=False)
        places[bad] += rng.choice([-1.0, 1.0], (2, 3)) * rng.uniform(150.0, 400.0, (2, 3))
        assert np.flatnonzero(~without_outliers(kind, places, 2.0)).tolist() == sorted(bad.tolist())


# -- axes of simulated machines --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["swdt82", "ys100", "ur10"])
def test_every_joints_axis_is_found_where_the_true_machine_has_it(name: str) -> None:
    rig = shipped_rig(name)
    scaled = []
    for seed in (1000, 1001, 1002):
        truth = RigTruth(rig, seed)
        _, _, axes = axes_of(truth, seed)
        assert {a.joint for a in axes} == set(rig.joint_names)
        for axis in axes:
            true = true_curve(truth, axis)
            assert axis.direction @ true[:3] > 0.99
            scaled.append(float(np.linalg.norm(axis.direction - true[:3])) / axis.direction_sigma_rad)
            if axis.kind == "revolute":
                scaled.append(abs(float(axis.features[6] - true[6])) / np.sqrt(axis.covariance[6, 6]))
    # Standard errors are those of the errors: neither far too small nor far too large.
    assert 0.5 < np.sqrt(np.mean(np.square(scaled))) < 1.6
    assert np.mean(np.array(scaled) < 3.0) > 0.95


def test_random_poses_hold_no_sweep_of_the_joints_that_matter() -> None:
    truth = RigTruth(shipped_rig("ys100"), 1000)
    chain, samples, _ = placed(truth.rig, spread_poses(truth, 300, 1000))
    assert find_axes(chain, samples) == ()


def test_sweeps_are_found_among_other_poses_and_by_set_up() -> None:
    truth = RigTruth(shipped_rig("ys100"), 1001)
    parts = [sweeps(truth, 1, "a"), sweeps(truth, 2, "b")]
    joined = joined_observations(parts)
    chain, samples, _ = placed(truth.rig, joined)
    found = {(a.joint, a.setup) for a in find_axes(chain, samples)}
    assert found == {(joint, setup) for joint in truth.rig.joint_names for setup in "ab"}


def test_a_prism_that_one_joint_moves_may_be_out_of_view_of_a_set_up() -> None:
    shipped = shipped_rig("swdt82")
    low = shipped.prisms[0].model_copy(update={"frame": 1, "offset_mm": (900.0, 0.0, 300.0)})
    truth = RigTruth(shipped.model_copy(update={"prisms": (low, *shipped.prisms[1:])}), 1003)
    here, there = sweeps(truth, 1, "a"), sweeps(truth, 2, "b")
    chain, samples, _ = placed(truth.rig, joined_observations([here, there.select(there.prism != "w")]))
    assert {(a.joint, a.setup) for a in find_axes(chain, samples) if a.prism == "w"} == {("theta1", "a")}


def test_a_gross_outlier_in_a_sweep_is_left_out() -> None:
    truth = RigTruth(shipped_rig("ys100"), 1002)
    observations = sweeps(truth, 3)
    position = observations.position_mm.copy()
    position[9 * 2 + 4] += [40.0, -60.0, 30.0]  # in the sweep of theta3
    counts = []
    for measured in (observations, replace(observations, position_mm=position)):
        chain, samples, _ = placed(truth.rig, measured)
        (axis,) = [a for a in find_axes(chain, samples) if a.joint == "theta3"]
        counts.append(len(axis.sweep))
    assert counts[1] == counts[0] - 1


def joined_observations(parts: list[Observations]) -> Observations:
    joined = parts[0]
    for number, part in enumerate(parts[1:], 1):
        pose = np.char.add(f"{number}-", part.pose)
        joined = replace(
            joined,
            prism=np.concatenate([joined.prism, part.prism]),
            joints={k: np.concatenate([v, part.joints[k]]) for k, v in joined.joints.items()},
            position_mm=np.vstack([joined.position_mm, part.position_mm]),
            sigma_mm=np.vstack([joined.sigma_mm, part.sigma_mm]),
            setup=np.concatenate([joined.setup, part.setup]),
            session=np.concatenate([joined.session, part.session]),
            pose=np.concatenate([joined.pose, pose]),
            extra={},
            row_numbers=None,
            place="row",
        )
    return joined


# -- the start -------------------------------------------------------------------------------------------------------


def far_machine(name: str, seed: int) -> RigTruth:
    """A machine tens of degrees and hundreds of mm from its rig file."""
    rig = shipped_rig(name)
    wide = rig.tolerances.model_copy(update={"angle_deg": 17.3, "beta_deg": 17.3, "length_mm": 230.0})
    truth = RigTruth(rig.model_copy(update={"tolerances": wide}), seed)
    truth.rig = rig
    return truth


@pytest.mark.long
@pytest.mark.parametrize(("name", "seed"), [("swdt82", 2), ("swdt82", 7), ("ys100", 1003)])
def test_sweeps_start_the_search_where_angles_are_thirty_degrees_off(name: str, seed: int) -> None:
    truth = far_machine(name, seed)
    both = joined_observations([spread_poses(truth, 60, seed), sweeps(truth, seed)])
    chain, samples, nominal = placed(truth.rig, both)
    at = start_from_axes(chain, samples, find_axes(chain, samples))

    def misfit(x: Floats) -> float:
        return float(np.median(np.linalg.norm(samples.position_mm - chain.positions_mm(x, samples.data), axis=1)))

    assert misfit(at) < 0.05 * misfit(nominal)
    fit = refine(chain, samples, at, prior="as-built")
    assert misfit(fit.x) < 2.0 * NOISE_MM[name]


def test_the_start_places_the_base_of_a_set_up_without_sweeps_too() -> None:
    truth = RigTruth(shipped_rig("ys100"), 1004, perturbation=10.0)
    poses = simulate_observations(truth, 40, 5, noise_mm=0.03, setup="b")
    other = parse_observations(poses.csv_text().encode(), truth.rig, "poses.csv")
    chain, samples, _ = placed(truth.rig, joined_observations([sweeps(truth, 4, "a"), other]))
    axes = [a for a in find_axes(chain, samples) if a.setup == "a"]
    at = start_from_axes(chain, samples, axes)
    error = np.linalg.norm(samples.position_mm - chain.positions_mm(at, samples.data), axis=1)
    assert np.median(error[samples.data.setup == 1]) < 10.0
    # On a body still so far off, sound coordinates may fit worse than their mirror image: that refuses nothing.
    mirrored = np.where((samples.data.setup == 1)[:, None], [1.0, 1.0, -1.0], 1.0) * samples.position_mm
    assert np.isfinite(start_from_axes(chain, replace(samples, position_mm=mirrored), axes)).all()


# -- the cross-check -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["swdt82", "ys100", "ur10"])
def test_a_right_model_agrees_with_sweeps_that_it_never_saw(name: str) -> None:
    for seed in (1005, 1006):
        truth = RigTruth(shipped_rig(name), seed)
        chain, fit = identified(truth, seed)
        _, _, axes = axes_of(truth, seed + 1)
        checks = cross_check(chain, fit.x, fit.covariance, axes)
        assert [c.joint for c in checks] == [a.joint for a in axes]
        assert disagreements(checks) == ()
        assert min(c.p_axis for c in checks) > 1e-5


@pytest.mark.parametrize(
    ("name", "parameter", "joint"),
    [("swdt82", "row5.alpha", "theta5"), ("swdt82", "row7.alpha", "theta7"), ("ys100", "row4.alpha", "theta4")],
)
def test_a_wrong_constant_is_caught_and_the_first_joint_beyond_it_is_named(
    name: str, parameter: str, joint: str
) -> None:
    truth = RigTruth(shipped_rig(name), 1007)
    chain, fit = identified(truth, 1007)
    wrong = fit.x.copy()
    wrong[chain.index(parameter)] += np.radians(5.0)
    _, _, axes = axes_of(truth, 1008)
    checks = cross_check(chain, wrong, fit.covariance, axes)
    off = [c for c in checks if c.sentence is not None and c.sentence.startswith("the axis of")]
    assert off[0].joint == joint
    assert off[0].angle_deg == pytest.approx(5.0, abs=max(1.0, 4.0 * off[0].angle_sigma_deg))
    assert any(f"the axis of {joint}" in sentence for sentence in disagreements(checks))


def test_a_reversed_joint_is_said_to_run_the_other_way() -> None:
    rig = shipped_rig("ys100")
    fourth = rig.rows[3].model_copy(update={"drive": {"theta": {"theta4": -1.0}}})
    reversed_rig = rig.model_copy(update={"rows": (*rig.rows[:3], fourth, *rig.rows[4:])})
    truth = RigTruth(rig, 1009)
    chain, fit = identified(truth, 1009)
    _, _, axes = axes_of(truth, 1010)
    wrong = Chain(reversed_rig, chain.placements)
    sentences = disagreements(cross_check(wrong, fit.x, fit.covariance, axes))
    assert any(s.startswith("theta4 runs the opposite way to the model") for s in sentences)
    assert not any(s.startswith(("theta1 runs", "theta2 runs", "theta3 runs")) for s in sentences)


def test_a_longer_prism_offset_leaves_the_axis_and_shows_in_the_circle() -> None:
    truth = RigTruth(shipped_rig("ys100"), 1011)
    chain, fit = identified(truth, 1011)
    wrong = fit.x.copy()
    wrong[chain.index("prism.tool.x")] += 2.0
    _, _, axes = axes_of(truth, 1012)
    check = {c.joint: c for c in cross_check(chain, wrong, fit.covariance, axes)}["theta6"]
    assert check.sentence is not None
    assert check.sentence.startswith("about theta6, prism tool moves on a circle")
    x, y, _ = truth.prism_offset_mm("tool")
    assert check.radius_mm == pytest.approx(-2.0 * x / np.hypot(x, y), abs=0.1)


def test_a_transducer_that_reads_short_is_told_by_its_travel() -> None:
    truth = RigTruth(shipped_rig("swdt82"), 1013)
    chain, fit = identified(truth, 1013)
    _, _, axes = axes_of(truth, 1014)
    short = [
        replace(a, features=np.append(a.features[:7], 1.02 * a.features[7])) if a.joint == "L3" else a for a in axes
    ]
    checks = cross_check(chain, fit.x, fit.covariance, short)
    found = [c for c in checks if c.joint == "L3"]
    assert all(c.travel == pytest.approx(1.02, abs=0.01) for c in found)
    assert any("the axis of L3" in s and "moves 1.02" in s for s in disagreements(checks))
    assert len(disagreements(checks)) == 1


def test_what_the_model_says_of_a_sweep_is_the_curve_of_its_own_places() -> None:
    truth = RigTruth(shipped_rig("swdt82"), 1015, perturbation=0.0)
    chain, _, axes = axes_of(truth, 1015)
    # The parallel linkage carries its prisms on a circle of the link's length, about no axis of the rig.
    linkage = [a for a in axes if a.joint == "theta1"]
    for axis in linkage:
        assert predicted_curve(chain, np.zeros(len(chain)), axis).features[6] == pytest.approx(1382.0, abs=1e-6)
        assert abs(axis.features[6] - 1382.0) < 4.0 * np.sqrt(axis.covariance[6, 6])
