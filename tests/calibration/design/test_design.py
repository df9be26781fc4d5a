from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import stats

from calibration.design.candidates import Candidates, draw, near
from calibration.design.exchange import (
    Accuracy,
    Criterion,
    Determinant,
    Discrimination,
    Hypothesis,
    choose,
    improve,
    information_of,
)
from calibration.design.knowledge import Knowledge
from calibration.design.planning import plan_poses
from calibration.design.poses import plan
from calibration.design.tour import length_s, short_tour, travel_s
from calibration.design.visibility import (
    Bodies,
    Site,
    in_view,
    is_reachable,
    placement,
    segment_distance,
    site,
    spread_poses,
)
from calibration.effects.fitted import Choice
from calibration.errors import DataError, UnsafeError
from calibration.kinematics.chain import Chain, Placement
from calibration.observations import Floats
from calibration.rig.description import Rig, parse_rig, shipped_rig
from calibration.run_settings import Run
from tests.bench.design import at_random, ground, trial

MAST = """
name = "mast"
convention = "dh"
tolerances = { length_mm = 1.0, angle_deg = 0.1, beta_deg = 0.1, prism_mm = 1.0 }
joint = [{ name = "q1", kind = "revolute", limits = [-1.0, 1.0], sigma = 0.001 }]
row = [{ d_mm = 1000.0, drive = { theta = { q1 = 1.0 } } }]
prism = [{ name = "p", frame = 1, offset_mm = [300.0, 0.0, -500.0] }]
"""
TRIANGLE = """
name = "triangle"
convention = "dh"
tolerances = { length_mm = 1.0, angle_deg = 0.1, beta_deg = 0.1, prism_mm = 1.0 }
prism = [{ name = "p", frame = 3, offset_mm = [0.0, 0.0, 10.0] }]
""" + "".join(
    f"""
[[joint]]
name = "q{i}"
kind = "revolute"
limits = [-150.0, 150.0]
sigma = 0.001
[[row]]
a_mm = 1000.0
drive = {{ theta = {{ q{i} = 1.0 }} }}
"""
    for i in (1, 2, 3)
)


def blank(rig: Rig) -> tuple[Chain, Floats]:
    chain = Chain(rig, {"": Placement.identity()})
    return chain, np.zeros(len(chain))


def situation(rig: Rig, count: int, seed: int = 0) -> tuple[Knowledge, Site, Candidates]:
    chain, x = blank(rig)
    at = site(chain, x)
    knowledge = Knowledge.of_rig(Chain(rig, {"": placement(at)}))
    return knowledge, at, draw(knowledge, at, np.random.default_rng(seed), count)


# -- what can be reached and seen ------------------------------------------------------------------------------------


def test_segment_distance_is_the_smallest_between_any_two_points() -> None:
    p0, p1, q0, q1 = np.random.default_rng(0).normal(size=(4, 40, 3))
    q1[:5] = q0[:5]  # points
    p1[3:8] = p0[3:8]
    q1[8:12] = q0[8:12] + 2.0 * (p1 - p0)[8:12]  # parallel
    share = np.linspace(0.0, 1.0, 201)
    on_p = p0[:, None] + share[:, None] * (p1 - p0)[:, None]
    on_q = q0[:, None] + share[:, None] * (q1 - q0)[:, None]
    sampled = np.linalg.norm(on_p[:, :, None] - on_q[:, None], axis=3).min(axis=(1, 2))
    found = segment_distance(p0, p1, q0, q1)
    assert (found <= sampled + 1e-12).all()
    assert found == pytest.approx(sampled, abs=0.03)


