"""Identify, evaluate and predict as the command line and the jobs use them."""

from __future__ import annotations

import json
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from calibration.errors import DataError, UnsafeError
from calibration.evaluation.evaluation import evaluate
from calibration.model.files import model_to_files
from calibration.model.prediction import Predictor
from calibration.model.warnings import model_warnings
from calibration.observations import Observations, data_sha256
from calibration.pipeline.calibrate import calibrate, identify, train_residual
from calibration.run_settings import Run
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import Session, rig_text, rms, simulated

TEXT = rig_text("swdt82")


def joined(*parts: Observations) -> Observations:
    """Rows of several tables, one after the other."""
    first = parts[0]
    return replace(
        first,
        prism=np.concatenate([p.prism for p in parts]),
        joints={k: np.concatenate([p.joints[k] for p in parts]) for k in first.joints},
        position_mm=np.concatenate([p.position_mm for p in parts]),
        sigma_mm=np.concatenate([p.sigma_mm for p in parts]),
        setup=np.concatenate([p.setup for p in parts]),
        session=np.concatenate([p.session for p in parts]),
        pose=np.concatenate([p.pose for p in parts]),
        extra={k: np.concatenate([p.extra[k] for p in parts]) for k in first.extra},
        row_numbers=None,
        place="row",
    )


def test_the_report_is_the_contracts_json_object(session: Session) -> None:
    evaluation = evaluate(session.model, replace(session.held_out, ignored_columns=("remark",)))
    report = json.loads(json.dumps(evaluation.as_dict(1.5), allow_nan=False))
    assert list(report) == [
        "rig",
        "n",
        "fitted",
        "seconds",
        "stages",
        "per_prism",
        "effects",
        "residual",
        "residual_reason",
        "noise_mm",
        "identifiability",
        "warnings",
        "ignored_columns",
        "expected_accuracy",
        "axes",
        "importance",
        "intervals",
    ]
    assert (report["rig"], report["n"], report["seconds"]) == ("swdt82", 500, 1.5)
    assert [s["stage"] for s in report["stages"]] == ["nominal", "geometric", "effects", "hybrid"]
    assert list(report["stages"][0]) == ["stage", "mean_mm", "rms_mm", "max_mm", "std_mm"]
    assert set(report["per_prism"]) == {"w", "b", "r", "s"}
    assert report["effects"] == []
    assert report["residual"] is None
    assert list(report["identifiability"])[:3] == ["parameters", "rank", "unidentifiable"]
    assert report["ignored_columns"] == ["remark"]
    norm = np.linalg.norm(evaluation.errors_mm["geometric"], axis=1)
    geometric = report["stages"][1]
    assert geometric["rms_mm"] == pytest.approx(np.sqrt((norm**2).mean()))
    assert geometric["max_mm"] == pytest.approx(norm.max())
    # Without effects and without a residual, both stages repeat the one before.
    assert [report["stages"][i]["rms_mm"] for i in (2, 3)] == [geometric["rms_mm"]] * 2


def test_calibrate_is_identify_and_train_and_reports_progress_to_the_end(session: Session) -> None:
    seen: list[tuple[float, str]] = []
    model, evaluation = calibrate(
        session.rig,
        TEXT,
        session.training,
        residual="none",
        run=Run(progress=lambda share, what: seen.append((share, what))),
    )
    shares = [share for share, _ in seen]
    assert shares == sorted(shares)
    assert seen[-1] == (1.0, "done")
    assert len(evaluation) == 250
    assert model.residual_reason == "switched off"
    np.testing.assert_array_equal(model.values, session.model.values)
    assert model.provenance["data_sha256"] == data_sha256(session.training, session.rig)


def test_the_model_depends_on_the_seed_and_not_on_the_executor(session: Session) -> None:
    with ThreadPoolExecutor(3) as pool:
        other = identify(session.rig, TEXT, session.training, run=Run(executor=pool))
    assert model_to_files(other) == model_to_files(session.model)


