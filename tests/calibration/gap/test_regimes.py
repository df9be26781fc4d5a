"""Effects that act in a part of the data are named with the part, and machines that break are two machines."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from calibration.gap.result import GapResult
from calibration.model.files import model_from_files, model_to_files
from calibration.model.prediction import Predictor
from calibration.observations import Observations, parse_observations
from calibration.pipeline.find_gap import find_gap
from daemon.rig_files import load_rig
from simulators.blind.cases import draw
from simulators.blind.cells import Cell

pytestmark = pytest.mark.long


SOURCE = load_rig("swdt82")


def drawn(kind: Literal["regime", "null"], size: float, seed: int) -> Observations:
    case = draw(SOURCE.rig, Cell(kind, (), size, "wide", "fine", seed))
    assert case is not None
    return parse_observations(case.train.encode(), SOURCE.rig, "case.csv")


@pytest.fixture(scope="module")
def soft() -> tuple[GapResult, Observations]:
    """A joint that gives way beyond 32 deg of its own angle alone."""
    rows = drawn("regime", 6.0, 2092)
    return find_gap(SOURCE.rig, SOURCE.text, rows), rows


def test_an_effect_beyond_an_angle_is_named_with_the_angle(soft: tuple[GapResult, Observations]) -> None:
    (effect,) = soft[0].effects
    assert (effect.family, effect.where) == ("joint_compliance", "theta4")
    assert effect.regime is not None
    assert (effect.regime.variable, effect.regime.above) == ("theta4_deg", True)
    assert effect.regime.border == pytest.approx(32.1, abs=7.4)
    assert "only where theta4_deg is above 3" in effect.form


def test_it_does_nothing_in_the_other_rows_also_in_a_model_that_was_read_again(
    soft: tuple[GapResult, Observations],
) -> None:
    gap, rows = soft
    model = model_from_files(model_to_files(gap.model))
    without = Predictor.of(replace(model, effects=()))
    moved = np.linalg.norm(Predictor.of(model).effects_mm(rows) - without.effects_mm(rows), axis=1)
    assert model.effects[0].regime is not None
    inside = rows.joints["theta4"] > model.effects[0].regime.border
    assert (moved[~inside] < 1e-9).all()
    assert (moved[inside] > 1e-3).mean() > 0.9


def test_without_times_the_border_is_a_row_and_later_rows_are_as_the_last() -> None:
    rows = drawn("regime", 6.0, 2082)
    gap = find_gap(SOURCE.rig, SOURCE.text, rows)
    (effect,) = gap.effects
    assert effect.regime is not None
    assert (effect.family, effect.regime.variable, effect.regime.above) == ("joint_compliance", "row", True)
    assert effect.regime.border == pytest.approx(172.5, abs=25.0)
    later = Predictor.of(gap.model).effects_mm(rows)  # rows of another file: the machine as it is now
    now = Predictor.of(gap.model).effects_mm(rows.numbered())
    assert np.abs(later - now)[198:].max() < 1e-9
    assert np.abs(later - now)[:147].max() > 1.0


def test_a_machine_that_is_another_from_an_instant_on_is_found_and_told() -> None:
    first, second = (drawn("null", 0.0, seed) for seed in (1945, 1963))
    rows = joined(first.select(np.arange(100)), second)
    gap = find_gap(SOURCE.rig, SOURCE.text, rows)
    assert gap.machine_break is not None
    assert (gap.verdict, gap.effects) == ("unidentified", ())
    assert gap.machine_break.before == 100
    assert "after time_s = " in (gap.description or "")
    assert gap.as_dict()["break"] == gap.machine_break.as_dict()


@pytest.mark.parametrize("has_times", [False, True], ids=["no row has a time", "one row has none"])
def test_a_base_that_moved_far_in_rows_without_times_is_a_break_at_its_row(*, has_times: bool) -> None:
    rows = drawn("null", 0.0, 1945)
    moved_mm = np.where(np.arange(len(rows)) < len(rows) // 2, 0.0, 300.0)
    extra = {name: column for name, column in rows.extra.items() if name != "time_s"}
    if has_times:
        extra["time_s"] = np.where(np.arange(len(rows)) == 8, np.nan, rows.extra["time_s"])
    rows = replace(rows, position_mm=rows.position_mm + moved_mm[:, None] * [1.0, 0.0, 0.0], extra=extra)
    gap = find_gap(SOURCE.rig, SOURCE.text, rows)
    assert gap.machine_break is not None
    assert (gap.machine_break.variable, gap.machine_break.border) == ("row", len(rows) // 2 - 0.5)
    assert "column setup" in (gap.description or "")


def test_one_machine_has_no_break() -> None:
    gap = find_gap(SOURCE.rig, SOURCE.text, drawn("null", 0.0, 1945))
    assert (gap.verdict, gap.machine_break) == ("none", None)


def joined(a: Observations, b: Observations) -> Observations:
    """One file of two machines, the second ten minutes after the first."""
    extra = {name: np.concatenate([a.extra[name], b.extra[name]]) for name in a.extra if name in b.extra}
    later = a.extra["time_s"].max() + 600.0 - b.extra["time_s"].min()
    extra["time_s"] = np.concatenate([a.extra["time_s"], b.extra["time_s"] + later])
    return replace(
        a,
        prism=np.concatenate([a.prism, b.prism]),
        joints={name: np.concatenate([a.joints[name], b.joints[name]]) for name in a.joints},
        position_mm=np.concatenate([a.position_mm, b.position_mm]),
        sigma_mm=np.concatenate([a.sigma_mm, b.sigma_mm]),
        setup=np.concatenate([a.setup, b.setup]),
        session=np.concatenate([a.session, b.session]),
        pose=np.array([str(number) for number in range(len(a) + len(b))]),
        extra=extra,
        row_numbers=None,
        place="row",
    )