@pytest.mark.long
@pytest.mark.parametrize(
    ("station", "seen"),
    [
        ((3000.0, 0.0, 500.0), True),
        ((0.0, -3000.0, 500.0), True),
        ((-3000.0, 0.0, 500.0), False),  # behind the mast
        ((1000.0, 0.0, 500.0), False),  # too near
        ((1000.0, 0.0, 5000.0), False),  # too steep
    ],
)
def test_a_prism_is_in_view_unless_a_link_is_before_it(station: tuple[float, float, float], seen: bool) -> None:
    chain, x = blank(parse_rig(MAST, "mast.toml"))
    at = site(chain, x, station_mm=np.array(station))
    assert in_view(Bodies.of(chain, x, np.zeros((1, 1))), at)[0, 0] == seen


def test_the_station_of_a_set_up_is_where_its_placement_has_it() -> None:
    rig = shipped_rig("swdt82")
    chain, x = blank(rig)
    assumed = site(chain, x)
    placed = Chain(rig, {"": placement(assumed)})
    again = site(placed, x, setup=0)
    assert again.station_mm == pytest.approx(assumed.station_mm)
    assert again.up == pytest.approx(assumed.up)


def test_no_pose_goes_through_the_floor() -> None:
    rig = shipped_rig("ur10")
    chain, x = blank(rig)
    at = site(chain, x)
    poses = spread_poses(rig, 2000)
    bodies = Bodies.of(chain, x, poses)
    reachable = is_reachable(bodies, at)
    assert 0.2 < reachable.mean() < 0.9
    assert bodies.everything_mm[reachable][:, :, 2].min() >= at.floor_mm


def test_a_pose_in_which_links_touch_is_not_reachable() -> None:
    chain, x = blank(parse_rig(TRIANGLE, "triangle.toml"))
    at = site(chain, x)
    stretched, folded, nearly = [0.0, 0.0, 0.0], [0.0, 120.0, 120.0], [0.0, 120.0, 100.0]
    assert is_reachable(Bodies.of(chain, x, np.array([stretched, folded, nearly])), at).tolist() == [True, False, True]


# -- choosing --------------------------------------------------------------------------------------------------------


def blocks_of(n: int, r: int, q: int, seed: int) -> Floats:
    return np.random.default_rng(seed).normal(size=(n, r, q)) * np.logspace(0.5, -1.5, q)


KNOWN = np.diag(np.linspace(1.0, 2.0, 6)) + 0.05
MODELS = (
    Hypothesis(np.array([0.3, -0.2, 0.0, 0.1, 1.0, 0.0]), np.array([0, 1, 2, 3, 4])),
    Hypothesis(np.array([0.1, 0.2, 0.3, -0.4, 0.0, -1.0]), np.array([0, 1, 2, 3, 5])),
    Hypothesis(np.array([0.0, 0.2, 0.0, 0.0, 0.0, 0.0]), np.array([0, 1, 2, 3])),
)
PAIRS = tuple(itertools.permutations(range(3), 2))
CRITERIA = [
    (Determinant(), None),
    (Accuracy(np.random.default_rng(9).normal(size=(6, 4))), None),
    (Discrimination(MODELS, KNOWN, PAIRS), KNOWN - np.eye(6)),
]


@pytest.mark.parametrize(("criterion", "told"), CRITERIA)
def test_a_gain_is_what_the_value_grows_by(criterion: Criterion, told: Floats | None) -> None:
    blocks = blocks_of(5, 3, 6, 0)
    before = information_of(blocks[:2], told)
    for block, gain in zip(blocks[2:], criterion.gain(before, blocks[2:]), strict=True):
        after = information_of(np.concatenate([blocks[:2], block[None]]), told)
        assert criterion.value(after) - criterion.value(before) == pytest.approx(gain, rel=1e-9)


@pytest.mark.parametrize(("criterion", "told"), CRITERIA)
def test_the_exchange_comes_close_to_the_best_of_all_subsets(criterion: Criterion, told: Floats | None) -> None:
    for seed in range(5):
        blocks = blocks_of(12, 2, 6, seed)
        subsets = itertools.combinations(range(12), 4)
        values = [criterion.value(information_of(blocks[list(s)], told)) for s in subsets]
        chosen = choose(blocks, 4, criterion, told)
        assert len(set(chosen.tolist())) == 4
        reached = criterion.value(information_of(blocks[chosen], told))
        assert reached > max(values) - 0.03 * (max(values) - np.median(values))


