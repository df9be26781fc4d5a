"""The public face: its page runs, its names are those that the commands use, and a store gives frames."""

import doctest
import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import polars as pl
import pytest

import rigcal
from calibration.rig.description import Rig, shipped_rig

ROOT = Path(__file__).parents[2]


@pytest.mark.long
def test_every_line_of_the_page_runs() -> None:
    """In a process of its own: doctest takes the trace function that measures coverage here."""
    page = ROOT / "docs" / "how-to" / "notebook.md"
    assert len(doctest.DocTestParser().get_examples(page.read_text())) > 15
    done = subprocess.run(
        [sys.executable, "-m", "doctest", str(page)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


def test_every_public_name_is_documented_and_there() -> None:
    for name in rigcal.__all__:
        assert getattr(rigcal, name).__doc__, name
    assert set(rigcal.__all__) >= {"Rig", "Observations", "Model", "calibrate", "find_gap", "plan", "open_store"}


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
    rows = rigcal.Observations.from_csv(str(ROOT / "tests" / "data" / "ur10_random_poses.csv"), rig)
    with pytest.raises(ValueError, match=r"Rig\.read"):
        rigcal.calibrate(made, rows)


@pytest.mark.parametrize("library", [pd, pl])
def test_observations_come_from_data_frames(library: object) -> None:
    path, rig = ROOT / "tests" / "data" / "ur10_random_poses.csv", rigcal.Rig.read("ur10")
    frame = pd.read_csv(path) if library is pd else pl.read_csv(path)
    rows = rigcal.Observations.from_frame(frame, rig)
    expected = rigcal.Observations.from_csv(path, rig)
    assert np.array_equal(rows.position_mm, expected.position_mm)
    assert all(np.array_equal(rows.joints[name], expected.joints[name]) for name in rig.joint_names)
