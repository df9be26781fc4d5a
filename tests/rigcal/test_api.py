"""The public face: its page runs, its names are those that the commands use, and a store gives frames."""

import importlib
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import polars as pl
import pytest

import rigcal
from calibration.rig.description import Rig, shipped_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.daemon.support.sessions import Rig as SimulatedRig
from tests.daemon.support.sessions import controlled
from tests.simulated.observations import simulate_observations

ROOT = Path(__file__).parents[2]
FIXES = ROOT / "tests" / "data" / "ur10_random_poses.csv"


@pytest.mark.long
def test_every_line_of_the_page_runs(tmp_path: Path) -> None:
    """In a process of its own: doctest takes the trace function that measures coverage here."""
    page = ROOT / "docs" / "how-to" / "notebook.md"
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    (tmp_path / "rigcal-sim").mkdir()
    simulated = SimulatedRig(tmp_path / "rigcal-sim" / "rigcal.sqlite")
    simulated.say("setup_new", id="S1", instrument="GTS-905A")
    controlled(simulated)
    simulated.store.close()
    done = subprocess.run(
        [sys.executable, "-m", "doctest", str(page)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout


def test_no_code_of_the_page_is_left_out_by_doctest() -> None:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "how-to" / "notebook.md").read_text(), re.DOTALL)
    assert len(blocks) > 5
    for block in blocks:
        assert block.startswith(">>> "), block


def test_every_public_name_is_documented_and_there() -> None:
    for name in rigcal.__all__:
        assert getattr(rigcal, name).__doc__, name
    results = {
        "Evaluation",
        "GapResult",
        "Inverse",
        "PosePlan",
        "Prediction",
        "Store",
        "FittedEffect",
        "ParameterEstimate",
    }
    errors = {"CalibrationError", "DataError", "ModelError", "RigError", "StoreError", "UnsafeError"}
    entries = {"Rig", "Observations", "Model", "calibrate", "find_gap", "plan", "open_store", "__version__"}
    assert set(rigcal.__all__) == entries | results | errors


def test_the_commands_call_the_functions_of_the_face() -> None:
    face = importlib.import_module("rigcal.calibration_api")
    for module, names in {
        "daemon/cli/commands/calibrate.py": ["calibration.pipeline.calibrate"],
        "daemon/cli/commands/gap.py": ["calibration.pipeline.find_gap"],
        "daemon/cli/commands/plan.py": ["calibration.design.planning"],
        "daemon/cli/commands/predict.py": ["calibration.model.prediction"],
        "daemon/cli/commands/inverse.py": ["calibration.model.inverse"],
        "daemon/cli/commands/model.py": ["calibration.export.formats"],
    }.items():
        command, own = (ROOT / module).read_text(), Path(str(face.__file__)).read_text()
        for name in names:
            assert f"from {name} import" in command, (module, name)
            assert f"from {name} import" in own, name


def test_a_rig_that_no_text_describes_is_refused() -> None:
    rig = shipped_rig("ur10")
    made = Rig.model_validate(rig.model_dump(by_alias=True))
    rows = rigcal.Observations.from_csv(str(FIXES), rig)
    with pytest.raises(ValueError, match=r"Rig\.read"):
        rigcal.calibrate(made, rows)


@pytest.mark.long
@pytest.mark.parametrize(
    ("call", "why"),
    [
        (
            lambda rig, rows: rigcal.calibrate(rig, rows, prior="zz"),
            "prior: 'zz' is unknown; give one of recalibration",
        ),
        (lambda rig, rows: rigcal.calibrate(rig, rows, residual="zz"), "residual: 'zz' is unknown"),
        (lambda rig, rows: rigcal.find_gap(rig, rows, families=["zz"]), "families: 'zz' is unknown; give one of"),
        (lambda rig, _: rigcal.plan(rig, 0), "poses is 0; give 1 or more"),
        (lambda rig, _: rigcal.plan(rig, 3, station_mm=[1.0, 2.0]), "three finite numbers"),
        (lambda rig, _: rigcal.plan(rig, 3, station_mm=[1.0, 2.0, float("nan")]), "three finite numbers"),
        (lambda rig, _: rigcal.plan(rig, 3, separate=["zz@q1"]), "separate: 'zz' is unknown"),
    ],
    ids=["prior", "residual", "family", "no pose", "two numbers", "no number", "effect"],
)
def test_a_wrong_argument_is_said_in_a_sentence(call: Callable[..., object], why: str) -> None:
    rig = rigcal.Rig.read("ur10")
    rows = rigcal.Observations.from_csv(FIXES, rig)
    with pytest.raises(ValueError, match=re.escape(why)):
        call(rig, rows)