def test_what_progress_raises_ends_the_work(session: Session) -> None:
    def cancel(share: float, what: str) -> None:
        if share > 0.3:
            raise TimeoutError("enough")

    with pytest.raises(TimeoutError, match="enough"):
        identify(session.rig, TEXT, session.training, run=Run(progress=cancel))


def test_predictions_know_their_own_uncertainty(session: Session) -> None:
    prediction = Predictor.of(session.model).predict(session.held_out)
    deviation = (session.held_out.position_mm - prediction.position_mm) / prediction.sigma_mm
    assert 0.8 < (deviation**2).mean() < 1.2
    assert 0.93 < (np.abs(deviation) < 1.96).mean() < 0.97


def test_prediction_needs_no_positions(session: Session) -> None:
    blind = replace(session.held_out, position_mm=np.full((500, 3), np.nan))
    np.testing.assert_array_equal(
        Predictor.of(session.model).predict(blind).position_mm,
        Predictor.of(session.model).predict(session.held_out).position_mm,
    )


def test_identification_and_evaluation_need_positions(session: Session) -> None:
    blind = replace(session.training, position_mm=np.full((250, 3), np.nan))
    with pytest.raises(DataError, match="every row needs a measured position"):
        identify(session.rig, TEXT, blind)
    with pytest.raises(DataError, match="every row needs a measured position"):
        evaluate(session.model, blind)
    with pytest.raises(DataError, match="there are none"):
        evaluate(session.model, session.held_out.select(np.array([], dtype=int)))


@pytest.mark.long
def test_several_set_ups_share_one_machine(session: Session) -> None:
    parts = [simulated(session.truth, 125, 20 + i, setup=name) for i, name in enumerate(("north", "south"))]
    model = identify(session.rig, TEXT, joined(*parts))
    assert set(model.placements) == {"north", "south"}
    assert {"base[north].x", "base[south].rz"} <= {p.name for p in model.parameters}
    for i, name in enumerate(("north", "south")):
        held = simulated(session.truth, 300, 30 + i, setup=name)
        stages = {s["stage"]: s["rms_mm"] for s in evaluate(model, held).stages()}
        assert float(stages["geometric"]) < 6.0


def test_an_unknown_set_up_is_refused_unless_its_base_is_refitted(session: Session) -> None:
    moved = simulated(session.truth, 300, 40, setup="elsewhere")
    with pytest.raises(UnsafeError, match=r"set-up 'elsewhere' is unknown to the model .*--refit-base"):
        evaluate(session.model, moved)
    with pytest.raises(UnsafeError, match="--refit-base"):
        Predictor.of(session.model).predict(moved)
    evaluation = evaluate(session.model, moved, refit_base=True)
    assert rms(evaluation.errors_mm["geometric"]) < 6.0
    assert "base transform of set-up 'elsewhere' was fitted on these 300 fixes" in evaluation.warnings[-1]
    body = session.model.chain.base_start
    np.testing.assert_array_equal(evaluation.model.values[:body], session.model.values[:body])
    assert 0.8 < float(((evaluation.errors_mm["hybrid"] / evaluation.sigma_mm) ** 2).mean()) < 1.2


def test_refitting_stands_beside_outliers(session: Session) -> None:
    moved = simulated(session.truth, 60, 41, setup="elsewhere")
    position = moved.position_mm.copy()
    position[:12] += 700.0
    evaluation = evaluate(session.model, replace(moved, position_mm=position), refit_base=True)
    assert rms(evaluation.errors_mm["geometric"][12:]) < 7.0
    assert {o.row for o in evaluation.outliers} == set(range(12))


