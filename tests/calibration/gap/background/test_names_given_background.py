"""Effects are named beside structure that no library has, and structure alone is never given a name."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.gap.background.naming import without_harmful
from calibration.gap.candidates import variants_at
from calibration.gap.joint_fit import Problem
from calibration.gap.result import GapResult
from calibration.identification.solve import solve
from calibration.observations import Observations, parse_observations
from calibration.pipeline.find_gap import find_gap
from calibration.rig.description import parse_rig
from calibration.run_settings import Run
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


@pytest.mark.long
def test_held_out_rows_gain_by_what_is_named_beside_structure() -> None:
    before, after = soft_machine().held_out or (0.0, np.inf)
    assert after < 0.8 * before


@pytest.mark.long
def test_every_name_has_a_certificate_from_rows_that_did_not_choose_it() -> None:
    for effect in soft_machine().as_dict()["effects"]:  # type: ignore[attr-defined]
        assert 0.0 <= effect["certificate_p"] < 0.05
        assert effect["places"][effect["where"]] > 0.5


@pytest.mark.long
def test_structure_alone_is_given_no_name() -> None:
    rows = simulated("", 21)
    gap = answer(replace(rows, position_mm=rows.position_mm + displacements_mm(rows)))
    assert gap.effects == ()
    assert gap.remaining_significant
    assert gap.description


@pytest.mark.long
def test_a_torso_whose_arms_share_no_joint_s_errors_has_an_answer() -> None:
    # The two prisms of a standstill have no joint of an arm in common, so nothing tells its random errors.
    path = Path(__file__).parents[3] / "rigs" / "torso.toml"
    rig = parse_rig(path.read_text(encoding="utf-8"), path.name)
    data = simulate_observations(RigTruth(rig, 3), 120, 3, noise_mm=0.3, prisms=["left", "right"])
    rows = parse_observations(data.csv_text().encode(), rig, "torso.csv")
    q = {name: np.deg2rad(values) for name, values in rows.joints.items()}
    errors_deg = {"left1": 0.1 * np.sin(q["left1"] + q["left2"]), "right2": 0.1 * np.cos(q["right1"] - q["right2"])}
    rows = replace(rows, joints={name: v + errors_deg.get(name, 0.0) for name, v in rows.joints.items()})
    gap = find_gap(rig, path.read_text(encoding="utf-8"), rows)
    assert gap.verdict != "none"
    assert {effect.where for effect in gap.effects} <= set(errors_deg)


@pytest.mark.parametrize(("share", "harmful"), [(0.1, ()), (0.25, ("zero_step@q3",))])
def test_what_makes_outliers_of_many_fixes_is_judged_with_these(share: float, harmful: tuple[str, ...]) -> None:
    data = simulate_observations(RigTruth(RIG, 11), 160, 11, noise_mm=NOISE_MM, columns={"time_s": np.arange(160.0)})
    rows = parse_observations(data.csv_text().encode(), RIG, "machine.csv")
    is_late = np.arange(160) >= 80
    is_contrary = is_late & (np.random.default_rng(1).random(160) < share)
    step_deg = np.where(is_contrary, -0.1, np.where(is_late, 0.1, 0.0))
    rows = replace(rows, joints={**rows.joints, "q3": rows.joints["q3"] - step_deg})
    solution = solve(RIG, rows, prior="recalibration", run=Run(0))
    problem = Problem(solution, rows, "recalibration", 0)
    forms = variants_at(problem.kinematics_only().context, "zero_step", "q3")
    step = min(forms, key=lambda form: abs(form.settings["time_s"] - 79.5))
    joint = problem.fit([step], solution.fit.x)
    outliers = joint.fit.weight < 0.5
    assert outliers[is_contrary].all()
    assert without_harmful(problem, joint)[1] == harmful
