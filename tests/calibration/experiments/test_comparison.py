from __future__ import annotations

import itertools
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from calibration.errors import UnsafeError
from calibration.evaluation.evaluation import evaluate
from calibration.experiments.comparison import METHODS, Comparison, compare, shared_rows
from calibration.experiments.residual_comparison import RESIDUALS
from calibration.experiments.zhou2022.held_out import standstills, tip_path
from calibration.experiments.zhou2022.protocol import Protocol, run_protocol, single_joint_rows
from calibration.experiments.zhou2022.table3 import Table3
from calibration.experiments.zhou2022.weights import dominated, weight_grid
from calibration.observations import Observations, parse_observations
from calibration.pipeline import methods
from calibration.pipeline.calibrate import calibrate, identify
from calibration.published.paper_evolution import PaperSettings
from calibration.residual.selection import Kind
from calibration.rig.description import Rig, parse_rig, shipped_rig
from calibration.run_settings import Run
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.bench.zhou2022 import PATH_POINTS, data_sets, sweeps, table
from tests.calibration.conftest import rig_text
from tests.calibration.simulated_ys100 import robot, stiffening
from tests.simulated.observations import simulate_observations

pytestmark = pytest.mark.long

TORSO = Path(__file__).parents[2] / "rigs" / "torso.toml"
SMALL = PaperSettings(population=60, generations=10)


def clock() -> float:
    return float(next(_ticks))


_ticks = itertools.count()


def parsed(text: str, rig: Rig) -> Observations:
    return parse_observations(text.encode(), rig, "simulated.csv")


def torso() -> tuple[Rig, str, Observations, Observations]:
    """Training rows with sweeps at set-up east, and held-out rows at set-up west: no masses, three prisms."""
    text = TORSO.read_text(encoding="utf-8")
    rig = parse_rig(text, TORSO.name)
    truth = RigTruth(rig, 3)
    alone = sweeps(rig, 6)
    single = simulate_observations(truth, 6 * len(rig.joints), 3, poses=alone, setup="east")
    multi = simulate_observations(truth, 40, 4, setup="east")
    held_out = simulate_observations(truth, 60, 5, setup="west")
    return rig, text, parsed(table({"single": single, "multi": multi}), rig), parsed(held_out.csv_text(), rig)


# -- methods side by side --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ys100() -> tuple[Rig, Observations, Observations, Comparison]:
    rig, training, held_out = robot(1001, stiffening(1001))
    found = compare(rig, rig_text("ys100"), training, held_out, clock=clock, methods=METHODS[:-1], residuals=())
    return rig, training, held_out, found


def test_every_method_there_is_takes_part() -> None:
    assert sorted(METHODS) == sorted(methods.METHODS)
    assert METHODS[-1] == "pde-paper"


def test_the_second_papers_table_has_the_default_lowest(
    ys100: tuple[Rig, Observations, Observations, Comparison],
) -> None:
    found = ys100[-1]
    assert [r.method for r in found.results] == ["nominal", *METHODS[:-1]]
    assert all(r.reason is None for r in found.results)
    for figure in ("mean_mm", "max_mm", "std_mm"):
        assert found.lowest(figure) == {"default"}
    means = [float(r.error_mm.mean()) for r in found.results if r.error_mm is not None]
    assert means[0] == max(means)
    assert means[2] < means[1]  # compliances help where reducers give way


def test_figures_are_those_of_calibrate_and_evaluate(
    ys100: tuple[Rig, Observations, Observations, Comparison],
) -> None:
    rig, training, held_out, found = ys100
    model, trained = calibrate(rig, rig_text("ys100"), training, method="skcm")
    last = evaluate(model, held_out).stages()[-1]
    row = found.results[2].as_dict()
    for name in ("mean_mm", "max_mm", "std_mm", "rms_mm"):
        assert row[name] == pytest.approx(last[name], rel=1e-9)
    assert row["training_mean_mm"] == pytest.approx(trained.stages()[-1]["mean_mm"], rel=1e-9)
    assert found.results[0].seconds is None
    assert all(r.seconds is not None and r.seconds > 0 for r in found.results[1:])