def test_a_hidden_effect_is_found_and_the_model_with_it_is_nearer_to_held_out_fixes() -> None:
    rig = rigcal.Rig.read("swdt82")
    machine = RigTruth(rig, 1, effects=parse_effects("backlash@theta4:width_rad=3e-3"))
    fixes, held_out = (
        rigcal.Observations.from_csv(simulate_observations(machine, poses, seed, prisms=["r", "s"]).csv_text(), rig)
        for poses, seed in ((60, 5), (30, 6))
    )
    found: rigcal.GapResult = rigcal.find_gap(rig, fixes, holdout=held_out, families=("angle_scale", "backlash"))
    assert found.verdict == "named"
    assert [(effect.family, effect.where) for effect in found.effects] == [("backlash", "theta4")]
    assert found.held_out is not None
    model = rigcal.Model(found.model)
    assert "rig swdt82: backlash@theta4" in repr(model)
    evaluation: rigcal.Evaluation = model.evaluate(held_out)
    assert evaluation.errors_mm["effects"].shape == (len(held_out), 3)
    rms_mm = {str(stage["stage"]): stage["rms_mm"] for stage in evaluation.stages()}
    assert rms_mm["effects"] == pytest.approx(found.held_out[1])
    assert rms_mm["effects"] < rms_mm["geometric"] < rms_mm["nominal"]


@pytest.mark.parametrize("library", [pd, pl])
def test_observations_come_from_data_frames(library: object) -> None:
    path, rig = FIXES, rigcal.Rig.read("ur10")
    frame = pd.read_csv(path) if library is pd else pl.read_csv(path)
    rows = rigcal.Observations.from_frame(frame, rig)
    expected = rigcal.Observations.from_csv(path, rig)
    assert np.array_equal(rows.position_mm, expected.position_mm)
    assert all(np.array_equal(rows.joints[name], expected.joints[name]) for name in rig.joint_names)


# ---- arguments of a wrong type ---------------------------------------------------------------------------------------

A_RIG = "give a Rig, as from rigcal.Rig.read('ur10')"
ROWS = (
    "give Observations, as from rigcal.Observations.from_csv('fixes.csv', rig) or "
    "rigcal.Observations.from_frame(frame, rig)"
)