@pytest.mark.parametrize(("criterion", "told"), CRITERIA)
def test_each_pose_moves_to_the_best_near_it_while_the_others_stay(criterion: Criterion, told: Floats | None) -> None:
    blocks, near = blocks_of(12, 2, 6, 3), np.repeat(np.arange(4), 3)

    def value(of: list[int]) -> float:
        return criterion.value(information_of(blocks[of], told))

    expected = [0, 3, 6, 9]
    for place in range(4):
        rest = [expected[:place], expected[place + 1 :]]
        expected[place] = max(range(3 * place, 3 * place + 3), key=lambda own: value([*rest[0], own, *rest[1]]))
    assert improve(blocks, near, criterion, told).tolist() == expected


def test_the_log_odds_that_a_design_brings_are_those_of_data_that_one_of_the_models_makes() -> None:
    criterion, rows = Discrimination(MODELS, KNOWN, PAIRS), blocks_of(4, 3, 6, 1).reshape(-1, 6)
    expected = criterion.log_odds(KNOWN + rows.T @ rows)
    rng, predicted = np.random.default_rng(0), []
    for model in MODELS:
        own = rows[:, model.free]
        spread = own @ np.linalg.inv(KNOWN[np.ix_(model.free, model.free)]) @ own.T
        predicted.append(stats.multivariate_normal(rows @ model.mean, spread + np.eye(len(rows))))
    for number, (true, other) in enumerate(itertools.permutations(predicted, 2)):
        data = true.rvs(20_000, rng)
        brought = true.logpdf(data) - other.logpdf(data)
        assert expected[number] == pytest.approx(brought.mean(), abs=4.0 * brought.std() / np.sqrt(len(data)))


def test_a_way_through_poses_on_a_line_goes_along_it() -> None:
    rig = parse_rig(MAST, "mast.toml")
    readings = np.random.default_rng(0).permutation(np.linspace(-1.0, 1.0, 20))[:, None]
    seconds = travel_s(rig, readings)
    order = short_tour(seconds)
    assert sorted(order.tolist()) == list(range(20))
    assert length_s(seconds, order) == pytest.approx(2.0 / rig.joints[0].max_rate)


def test_planned_poses_can_be_taken_and_are_told_with_what_is_in_view() -> None:
    knowledge, at, candidates = situation(shipped_rig("swdt82"), 1500)
    planned = plan(knowledge, candidates, 25)
    poses = planned.poses
    assert len(np.unique(poses.readings, axis=0)) == 25
    for joint, values in zip(shipped_rig("swdt82").joints, poses.readings.T, strict=True):
        assert joint.limits[0] < values.min() < values.max() < joint.limits[1]
    bodies = Bodies.of(knowledge.chain, knowledge.x, poses.readings)
    assert is_reachable(bodies, at).all()
    assert (in_view(bodies, at) == poses.seen).all()
    assert poses.seen.any(axis=1).all()
    seconds = travel_s(shipped_rig("swdt82"), poses.readings)
    assert planned.seconds_of_motion == pytest.approx(length_s(seconds, np.arange(25)))
    shuffled = [length_s(seconds, np.random.default_rng(s).permutation(25)) for s in range(20)]
    assert planned.seconds_of_motion < 0.8 * min(shuffled)
    assert (planned.parameters, planned.determined) == (56, 44)
    assert list(planned.observability) == ["O1", "O2", "O3", "O4", "O5"]


def test_the_same_seed_plans_the_same_poses() -> None:
    rig = shipped_rig("ys100")
    one, other = (plan_poses(rig, 8, run=Run(5)) for _ in range(2))
    assert one.rows == other.rows
    assert one.rows != plan_poses(rig, 8, run=Run(6)).rows