def test_outliers_are_listed_with_their_size(session: Session) -> None:
    position = session.training.position_mm.copy()
    position[[17, 42]] += [[400.0, 0.0, 0.0], [0.0, 90.0, 0.0]]
    model = identify(session.rig, TEXT, replace(session.training, position_mm=position))
    size = {o.row: o.sigma for o in model.outliers}
    assert {19, 44} <= set(size)  # lines of the file that the rows are from
    assert size[19] > size[44] > 10.0
    assert any(
        w.startswith("2 of 250 training fixes are outliers") and w.endswith("in lines 19, 44") for w in model.warnings
    )


def test_a_joint_that_never_moved_and_a_prism_never_seen_are_named(session: Session) -> None:
    still = {**session.training.joints, "theta5": np.full(250, 3.0)}
    part = replace(session.training, joints=still)
    part = replace(part, position_mm=_measured(session.truth, part))
    part = part.select(part.prism != "w")
    model = identify(session.rig, TEXT, part)
    assert any(w.startswith("theta5 never moved (3.00 .. 3.00 deg)") for w in model.warnings)
    assert "prism 'w' has no fixes; its offset stays at its nominal value" in model.warnings
    warnings = evaluate(model, session.held_out).warnings
    assert "prism 'w' was never measured in training; its offset is the nominal one" in warnings
    assert any(w.startswith("theta5: ") and "outside the 3.0 .. 3.0 deg" in w for w in warnings)


def _measured(truth: RigTruth, observations: Observations) -> np.ndarray:
    """Positions of the true machine at the readings, with 3 mm of noise."""
    out = np.random.default_rng(0).normal(0, 3.0, (len(observations), 3))
    for prism in truth.rig.prism_names:
        rows = observations.prism == prism
        if rows.any():
            columns = {k: v[rows] for k, v in observations.extra.items()}
            out[rows] += truth.prism_mm(prism, {k: v[rows] for k, v in observations.joints.items()}, columns)
    return out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda o: o.select(np.arange(15)),
            "15 fixes have 45 coordinates, which cannot determine 56 parameters; measure 112 or more",
        ),
        (lambda o: replace(o, position_mm=o.position_mm / 1000.0), "the positions are in m"),
        (lambda o: replace(o, position_mm=o.position_mm[:, [1, 0, 2]]), "mirrored"),
        (
            lambda o: replace(o, joints=o.joints | {"theta1": o.joints["theta3"], "theta3": o.joints["theta1"]}),
            "columns theta1_deg and theta3_deg are exchanged",
        ),
        (
            lambda o: replace(o, joints={k: np.radians(v) if k[0] == "t" else v for k, v in o.joints.items()}),
            "all angles are in radians",
        ),
    ],
    ids=["few fixes", "metres", "mirrored", "exchanged columns", "radians"],
)
def test_data_that_would_give_a_wrong_model_are_refused(session: Session, change, message: str) -> None:  # type: ignore[no-untyped-def]  # lambdas
    with pytest.raises(UnsafeError, match=message):
        identify(session.rig, TEXT, change(session.training))


def test_repeats_do_not_count_as_poses(session: Session) -> None:
    repeated = joined(*[session.training.select(np.arange(10))] * 4)
    with pytest.raises(UnsafeError, match=r"10 different poses among 40 fixes .*\(fewer than 19 are refused\)"):
        identify(session.rig, TEXT, repeated)


def test_what_is_not_there_is_refused_by_name(session: Session) -> None:
    with pytest.raises(ValueError, match="method 'oracle' is not available; available: default, pde-paper, km"):
        identify(session.rig, TEXT, session.training, method="oracle")
    with pytest.raises(ValueError, match="method 'km' takes no effects"):
        identify(session.rig, TEXT, session.training, method="km", effects="angle_scale@theta1")
    with pytest.raises(ValueError, match="effect 'witchcraft' is unknown; there are"):
        calibrate(session.rig, TEXT, session.training.select(np.arange(5)), effects="witchcraft@theta1")


