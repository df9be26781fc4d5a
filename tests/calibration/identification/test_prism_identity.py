"""Simulated machines with all build errors: which prism a target is must follow from joints and places."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.identification.prism_identity import Misfits, PrismIdentity, Targets
from calibration.observations import Floats
from calibration.rig.description import shipped_rig
from simulators.rig.truth import RigTruth

RIG = shipped_rig("swdt82")
NAMES = RIG.prism_names
IDENTITY = PrismIdentity(RIG)
MACHINES = tuple(RigTruth(RIG, seed) for seed in range(3))


def poses(count: int, rng: np.random.Generator) -> Floats:
    return np.column_stack([rng.uniform(*joint.limits, count) for joint in RIG.joints])


def measured(machine: RigTruth, readings: Floats, prism: str, taken_for: str = "r") -> Targets:
    joints = dict(zip(RIG.joint_names, readings.T, strict=True))
    places = machine.prism_mm(prism, joints, setup="S1")
    return Targets(readings, np.full(len(readings), NAMES.index(taken_for)), places, np.zeros(len(readings)))


def misfit(found: Misfits, prism: str) -> float:
    return float(found.prism[NAMES.index(prism)])


@pytest.mark.parametrize("target", NAMES)
@pytest.mark.parametrize("known", [4, 8])
def test_one_fix_fits_its_own_prism_alone_where_others_are_known(target: str, known: int) -> None:
    rng = np.random.default_rng(known)
    for machine in MACHINES:
        for _ in range(5):
            rows = poses(known + 1, rng)
            found = IDENTITY.misfits(measured(machine, rows[:known], "r"), measured(machine, rows[known:], target))
            assert misfit(found, target) < 1.0
            assert min(misfit(found, other) for other in NAMES if other != target) > misfit(found, target)


def test_fixes_of_one_target_tell_by_themselves_which_prism_it_is() -> None:
    nothing = measured(MACHINES[0], np.empty((0, len(RIG.joints))), "r")
    rng = np.random.default_rng(1)
    for machine in MACHINES:
        found = IDENTITY.misfits(nothing, measured(machine, poses(6, rng), "s"))
        assert misfit(found, "s") < 1.0 < misfit(found, "r")
        assert found.standing > 1.0


def test_a_target_that_stands_fits_a_reflector_beside_the_machine() -> None:
    rows = poses(5, np.random.default_rng(2))
    nothing = measured(MACHINES[0], rows[:0], "r")
    stands = Targets(rows, np.zeros(5, dtype=np.intp), np.tile([3e3, 8e3, 1e3], (5, 1)), np.zeros(5))
    found = IDENTITY.misfits(nothing, stands)
    assert found.standing == 0.0
    assert misfit(found, "r") > 1.0


def test_a_wrong_name_among_targets_that_are_relied_on_shows() -> None:
    rows = poses(9, np.random.default_rng(3))
    right = measured(MACHINES[0], rows, "r")
    assert IDENTITY.own_misfits(right).max() < 1.0
    places = right.position_mm.copy()
    places[7:] = measured(MACHINES[0], rows[7:], "b").position_mm
    assert IDENTITY.own_misfits(Targets(right.readings, right.prism, places, right.slack_mm))[7:].min() > 1.0


def test_motion_excuses_what_it_can_have_caused() -> None:
    rows = poses(6, np.random.default_rng(4))
    sure = measured(MACHINES[0], rows, "r")
    off = sure.position_mm.copy()
    off[-1, 2] += 2000.0
    still = Targets(sure.readings, sure.prism, off, sure.slack_mm)
    moving = Targets(sure.readings, sure.prism, off, np.full(6, 2000.0))
    assert IDENTITY.own_misfits(still).max() > 1.0
    assert IDENTITY.own_misfits(moving).max() < 1.0
