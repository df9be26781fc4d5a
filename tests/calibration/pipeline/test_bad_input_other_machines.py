"""Mistakes that only machines of another build, with several prisms and set-ups, can bring: each is named."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from calibration.errors import UnsafeError
from calibration.observations import Observations
from calibration.pipeline.calibrate import identify
from calibration.rig.description import Rig, parse_rig
from simulators.rig.truth import RigTruth
from tests.calibration.pipeline.test_bad_input import Change, exchanged, scaled
from tests.calibration.pipeline.test_other_machines import RIGS, simulated


@cache
def machine(name: str, *setups: str) -> tuple[Rig, str, Observations]:
    """A rig, its text, and fixes of all prisms in 40 poses at every set-up."""
    text = (RIGS / f"{name}.toml").read_text(encoding="utf-8")
    rig = parse_rig(text, f"{name}.toml")
    return rig, text, simulated(RigTruth(rig, 1), 40, 1, setups)[0]


def moved(which: Callable[[Observations], np.ndarray], place: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Positions of some rows changed."""
    return lambda o: replace(o, position_mm=np.where(which(o)[:, None], place(o.position_mm), o.position_mm))


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "setups", "change", "words"),
    [
        # One prism of several shows the joint; it is no more than an outlier's share of the data.
        ("torso", ("west", "east"), scaled(right2=-1.0), "right2 runs the other way"),
        ("torso", ("west", "east"), exchanged("right1", "right2"), "right1_deg and right2_deg are exchanged"),
        # Each alone is a mirror image, both are half a turn.
        ("gantry", ("",), scaled(X=-1.0, Y=-1.0), "X runs the other way and Y runs the other way"),
        # Two of them explain a part, and a part is no answer.
        ("arm7", ("",), scaled(j1=-1.0, j2=-1.0, j3=-1.0), "j1 runs the other way and j2 runs the other way and j3"),
        # Turned j2 would be beyond its limits.
        (
            "arm7",
            ("",),
            scaled(j1=-1.0),
            "do not match: j1 runs the other way: with that corrected, .* or j2 reads 180 deg off",
        ),
        # A spindle turns often: its readings are many radians.
        ("levers", ("",), scaled(spindle=math.pi / 180.0), "spindle_deg is in radians"),
        # The distance between set-ups is no evidence of the size of the machine.
        ("torso", ("west", "east"), lambda o: replace(o, position_mm=o.position_mm / 1e3), "the positions are in m:"),
        ("arm7", ("",), lambda o: replace(o, position_mm=o.position_mm * 1e3), "the positions are in micrometres"),
        (
            "torso",
            ("west", "east"),
            moved(lambda o: o.setup == "east", lambda mm: mm / 1e3),
            "leave out .* fixes of set-up 'east': check unit",
        ),
        (
            "torso",
            ("west", "east"),
            moved(lambda o: o.setup == "east", lambda mm: mm * [1.0, -1.0, 1.0]),
            "leave out .* fixes of set-up 'east': .* order and sign",
        ),
        (
            "torso",
            ("west", "east"),
            lambda o: replace(o, joints={**o.joints, "right2": np.full(len(o), 10.0)}),
            "right2 never moved",
        ),
    ],
)
@pytest.mark.slow
def test_a_mistake_is_refused_by_its_name(name: str, setups: tuple[str, ...], change: Change, words: str) -> None:
    rig, text, training = machine(name, *setups)
    with pytest.raises(UnsafeError, match=words):
        identify(rig, text, change(training))


@pytest.mark.long
def test_outliers_that_one_setup_has_are_said_to_be_of_it() -> None:
    rig, text, training = machine("torso", "west", "east")
    stood = 90  # of the rows of east, then the station moved
    rows = np.flatnonzero(training.setup == "east")[stood:]
    position = training.position_mm.copy()
    position[rows] += [35.0, 0.0, 0.0]
    model = identify(rig, text, replace(training, position_mm=position), effects="none")
    assert any("of them are of set-up 'east': did the station move?" in w for w in model.warnings)


def test_a_zero_set_anew_is_named_and_passes_for_no_effect() -> None:
    rig, text, training = machine("torso", "west", "east")
    off = replace(training, joints={**training.joints, "yaw": training.joints["yaw"] + 10.0})
    model = identify(rig, text, off)
    assert model.effects == ()
    beyond_limits, zero = model.warnings
    assert beyond_limits.startswith("yaw: ")
    assert zero.startswith("row4.theta is -10.04 deg off the rig file, 33 build tolerances, so it was not held to them")
