"""A calibration that goes without what the data show says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.observations import parse_observations
from calibration.pipeline.calibrate import identify
from daemon.rig_files import load_rig
from simulators.blind.cases import draw
from simulators.blind.cells import Cell
from tests.calibration.conftest import Session

SOURCE = load_rig("swdt82")


@pytest.mark.long
@pytest.mark.parametrize(
    ("cell", "words"),
    [
        (Cell("alias", ("base_settlement|base_step",), 1.0, "sparse", "fine", 700001), "base_step@base or base_settle"),
        (Cell("outside", ("thermal_cross",), 1.0, "sparse", "fine", 700001), "theta4 angle error = "),
        (Cell("null", (), 0.0, "sparse", "fine", 700001), ""),
    ],
)
def test_what_has_no_name_is_told(cell: Cell, words: str) -> None:
    drawn = draw(SOURCE.rig, cell)
    assert drawn is not None
    model = identify(SOURCE.rig, SOURCE.text, parse_observations(drawn.train.encode(), SOURCE.rig, "case.csv"))
    assert not model.effects
    told = [w for w in model.warnings if w.startswith(("the data require", "the kinematics leave more than noise"))]
    assert len(told) == bool(words)
    assert words in "".join(told)


def test_scatter_far_beyond_the_instruments_is_told_whatever_was_looked_for(session: Session) -> None:
    rng = np.random.default_rng(7)
    shaken = session.training.position_mm + rng.normal(scale=9.0, size=session.training.position_mm.shape)
    loud = identify(session.rig, SOURCE.text, replace(session.training, position_mm=shaken), effects="none")
    assert any("where station and readings account for" in w for w in loud.warnings)
