"""A model for other programs: what it says, and how well its grid stands for it."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice
from calibration.effects.library import library, parse_effects
from calibration.errors import DataError
from calibration.export import formats as folder
from calibration.export.correction_grid import Machine, correction_grid, interpolated, trained_ranges
from calibration.export.formats import chosen_formats, export_files, formats
from calibration.export.formats.calibration_json import document
from calibration.export.model_export import Export
from calibration.kinematics.chain import Chain, Placement
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Observations
from daemon.cli.main import main
from tests.calibration.conftest import Session, rms


def test_the_document_holds_every_parameter_with_its_unit_and_error(session: Session) -> None:
    told = json.loads(json.dumps(document(session.model), allow_nan=False))
    parameters = {p["name"]: p for p in told["parameters"]}
    assert len(parameters) == sum(p.kind != "base" for p in session.model.parameters)
    length = parameters["row5.a"]
    assert (length["unit"], length["nominal"]) == ("mm", 5000.0)
    assert length["value"] == pytest.approx(length["nominal"] + length["correction"])
    assert 0.0 < length["standard_error"] < 6.0
    assert told["provenance"]["data_sha256"] == session.model.provenance["data_sha256"]
    assert told["expected_accuracy"]["rms_mm"] > 0.0


def test_the_documents_parameters_and_base_are_the_models_kinematics(session: Session) -> None:
    """Whoever puts the values of the document into the row convention gets the model's positions."""
    told = json.loads(json.dumps(document(session.model)))
    (base,) = told["bases"]
    chain = Chain(session.rig, {"": Placement(np.array(base["rotation"]), np.array(base["translation_mm"]))})
    corrections = {p["name"]: p["correction"] for p in told["parameters"]}
    x = np.array([corrections.get(p.name, 0.0) for p in chain.parameters])
    rows = session.held_out.select(np.arange(20))
    np.testing.assert_allclose(
        chain.positions_mm(x, chain.bind(rows)), Predictor.of(session.model).geometric_mm(rows), rtol=0, atol=1e-6
    )


def test_the_grid_interpolated_linearly_is_close_to_the_model(session: Session) -> None:
    grid = correction_grid(session.model, ("r",), 20_000, np.random.default_rng(0))
    assert len(grid.readings) <= 20_000
    size = rms(grid.corrected_mm["r"] - grid.nominal_mm["r"])
    assert grid.rms_mm < 0.15 * size, "what is left of the correction by drawings alone"
    coarse = correction_grid(session.model, ("r",), 2_000, np.random.default_rng(0))
    assert grid.rms_mm < 0.7 * coarse.rms_mm, "more nodes come closer"
    correction_mm = grid.corrected_mm["r"] - grid.nominal_mm["r"]
    at_nodes = interpolated(grid.nodes, correction_mm, grid.readings[::977])
    np.testing.assert_allclose(at_nodes, correction_mm[::977], atol=1e-9)


def model_with(session: Session, effects: str) -> CalibratedModel:
    """The session's model with effects of their plausible sizes."""
    model, rows = session.model, session.held_out
    context = EffectContext(model.chain, model.values, replace(rows, extra={"time_s": np.arange(len(rows)) * 10.0}))
    found = []
    for name, where in parse_effects(effects, session.rig):
        family = library()[name]
        settings = family.variants(context, where)[-1]
        sigma = np.array([c.sigma for c in family.coefficients(context, where, settings)])
        found.append(Choice(name, where, settings).fitted(context, sigma, 0.1 * sigma))
    covariance = np.zeros((len(model.values) + sum(len(effect.coefficients) for effect in found),) * 2)
    return replace(model, effects=tuple(found), covariance=covariance)


def test_what_fixes_err_by_and_how_the_base_moved_is_not_in_the_grid(session: Session) -> None:
    erring = model_with(session, "prism_constant@station,station_scale@station,base_settlement@base")
    wanted, found = (correction_grid(model, ("r",), 512, np.random.default_rng(0)) for model in (session.model, erring))
    np.testing.assert_allclose(found.corrected_mm["r"], wanted.corrected_mm["r"], rtol=0.0, atol=1e-6)


def test_the_grid_is_of_the_machine_after_all_that_jumped_and_says_what_it_lacks(session: Session) -> None:
    jumped = model_with(session, "transducer_index_jump@L2")
    grid = correction_grid(jumped, ("r",), 512, np.random.default_rng(0))
    jump_mm = jumped.effects[0].coefficients[0].value
    n = len(grid.readings)
    joints = dict(zip(session.rig.joint_names, grid.readings.T, strict=True))
    joints["L2"] = joints["L2"] + jump_mm
    empty, nothing = np.full(n, ""), np.full((n, 3), np.nan)
    true = Predictor.of(session.model).base_mm(
        Observations(np.full(n, "r"), joints, nothing, nothing, empty, empty, empty)
    )
    np.testing.assert_allclose(grid.corrected_mm["r"], true, rtol=0.0, atol=1e-6)
    assert grid.lacking == ()
    loose = model_with(session, "backlash@theta4")
    assert correction_grid(loose, ("r",), 512, np.random.default_rng(0)).lacking == loose.effects


