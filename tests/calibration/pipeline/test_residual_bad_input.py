"""What a residual meets that it was not trained for: named and refused, or used without that part and said so."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from calibration.errors import DataError, ModelError, UnsafeError
from calibration.evaluation.evaluation import evaluate
from calibration.model.files import model_from_files, model_to_files
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.model.warnings import model_warnings
from calibration.observations import Floats, Observations, parse_observations
from calibration.pipeline.calibrate import identify, train_residual
from calibration.rig.description import shipped_rig
from simulators.rig.dataset import random_poses
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import Session, rig_text, rms, simulated
from tests.simulated.observations import simulate_observations

TRUTH = RigTruth(shipped_rig("swdt82"), 41)


def measured(fixes: int, seed: int) -> Observations:
    """A machine that sags with a pressure; a valve current that does nothing is recorded beside it."""
    rows, rng = simulated(TRUTH, fixes, seed), np.random.default_rng(seed)
    pressure = rng.uniform(50.0, 150.0, fixes)
    position = rows.position_mm.copy()
    position[:, 2] += 12.0 * np.sin((pressure - 100.0) / 25.0)
    signals = {"lift_bar": pressure, "lift_mA": rng.uniform(4.0, 20.0, fixes), "idle_bar": np.full(fixes, 7.0)}
    return replace(rows, position_mm=position, extra={**rows.extra, **signals})


def changed(rows: Observations, **signals: Floats | None) -> Observations:
    """Signal columns replaced, or left out where they are None."""
    extra: Mapping[str, Floats | None] = {**rows.extra, **signals}
    return replace(rows, extra={name: values for name, values in extra.items() if values is not None})


@pytest.fixture(scope="module")
def model() -> CalibratedModel:
    rows = measured(250, 41)
    found = train_residual(identify(TRUTH.rig, rig_text("swdt82"), rows, effects="none"), rows, kind="lightgbm")
    assert found.residual is not None
    return found


@pytest.fixture(scope="module")
def unseen() -> Observations:
    return measured(200, 42)


def hybrid_rms(model: CalibratedModel, rows: Observations) -> float:
    return rms(evaluate(model, rows).errors_mm["hybrid"])


def test_a_constant_column_is_no_feature_and_does_no_harm(model: CalibratedModel, unseen: Observations) -> None:
    assert model.residual is not None
    assert "lift_bar" in model.residual.signals
    assert "idle_bar" not in model.residual.signals
    np.testing.assert_array_equal(
        Predictor.of(model).predict(changed(unseen, idle_bar=np.full(200, 1e9))).position_mm,
        Predictor.of(model).predict(unseen).position_mm,
    )


def test_a_joint_that_never_moved_is_no_obstacle() -> None:
    poses = random_poses(TRUTH.rig, 150, np.random.default_rng(0)) | {"theta8": np.full(150, 3.0)}
    data = simulate_observations(TRUTH, 150, 43, poses=poses, prisms_per_pose="one", joint_noise=False)
    rows = parse_observations(data.csv_text().encode(), TRUTH.rig, "still.csv")
    still = identify(TRUTH.rig, rig_text("swdt82"), rows, effects="none")
    found = train_residual(still, rows, kind="rbfn")
    assert np.isfinite(Predictor.of(found).predict(rows).position_mm).all()


def test_too_few_fixes_or_groups_leave_the_residual_out_and_say_so(session: Session) -> None:
    few = train_residual(session.model, session.training.select(np.arange(40)))
    assert few.residual is None
    assert few.residual_reason.startswith("40 fixes in ")
    assert few.residual_reason.endswith("are too few to learn a residual from")
    one_place = replace(session.training, position_mm=np.tile(session.training.position_mm[:1], (250, 1)))
    assert train_residual(replace(session.model, outliers=()), one_place).residual is None


def test_a_signal_that_is_missing_is_named_and_done_without(model: CalibratedModel, unseen: Observations) -> None:
    without = changed(unseen, lift_bar=None)
    said = " ".join(model_warnings(model, without))
    assert "trained with lift_bar, which this data lacks" in said
    assert "the residual fades: 200 of 200 rows" in said
    assert hybrid_rms(model, without) < 1.02 * rms(evaluate(model, without).errors_mm["effects"])
    assert hybrid_rms(model, unseen) < 0.8 * rms(evaluate(model, unseen).errors_mm["effects"])


def test_single_missing_cells_cost_only_their_rows(model: CalibratedModel, unseen: Observations) -> None:
    pressure = unseen.extra["lift_bar"].copy()
    pressure[:50] = np.nan
    gappy, plain = Predictor.of(model).predict(changed(unseen, lift_bar=pressure)), Predictor.of(model).predict(unseen)
    assert "lift_bar missing in 50" in " ".join(model_warnings(model, changed(unseen, lift_bar=pressure)))
    np.testing.assert_array_equal(gappy.position_mm[50:], plain.position_mm[50:])
    assert np.isfinite(gappy.position_mm).all()
    assert (gappy.sigma_mm[:50, 2] > 1.1 * plain.sigma_mm[:50, 2]).all()


@pytest.mark.parametrize(("factor", "shift"), [(1e5, 0.0), (0.1, 0.0), (1.0, 500.0), (-1.0, 0.0)])
def test_a_shifted_sensor_or_another_unit_is_named_and_done_without(
    model: CalibratedModel, unseen: Observations, factor: float, shift: float
) -> None:
    strange = changed(unseen, lift_bar=factor * unseen.extra["lift_bar"] + shift)
    said = " ".join(model_warnings(model, strange))
    assert "lift_bar: 200 of 200 readings are outside the 5" in said
    assert "a shifted sensor, or another unit?" in said
    assert hybrid_rms(model, strange) < 1.05 * rms(evaluate(model, strange).errors_mm["effects"])


def test_a_small_shift_is_seen_in_the_rows_it_carries_out_of_range(
    model: CalibratedModel, unseen: Observations
) -> None:
    said = " ".join(model_warnings(model, changed(unseen, lift_bar=unseen.extra["lift_bar"] + 60.0)))
    assert "lift_bar: " in said
    assert "of 200 readings are outside" in said


def test_a_signal_that_matters_nothing_may_be_anything(model: CalibratedModel, unseen: Observations) -> None:
    strange = changed(unseen, lift_mA=np.full(200, 1e6))
    assert not any("lift_mA" in warning or "fades" in warning for warning in model_warnings(model, strange))
    assert hybrid_rms(model, strange) < 1.05 * hybrid_rms(model, unseen)


def test_what_is_no_number_is_refused_in_training_and_prediction(model: CalibratedModel, unseen: Observations) -> None:
    readings = unseen.joints["theta5"].copy()
    readings[17] = np.nan
    broken = replace(unseen, joints={**unseen.joints, "theta5": readings})
    for use in (
        Predictor.of(model).predict,
        lambda rows: evaluate(model, rows),
        lambda rows: train_residual(model, rows),
    ):
        with pytest.raises(DataError, match=r"theta5_deg: the reading of line 19 is not a finite number"):
            use(broken)
    with pytest.raises(DataError, match="theta5_deg"):
        identify(TRUTH.rig, rig_text("swdt82"), broken)
    nowhere = replace(unseen, position_mm=np.where(np.arange(200)[:, None] == 3, np.nan, unseen.position_mm))
    with pytest.raises(DataError, match="every row needs a measured position"):
        train_residual(model, nowhere)


def test_no_rows_are_predicted_as_no_rows(model: CalibratedModel, unseen: Observations) -> None:
    nothing = unseen.select(np.zeros(200, dtype=bool))
    assert Predictor.of(model).predict(nothing).position_mm.shape == (0, 3)
    assert model_warnings(model, nothing) == ()


def test_rows_of_another_rig_are_refused(model: CalibratedModel, ur10_random_poses: Observations) -> None:
    with pytest.raises((DataError, UnsafeError), match=r"L2|prism 'tmac'"):
        Predictor.of(model).predict(ur10_random_poses)
    with pytest.raises((DataError, UnsafeError), match=r"L2|prism 'tmac'"):
        evaluate(model, ur10_random_poses)


def test_a_model_of_another_machine_says_that_it_does_not_describe_the_data(model: CalibratedModel) -> None:
    other = simulated(RigTruth(TRUTH.rig, 99), 100, 5)
    warnings = evaluate(model, other).warnings
    assert any(w.startswith("the model does not describe this data: half of the fixes") for w in warnings)
    assert not any("does not describe" in w for w in evaluate(model, measured(100, 44)).warnings)


def sealed(files: Mapping[str, bytes]) -> dict[str, bytes]:
    """The files under a manifest that is true of them, as who edits a model on purpose would leave them."""
    listed = {
        name: {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
        for name, data in files.items()
        if name != "manifest.json"
    }
    manifest = json.loads(files["manifest.json"]) | {"files": listed}
    return {**files, "manifest.json": json.dumps(manifest).encode()}


def test_a_rig_file_that_was_exchanged_in_the_model_is_refused(model: CalibratedModel) -> None:
    files = model_to_files(model)
    other = files["rig.toml"].replace(b"sigma = 0.005", b"sigma = 0.006")
    assert other != files["rig.toml"]
    with pytest.raises(ModelError, match="is not the rig file that the model was calibrated with"):
        model_from_files(sealed({**files, "rig.toml": other}))


def arrays(
    joints: np.ndarray, poses: np.ndarray, near: np.ndarray, table: np.ndarray, signals: Sequence[str] = ()
) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, joints=joints, poses=poses, near=near, table=table, signals=np.array(signals, dtype=np.str_))
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ("missing", "lacks region.npz"),
        ("empty", "cannot be read"),
        ("text", "cannot be read"),
        ("pickled", "cannot be read"),
        ("nan", "does not match"),
        ("few joints", "does not match"),
        ("no poses", "does not match"),
        ("zero margin", "does not match"),
        ("far", "does not match"),
        ("gain", "does not match"),
        ("words", "near is an array of"),
        ("complex", "table is an array of complex128"),
        ("no signals", "does not match"),
        ("other order", "signals of the residual's region differ"),
    ],
)
def test_a_damaged_region_is_refused_with_a_sentence(model: CalibratedModel, damage: str, message: str) -> None:
    assert model.residual is not None
    files, region = model_to_files(model), model.residual.region
    joints, poses, near, table = region.joints, region.poses, np.array([region.near]), region.table
    signals = region.signals
    assert len(signals) > 1
    damaged = {
        "empty": b"",
        "text": b"not an archive",
        "pickled": arrays(joints, np.array([None, {}], dtype=object), near, table, signals),
        "nan": arrays(joints, poses, near, table * np.nan, signals),
        "few joints": arrays(joints[:, :3], poses, near, table, signals),
        "no poses": arrays(joints, poses[:0], near, table, signals),
        "zero margin": arrays(joints * [[1], [1], [0], [1], [1]], poses, near, table, signals),
        "far": arrays(joints, poses, near * 1e300, table, signals),
        "gain": arrays(joints, poses, near, table - [[0], [0], [0], [0], [9], [0]], signals),
        "words": arrays(joints, poses, np.array(["near"]), table, signals),
        "complex": arrays(joints, poses, near, table + 1j, signals),
        "no signals": arrays(joints, poses, near, table),
        "other order": arrays(joints, poses, near, table, signals[::-1]),
    }
    changed_files = {name: data for name, data in files.items() if name != "region.npz"}
    if damage != "missing":
        changed_files["region.npz"] = damaged[damage]
    with pytest.raises(ModelError, match=message) as refused:
        model_from_files(sealed(changed_files))
    assert "\n" not in str(refused.value)
    assert str(refused.value).endswith("calibrate again")


@pytest.mark.parametrize(
    ("intervals", "word"),
    [
        ({"axes": [1.6, 1.6, 1.6]}, "radius"),
        ({"axes": [1.6, 1.6], "radius": 1.4}, "axes"),
        ({"axes": [-1.0, 1.6, 1.6], "radius": 1.4}, "axes.0"),
        ({"axes": [1.6, 1.6, float("nan")], "radius": 1.4}, "axes.2"),
    ],
)
def test_damaged_intervals_are_refused_with_a_sentence(
    model: CalibratedModel, intervals: dict[str, object], word: str
) -> None:
    files = model_to_files(model)
    document = json.loads(files["model.json"]) | {"intervals": intervals}
    with pytest.raises(ModelError, match=f"intervals.{word}"):
        model_from_files(sealed({**files, "model.json": json.dumps(document).encode()}))


def test_a_model_that_is_read_again_has_the_same_doubts_and_intervals(
    model: CalibratedModel, unseen: Observations
) -> None:
    again = model_from_files(model_to_files(model))
    strange = changed(unseen, lift_bar=unseen.extra["lift_bar"] * 1e5)
    assert model_warnings(again, strange) == model_warnings(model, strange)
    assert again.intervals == model.intervals
    np.testing.assert_array_equal(
        Predictor.of(again).predict(strange).sigma_mm, Predictor.of(model).predict(strange).sigma_mm
    )