@pytest.mark.long
def test_a_residual_is_not_used_for_a_prism_it_never_saw(session: Session) -> None:
    rows = session.training.select(session.training.prism != "r")
    biased = replace(rows, position_mm=rows.position_mm + 30.0 * np.sin(rows.joints["L3"] / 300.0)[:, None])
    model = train_residual(replace(session.model, excess_sigma_mm=50.0), biased, kind="rbfn")
    assert model.residual is not None
    correction = Predictor.of(model).correction(session.held_out)[0]
    unseen = session.held_out.prism == "r"
    assert np.all(correction[unseen] == 0.0)
    assert np.abs(correction[~unseen]).max() > 5.0
    assert any("not trained on prism r" in w for w in model_warnings(model, session.held_out))


@pytest.mark.long
def test_readings_beyond_limits_and_corrections_beyond_tolerances_are_named(session: Session) -> None:
    joints = session.training.joints
    shifted = {**joints, "theta5": joints["theta5"] + 1.5, "theta8": joints["theta8"] + 3.0}
    model = identify(session.rig, TEXT, replace(session.training, joints=shifted))
    assert any(w.startswith("theta8: ") and "beyond its limits -20 .. 15 deg" in w for w in model.warnings)
    assert any(re.match(r"row8.theta is -[23]\.\d\d deg off the rig file, 1\d build tol", w) for w in model.warnings)
    assert any(re.match(r"corrected by more than 4 build tolerances: row5.theta \(\+", w) for w in model.warnings)


def turned(observations: Observations, joint: str, degrees: float) -> Observations:
    return replace(observations, joints={**observations.joints, joint: observations.joints[joint] + degrees})


@pytest.mark.long
def test_an_encoder_mounted_the_other_way_round_is_found_as_built_and_refused_otherwise(session: Session) -> None:
    training, held_out = (turned(o, "theta7", 180.0) for o in (session.training, session.held_out))
    with pytest.raises(UnsafeError, match="--prior as-built"):
        identify(session.rig, TEXT, training)
    model = identify(session.rig, TEXT, training, prior="as-built")
    assert rms(evaluate(model, held_out).errors_mm["geometric"]) < 6.0
    assert any(w.startswith("row7.theta is ") and "deg from the rig file" in w for w in model.warnings)


@pytest.mark.long
def test_two_encoders_mounted_turned_are_found_as_built(session: Session) -> None:
    training, held_out = (
        turned(turned(o, "theta5", 90.0), "theta7", -180.0) for o in (session.training, session.held_out)
    )
    model = identify(session.rig, TEXT, training, prior="as-built")
    assert rms(evaluate(model, held_out).errors_mm["geometric"]) < 6.0


@pytest.mark.long
def test_a_zero_that_is_far_off_is_refused_with_the_way_out(session: Session) -> None:
    with pytest.raises(UnsafeError, match="--prior as-built"):
        identify(session.rig, TEXT, turned(session.training, "theta7", 20.0))
    assert not any("fit badly" in w for w in session.model.warnings)


@pytest.mark.long
def test_a_fit_that_leaves_out_a_whole_prism_is_refused(session: Session) -> None:
    position = session.training.position_mm.copy()
    position[session.training.prism == "s"] += [0.0, 900.0, 1300.0]
    with pytest.raises(UnsafeError, match=r"leave out \d+ of the 62 fixes of prism 's'"):
        identify(session.rig, TEXT, replace(session.training, position_mm=position))


@pytest.mark.long
def test_a_fit_of_half_of_the_data_is_refused(session: Session) -> None:
    position = session.training.position_mm.copy()
    wrong = np.random.default_rng(6).permutation(len(position))[:100]
    position[wrong] += np.random.default_rng(7).normal(0.0, 4000.0, (100, 3))
    with pytest.raises(UnsafeError, match=r"leave out \d+ of 250 fixes, so it describes only a part of the data"):
        identify(session.rig, TEXT, replace(session.training, position_mm=position))