def test_what_the_grid_lacks_counts_in_the_error_that_is_said_of_it(session: Session) -> None:
    stiff, loose = session.model, model_with(session, "backlash@theta4")
    (coefficient,) = loose.effects[0].coefficients
    wide = replace(loose.effects[0], coefficients=(replace(coefficient, value=0.01),))
    loose = replace(loose, effects=(wide,), values=np.append(stiff.values, 0.01))
    without, found = (Export(model, "", ("r",)).left_out_of_grid for model in (stiff, loose))
    (form,) = chosen_formats(["grid"])
    assert form.left_out(Export(loose, "", ("r",))) == found
    assert (*without.parts, "backlash@theta4") == found.parts
    poses = np.random.default_rng(1).uniform(*trained_ranges(loose), (2_000, len(session.rig.joint_names)))
    machine = Machine(loose, 0)
    ends = [machine.corrected_mm("r", poses, {"theta4_dir": np.full(2_000, side)}) for side in (-1.0, 1.0)]
    play_mm = np.sqrt((((ends[1] - ends[0]) / 2) ** 2).sum(axis=1).mean())
    assert play_mm > 2.0 * without.rms_mm
    assert found.rms_mm == pytest.approx(math.hypot(play_mm, without.rms_mm), rel=0.1)
    (warning,) = (text for text in Export(loose, "", ("r",)).summary["warnings"] if "backlash" in text)
    assert warning.startswith("corrections.csv leaves out backlash@theta4, which needs more than joint values")


def test_nodes_span_what_the_model_was_trained_on_and_joints_that_matter_get_more(session: Session) -> None:
    grid = correction_grid(session.model, ("w",), 2_000, np.random.default_rng(0))
    for name, nodes in grid.nodes.items():
        assert (nodes[0], nodes[-1]) == session.model.coverage.ranges[name]
        assert (np.diff(nodes) > 0).all()
    finer = {name for name, nodes in grid.nodes.items() if len(nodes) > 2}
    assert finer, "more than the ends alone"
    assert finer <= {"theta1", "theta3"}, "all that moves w"
    assert 0.5 < grid.reachable.mean() <= 1.0


def test_a_grid_has_no_more_nodes_than_bring_its_error_under_a_tenth(session: Session) -> None:
    grid = correction_grid(session.model, ("w",), 20_000, np.random.default_rng(0))
    assert grid.rms_mm <= 0.1 * grid.correction_rms_mm
    assert not grid.is_coarse
    assert len(grid.readings) < 2_000
    few = correction_grid(session.model, ("r",), 512, np.random.default_rng(0))
    assert few.is_coarse, "the nine joints of r need more"


def test_a_joint_that_stood_still_in_training_has_nodes_around_its_place(session: Session) -> None:
    ranges = dict(session.model.coverage.ranges) | {"L2": (700.0, 700.0)}
    model = replace(session.model, coverage=replace(session.model.coverage, ranges=ranges))
    assert correction_grid(model, ("r",), 600, np.random.default_rng(0)).nodes["L2"].tolist() == [699.5, 700.5]


def test_what_makes_no_grid_is_refused(session: Session) -> None:
    with pytest.raises(DataError, match="no prism 'x'"):
        correction_grid(session.model, ("x",), 2_000, np.random.default_rng(0))
    with pytest.raises(DataError, match="make 512 poses"):
        correction_grid(session.model, ("r",), 511, np.random.default_rng(0))


PARAMETERS_TXT = """
from calibration.export.model_export import Export, Format

def content(export: Export) -> bytes:
    return "\\n".join(p.name for p in export.model.parameters).encode()


FORMAT = Format("parameters-txt", "parameters.txt", "the names of all parameters", content, is_default=True)
"""


def test_a_new_format_is_one_new_file(session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "parameters_txt.py").write_text(PARAMETERS_TXT)
    monkeypatch.setattr(folder, "__path__", [*folder.__path__, str(tmp_path)])
    shipped = {"c-header", "dh-csv", "grid", "json", "matlab", "parquet", "urdf", "xacro"}
    assert shipped | {"parameters-txt"} <= formats().keys()
    assert "the names of all parameters" in CliRunner().invoke(main, ["model", "export", "--help"]).stdout
    files = export_files(Export(session.model, "0" * 64, ("r",), 512))
    assert {"calibration.json", "corrections.csv", "parameters.txt"} <= files.keys()
    assert files["parameters.txt"].decode().split("\n") == [p.name for p in session.model.parameters]
    assert export_files(Export(session.model, ""), ["parameters-txt"]) == {"parameters.txt": files["parameters.txt"]}
    with pytest.raises(DataError, match=f"'stl' is unknown; give one of {', '.join(formats())}"):
        export_files(Export(session.model, ""), ["stl"])
    (tmp_path / "parameters_again.py").write_text(PARAMETERS_TXT)
    with pytest.raises(AssertionError, match="two formats are called parameters-txt"):
        formats()