def test_a_method_that_cannot_use_the_data_says_why_and_the_others_go_on() -> None:
    rig, text, training, held_out = torso()
    found = compare(rig, text, training, held_out, clock=clock, methods=("skcm", "km"), refit_base=True)
    nominal, refused, applied = found.results
    assert refused.error_mm is None
    assert refused.reason is not None
    assert "masses" in refused.reason
    assert applied.error_mm is not None
    assert nominal.error_mm is not None
    assert applied.error_mm.mean() < nominal.error_mm.mean()
    assert refused.as_dict()["mean_mm"] is None
    assert any("set-up 'west' was fitted" in note for note in found.warnings)


def test_held_out_rows_of_an_unknown_setup_are_refused() -> None:
    rig, text, training, held_out = torso()
    with pytest.raises(UnsafeError, match=r"set-up 'west' .*--refit-base"):
        compare(rig, text, training, held_out, clock=clock, methods=("km",))


def test_where_no_method_applies_the_default_s_reason_is_the_error() -> None:
    rig, training, held_out = robot(1001, ())
    few = training.select(np.arange(3))
    with pytest.raises(UnsafeError) as alone:
        calibrate(rig, rig_text("ys100"), few)
    with pytest.raises(UnsafeError) as found:
        compare(rig, rig_text("ys100"), few, held_out, clock=clock, methods=("default", "km"))
    assert str(found.value) == str(alone.value)


@pytest.fixture(scope="module")
def drooping() -> tuple[Observations, Observations, Comparison]:
    """A boom that droops, its effects found or not; the held-out rows stand at another set-up."""
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, 1003, effects=parse_effects("boom_droop@boom,encoder_harmonic@theta3:k=3"))
    training, held_out = (
        parsed(simulate_observations(truth, 25, seed, setup=setup).csv_text(), rig)
        for seed, setup in ((1, "east"), (2, "west"))
    )
    found = compare(
        rig,
        rig_text("swdt82"),
        training,
        held_out,
        clock=clock,
        methods=("default",),
        residuals=("effects", "table", "rbfn-paper", "rbfn"),
        refit_base=True,
    )
    return training, held_out, found


def test_every_learner_there_is_can_be_compared() -> None:
    assert sorted(RESIDUALS) == sorted(["effects", "table", "rbfn-paper", *set(get_args(Kind)) - {"default", "none"}])


def test_residuals_share_one_identification_and_differ_in_what_is_learned(
    drooping: tuple[Observations, Observations, Comparison],
) -> None:
    found = drooping[-1]
    assert [r.method for r in found.results] == ["nominal", "effects", "table", "rbfn-paper", "rbfn", "default"]
    assert all(r.reason is None for r in found.results)
    _, bare, table, paper, network, _ = found.results
    assert bare.adds == tuple(family for family in table.adds if family != "table")
    assert paper.adds == (*bare.adds, "rbfn-paper")
    mean = {r.method: float(r.error_mm.mean()) for r in found.results if r.error_mm is not None}
    trained = {r.method: float(r.training_error_mm.mean()) for r in found.results if r.training_error_mm is not None}
    assert mean["rbfn"] <= mean["effects"]
    assert trained["table"] < trained["effects"]
    assert trained["rbfn-paper"] < trained["effects"]
    assert network.adds == (*bare.adds, "rbfn") or any("left out" in note for note in network.notes)


def test_the_paper_s_network_is_reported_with_its_best_width_beside(
    drooping: tuple[Observations, Observations, Comparison],
) -> None:
    (note,) = drooping[-1].results[3].notes
    assert "theta = 0.05" in note
    assert "at the best width of each prism" in note


def test_without_a_residual_the_figures_are_those_of_the_effects(
    drooping: tuple[Observations, Observations, Comparison],
) -> None:
    training, held_out, found = drooping
    model = identify(shipped_rig("swdt82"), rig_text("swdt82"), training)
    stage = evaluate(model, held_out, refit_base=True).stages()[2]
    assert stage["stage"] == "effects"
    assert found.results[1].as_dict()["rms_mm"] == pytest.approx(stage["rms_mm"], rel=1e-9)