def test_planned_poses_leave_less_error_than_random_ones() -> None:
    """The bench's comparison, smaller: every machine's own error over the whole work volume."""
    planned, drawn = [], []
    for seed in range(3):
        here = ground(shipped_rig("swdt82"), seed, candidates=2000)
        planned.append(trial(here, plan(here.knowledge, here.candidates, 20).poses, seed).actual_mm)
        drawn.append(trial(here, at_random(here, 20, seed), seed).actual_mm)
    assert np.mean(planned) < 0.85 * np.mean(drawn)


@pytest.mark.long
def test_poses_that_separate_two_effects_show_them_better_than_others() -> None:
    knowledge, _, candidates = situation(shipped_rig("swdt82"), 1500)
    effects = ("joint_compliance@theta4", "angle_scale@theta4")
    separating = plan(knowledge, candidates, 15, separate=effects)
    random = plan(knowledge, candidates.select(np.arange(1, 1500, 100)), 15, separate=effects)
    assert list(separating.stands_out) == list(effects)
    for effect in effects:
        assert separating.stands_out[effect] > 1.2 * random.stands_out[effect]


@pytest.mark.long
def test_poses_that_may_move_separate_two_effects_better_than_those_among_which_they_are_chosen() -> None:
    knowledge, at, candidates = situation(shipped_rig("swdt82"), 1500)
    effects = ("joint_compliance@theta4", "angle_scale@theta4")
    fixed = plan(knowledge, candidates, 15, separate=effects)
    moved = plan(
        knowledge, candidates, 15, separate=effects, nearby=partial(near, knowledge, at, np.random.default_rng(0))
    )
    for effect in effects:
        assert moved.stands_out[effect] > 1.05 * fixed.stands_out[effect]
    bodies = Bodies.of(knowledge.chain, knowledge.x, moved.poses.readings)
    assert is_reachable(bodies, at).all()
    assert (in_view(bodies, at) >= moved.poses.seen).all()


def test_derivatives_by_the_coefficients_of_effects_are_those_of_the_positions() -> None:
    knowledge, _, candidates = situation(shipped_rig("swdt82"), 5)
    readings = candidates.readings
    choices = [Choice("angle_scale", where, {}) for where in ("theta3", "theta5")]

    def linearised(*scales: float) -> tuple[Floats, Floats]:
        found = (np.array([scale]) for scale in scales)
        effects = tuple(
            choice.fitted(knowledge.context(readings), value, np.zeros(1))
            for choice, value in zip(choices, found, strict=True)
        )
        lin = replace(knowledge, effects=effects).linearise(readings)
        return lin.position_mm, lin.jacobian[:, :, -2:]

    _, derivatives = linearised(0.0, 0.0)
    step = 1e-4
    for number, more in enumerate(np.eye(2) * step):
        change = linearised(*more)[0] - linearised(*-more)[0]
        np.testing.assert_allclose(derivatives[:, :, number], change / (2.0 * step), rtol=1e-5, atol=1e-2)


def test_an_effect_of_direction_is_planned_with_the_side_to_come_from() -> None:
    planned = plan_poses(shipped_rig("ys100"), 10, separate=("backlash@theta2", "encoder_harmonic@theta2"))
    directions = [row.conditions["theta2_dir"] for row in planned.rows]
    assert set(directions) == {-1, 1}
    assert planned.plan.stands_out["backlash@theta2"] > 5.0


def test_what_no_pose_can_show_is_refused_by_name() -> None:
    knowledge, _, candidates = situation(shipped_rig("ur10"), 50)
    with pytest.raises(DataError, match="joint_compliance@q1: does nothing at q1"):
        plan(knowledge, candidates, 5, separate=("joint_compliance@q1", "joint_compliance@q2"))
    with pytest.raises(DataError, match="only 50 reachable poses in view were found, 51 are requested"):
        plan(knowledge, candidates, 51)
    with pytest.raises(UnsafeError, match="none is reachable with a prism in view of the station at 1000000000, 0, 0"):
        plan_poses(shipped_rig("ur10"), 5, station_mm=np.array([1e9, 0.0, 0.0]))
