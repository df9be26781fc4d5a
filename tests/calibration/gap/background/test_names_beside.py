"""Effects are named beside structure that no library has, and structure alone is never given a name."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.gap.result import GapResult
from calibration.observations import Observations, parse_observations
from calibration.pipeline.find_gap import find_gap
from daemon.rig_files import load_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

Floats = NDArray[np.float64]

SOURCE = load_rig("ur10")
RIG, TEXT = SOURCE.rig, SOURCE.text
NOISE_MM = 0.03


def joint_errors_deg(observations: Observations) -> dict[str, Floats]:
    """Return errors of readings that depend smoothly on two joints, as no effect of the library does."""
    q = {name: np.deg2rad(values) for name, values in observations.joints.items()}
    return {"q2": 0.012 * np.sin(q["q1"] + q["q2"]), "q3": 0.02 * np.cos(q["q3"] - q["q4"] + 0.4)}


def displacements_mm(observations: Observations) -> Floats:
    """Return (n, 3) displacements that depend smoothly on two joints each."""
    q = np.deg2rad(np.column_stack(list(observations.joints.values())))
    return 0.2 * np.column_stack(
        [np.sin(q[:, 1] + q[:, 2]), np.cos(q[:, 2] - q[:, 3] + 0.4), np.sin(q[:, 0] - q[:, 1])]
    )


def simulated(effects: str, seed: int) -> Observations:
    truth = RigTruth(RIG, seed, effects=parse_effects(effects))
    data = simulate_observations(truth, 240, seed, noise_mm=NOISE_MM)
    return parse_observations(data.csv_text().encode(), RIG, "machine.csv")


def answer(rows: Observations) -> GapResult:
    """Return the answer to two thirds of the rows; the others are held out."""
    training = np.arange(len(rows)) < 160
    return find_gap(RIG, TEXT, rows.select(training), holdout=rows.select(~training))


@cache
def soft_machine() -> GapResult:
    rows = simulated(COMPLIANCE, 11)
    errors = joint_errors_deg(rows)
    return answer(replace(rows, joints={name: v + errors.get(name, 0.0) for name, v in rows.joints.items()}))


COMPLIANCE = "joint_compliance@q2:compliance_rad_per_Nm=6e-6,joint_compliance@q3:compliance_rad_per_Nm=9e-6"


@pytest.mark.long
def test_effects_are_named_beside_structure_that_no_library_has() -> None:
    gap = soft_machine()
    assert {(e.family, e.where) for e in gap.effects} == {("joint_compliance", "q2"), ("joint_compliance", "q3")}
    assert gap.verdict == "named"
    assert gap.remaining_significant
    for effect, true in zip(sorted(gap.effects, key=lambda e: e.where), (6e-6, 9e-6), strict=True):
        assert effect.reported[0].value == pytest.approx(true, rel=0.5)


def test_held_out_rows_gain_by_what_is_named_beside_structure() -> None:
    before, after = soft_machine().held_out or (0.0, np.inf)
    assert after < 0.8 * before


def test_every_name_has_a_certificate_from_rows_that_did_not_choose_it() -> None:
    for effect in soft_machine().as_dict()["effects"]:  # type: ignore[attr-defined]
        assert 0.0 <= effect["certificate_p"] < 0.05
        assert effect["places"][effect["where"]] > 0.5


def test_structure_alone_is_given_no_name() -> None:
    rows = simulated("", 21)
    gap = answer(replace(rows, position_mm=rows.position_mm + displacements_mm(rows)))
    assert gap.effects == ()
    assert gap.remaining_significant
    assert gap.description