def test_rows_and_poses_that_training_and_held_out_data_share_are_named() -> None:
    rig = shipped_rig("swdt82")
    data = parsed(simulate_observations(RigTruth(rig, 1), 10, 1).csv_text(), rig)  # four prisms in each pose
    assert shared_rows(data.select(np.arange(20)), data.select(np.arange(20, 40)), ("a.csv", "b.csv")) == (0, ())
    count, (same, pose) = shared_rows(data.select(np.arange(22)), data.select(np.arange(19, 40)), ("a.csv", "b.csv"))
    assert count == 3
    assert "3 of the 21 rows of b.csv are rows of a.csv" in same
    assert "the first in line 21; " in same
    assert "2 of the 21 rows of b.csv were measured in poses of a.csv" in pose
    assert "the first in line 24; " in pose
    moved = replace(data, position_mm=data.position_mm + 0.1)
    count, found = shared_rows(data, moved, ("a.csv", "b.csv"))
    assert (count, len(found)) == (0, 1)


# -- the first paper's section 4 -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def boom() -> tuple[Observations, Observations, Protocol]:
    rig = shipped_rig("swdt82")
    springs = "joint_compliance@theta4:compliance_rad_per_Nm=5e-8"
    texts = data_sets(1002, poses=20, stops=5, perturbation=1.0, effects=springs)
    training, held_out = (parsed(text, rig) for text in texts)
    with ThreadPoolExecutor(2) as executor:
        found = run_protocol(
            rig,
            rig_text("swdt82"),
            training,
            held_out,
            clock=clock,
            run=Run(executor=executor),
            settings=SMALL,
            draws=1,
        )
    return training, held_out, found


def test_sweeps_are_told_from_motion_of_several_joints(boom: tuple[Observations, Observations, Protocol]) -> None:
    training, held_out, found = boom
    single = single_joint_rows(shipped_rig("swdt82"), training)
    np.testing.assert_array_equal(single, np.char.startswith(training.pose, "single"))
    assert not single_joint_rows(shipped_rig("swdt82"), held_out).any()
    assert [b.motion for b in found.before] == ["single-joint", "multi-joint"]
    assert found.before[0].fixes == dict.fromkeys("wbrs", 45)
    assert found.before[1].fixes == dict.fromkeys("wbrs", 20)


def test_table_3_has_every_data_set_and_the_optimum_is_never_above_the_search(
    boom: tuple[Observations, Observations, Protocol],
) -> None:
    found = boom[-1]
    assert [(i.data, i.way) for i in found.identified] == [
        (data, way)
        for data in ("single-joint", "multi-joint", "weighted")
        for way in ("paper", "converged", "base free")
    ]
    lines = found.identified
    for searched, converged, released in zip(lines[::3], lines[1::3], lines[2::3], strict=True):
        assert released.objective_mm2 < converged.objective_mm2 < searched.objective_mm2
    last = found.identified[-1]
    assert all(last.held_out_mm[prism] < found.held_out_before_mm[prism] for prism in "wbrs")
    assert found.front is not None
    assert last.weight == found.front.weight


def test_the_hybrid_learns_from_more_data_and_follows_the_path(
    boom: tuple[Observations, Observations, Protocol],
) -> None:
    _, held_out, found = boom
    assert [p.poses for p in found.learning] == [32, 65]
    assert found.learning[-1].hybrid_mm[0] < found.learning[0].hybrid_mm[0]
    path = found.trajectory
    assert (path.prism, len(path.rows), path.in_time) == ("r", PATH_POINTS, True)
    assert np.char.startswith(held_out.pose[path.rows], "path").all()
    mean = {name: float(error.mean()) for name, error in path.error_mm.items()}
    assert mean["hybrid"] < mean["geometric"] < mean["before"]
    assert set(path.left_out) <= {"rbfn", "lightgbm", "chain"}


def test_the_answer_is_json_and_has_the_paper_s_figures_beside(
    boom: tuple[Observations, Observations, Protocol],
) -> None:
    found = json.loads(json.dumps(boom[-1].as_dict(), allow_nan=False))
    assert list(found) == [
        "protocol", "rig", "n", "n_holdout", "before", "holdout_before_mm", "identification", "front",
        "learning_curve", "trajectory", "paper", "warnings",
    ]  # fmt: skip
    assert found["paper"]["after_mm"]["multi-joint"]["w"] == 44.83
    assert found["paper"]["trajectory"]["chain"] == {"mean_mm": 30.5, "std_mm": 17.4}
    assert sum(found["front"]["chosen_weights"].values()) == pytest.approx(1.0)
    assert not all(point["dominated"] for point in found["front"]["points"])
    assert len(found["trajectory"]["errors"]["hybrid"]["error_mm"]) == PATH_POINTS