@pytest.mark.parametrize(
    ("call", "why"),
    [
        (lambda _, rows: rigcal.calibrate("ur10", rows), f"rig is a str; {A_RIG}"),
        (lambda rig, _: rigcal.calibrate(rig, "fixes.csv"), f"observations is a str; {ROWS}"),
        (lambda rig, _: rigcal.calibrate(rig, pd.read_csv(FIXES)), f"observations is a DataFrame; {ROWS}"),
        (
            lambda rig, rows: rigcal.calibrate(rig, rows, effects=["backlash"]),
            "effects is a list; give 'auto', 'none', or one str of effects",
        ),
        (lambda rig, rows: rigcal.calibrate(rig, rows, seed="1"), "seed is a str; give an int, 0 or more"),
        (lambda _, rows: rigcal.find_gap("ur10", rows), f"rig is a str; {A_RIG}"),
        (lambda rig, _: rigcal.find_gap(rig, None), f"observations is None; {ROWS}"),
        (lambda rig, rows: rigcal.find_gap(rig, rows, holdout="fixes.csv"), f"holdout is a str; {ROWS}"),
        (
            lambda rig, rows: rigcal.find_gap(rig, rows, families="backlash"),
            "families is a str; give a list, as ['backlash']",
        ),
        (lambda _, __: rigcal.plan("ur10", 5), f"rig is a str; {A_RIG}"),
        (lambda rig, _: rigcal.plan(rig, "5"), "poses is a str; give the number of poses, an int"),
        (
            lambda rig, _: rigcal.plan(rig, 5, model="model"),
            "model is a str; give a Model, as from rigcal.Model.load('model')",
        ),
        (
            lambda rig, _: rigcal.plan(rig, 5, separate="backlash@q1"),
            "separate is a str; give a list, as ['backlash@q1']",
        ),
        (lambda _, __: rigcal.Observations.from_csv(FIXES, "ur10"), f"rig is a str; {A_RIG}"),
        (
            lambda rig, _: rigcal.Observations.from_csv(pd.read_csv(FIXES), rig),
            "path_or_text is a DataFrame; give the path of a CSV file, or its text; rigcal.Observations.from_frame "
            "reads a data frame",
        ),
        (lambda _, __: rigcal.Observations.from_frame(pd.read_csv(FIXES), "ur10"), f"rig is a str; {A_RIG}"),
        (
            lambda rig, _: rigcal.Observations.from_frame(FIXES.read_text(), rig),
            "frame is a str; give a data frame of pandas or polars, as pd.DataFrame(columns); "
            "rigcal.Observations.from_csv reads a file",
        ),
        (lambda _, __: rigcal.Model("model"), "data is a str; give the model of a GapResult; rigcal.Model.load("),
    ],
    ids=[
        "calibrate a name", "calibrate a path", "calibrate a frame", "effects", "seed", "gap of a name",
        "gap of nothing", "holdout", "families", "plan of a name", "poses", "model", "separate", "file of a name",
        "file that is a frame", "frame of a name", "frame that is a text", "path as model",
    ],
)  # fmt: skip
def test_an_argument_of_a_wrong_type_is_refused_with_how_to_get_the_right_one(
    call: Callable[..., object], why: str
) -> None:
    rig = rigcal.Rig.read("ur10")
    with pytest.raises(TypeError, match=f"^{re.escape(why)}"):
        call(rig, rigcal.Observations.from_csv(FIXES, rig))


def test_a_model_refuses_a_data_frame_with_how_to_make_observations_of_it() -> None:
    rig, frame = rigcal.Rig.read("ur10"), pd.read_csv(FIXES)
    fixes = rigcal.Observations.from_frame(frame.iloc[::20], rig)
    model = rigcal.calibrate(rig, fixes, effects="none", residual="none")
    for method, name in (
        (model.predict, "observations"),
        (model.warnings_for, "observations"),
        (model.evaluate, "observations"),
        (model.inverse, "targets"),
    ):
        with pytest.raises(TypeError, match=f"^{re.escape(f'{name} is a DataFrame; {ROWS}')}$"):
            method(frame)


def test_numbers_of_numpy_are_numbers() -> None:
    rig = rigcal.Rig.read("ur10")
    assert len(rigcal.plan(rig, np.int64(3), seed=np.int64(1)).rows) == 3


# ---- what a notebook displays ----------------------------------------------------------------------------------------


def test_a_rig_is_displayed_in_one_line() -> None:
    rig = rigcal.Rig.read("swdt82")
    assert repr(rig) == str(rig) == "Rig('swdt82', 9 joints, 4 prisms)"
    assert repr(rigcal.Rig.read("ur10")) == "Rig('ur10', 6 joints, 1 prism)"


def test_observations_are_displayed_in_one_line_without_what_they_do_not_have() -> None:
    rig = rigcal.Rig.read("ur10")
    rows = rigcal.Observations.from_csv(FIXES, rig)
    assert repr(rows) == "Observations(2773 fixes of 1 prism)"
    assert repr(rows.select(np.arange(1))) == "Observations(1 fix of 1 prism)"


def test_a_pose_of_two_sessions_is_displayed_as_two_poses() -> None:
    rig = rigcal.Rig.read("ur10")
    frame = pd.read_csv(FIXES).head(4).assign(pose=["1", "1", "2", "1"], session=["a", "a", "a", "b"])
    rows = rigcal.Observations.from_frame(frame, rig)
    assert repr(rows) == "Observations(4 fixes of 1 prism, 3 poses, 2 sessions)"