def test_without_sweeps_or_times_the_protocol_does_the_rest_and_says_so() -> None:
    rig, text, training, _ = torso()
    multi = training.select(np.char.startswith(training.pose, "multi"))
    extra = {name: values for name, values in multi.extra.items() if name != "time_s"}
    held_out = replace(multi, extra=extra)
    with ThreadPoolExecutor(2) as executor:
        found = run_protocol(
            rig, text, multi, held_out, clock=clock, run=Run(executor=executor), settings=SMALL, draws=1
        )
    assert [b.motion for b in found.before] == ["multi-joint"]
    assert [i.data for i in found.identified] == ["multi-joint"] * 3 + ["weighted"] * 3
    said = " ".join(found.warnings)
    assert "no single-joint sweep" in said
    assert "no time_s" in said
    assert "40 points, not 200" in said


def test_the_optimum_is_where_no_direction_leads_down() -> None:
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, 5, effects=parse_effects("boom_droop@boom"))
    data = parsed(simulate_observations(truth, 60, 5).csv_text(), rig)
    experiment = Table3.prepare(rig, data, data, np.zeros(len(data), dtype=bool), "recalibration")
    objective = experiment.training
    weight = {"r": 0.4, "s": 0.3, "b": 0.2, "w": 0.1}
    best = objective.optimum(weight)
    assert (np.abs(best) <= objective.width).all()
    least = objective.cost(weight, best)
    by_hand = sum(mu * (objective.error_mm(best)[data.prism == p] ** 2).mean() for p, mu in weight.items())
    assert least == pytest.approx(by_hand, rel=1e-9)
    rng = np.random.default_rng(0)
    for size in (1e-2, 1e-4):
        for _ in range(30):
            step = size * objective.width * rng.normal(size=len(best))
            inside = np.clip(best + step, -objective.width, objective.width)
            assert objective.cost(weight, inside) > least * (1.0 - 1e-6)
    far = objective.optimum(weight, 0.5 * objective.width * rng.uniform(-1.0, 1.0, len(best)))
    assert objective.cost(weight, far) == pytest.approx(least, rel=1e-3)


def test_weights_cover_the_simplex_evenly() -> None:
    for count in (2, 3, 4, 6):
        grid = np.array(list(weight_grid(count)))
        assert 10 <= len(grid) <= 150
        assert len(np.unique(grid, axis=0)) == len(grid)
        np.testing.assert_allclose(grid.sum(axis=1), 1.0)
        assert grid.min() == pytest.approx(0.01)
        np.testing.assert_allclose(grid.mean(axis=0), 1.0 / count)


def test_dominated_points_are_those_with_a_better_one() -> None:
    assert dominated([[1, 3], [2, 2], [3, 1], [2, 3], [3, 3], [1, 3]]).tolist() == [
        False, False, False, True, True, False,
    ]  # fmt: skip


def test_the_path_is_the_tip_s_first_fixes_in_the_order_of_time() -> None:
    rig = shipped_rig("swdt82")
    data = parsed(simulate_observations(RigTruth(rig, 2), 300, 2).csv_text(), rig)
    shuffled = data.select(np.random.default_rng(0).permutation(len(data)))
    distance = np.where(shuffled.prism == "s", 2.0, 1.0)
    tip, rows, in_time = tip_path(rig, shuffled, distance)
    assert (tip, len(rows), in_time) == ("s", 200, True)
    time_s = shuffled.extra["time_s"]
    assert (np.diff(time_s[rows]) > 0).all()
    others = np.setdiff1d(np.flatnonzero(shuffled.prism == "s"), rows)
    assert time_s[rows].max() < time_s[others].min()


def test_fixes_of_one_standstill_have_one_number() -> None:
    rig = shipped_rig("swdt82")
    data = parsed(simulate_observations(RigTruth(rig, 2), 5, 2).csv_text(), rig)
    assert len(np.unique(standstills(data))) == 5
    unlabelled = replace(data, pose=np.array([""] * len(data)))
    assert len(np.unique(standstills(unlabelled))) == len(data)
