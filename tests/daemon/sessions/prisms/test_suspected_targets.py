"""What ends the suspicion of a target: the operator or the joints, never the suspected target itself."""

from __future__ import annotations

import itertools
import logging
import resource

import numpy as np
import pytest

from daemon.sessions.open_session import OpenSession
from drivers.readings import EventKind, Fix, Reading, Record
from tests.daemon.sessions.prisms.test_prism_evidence import RIG, TrueRig, place_mm, texts
from tests.daemon.support.sessions import STEP_S, closed_afterwards
from tests.daemon.support.store import table

rig = closed_afterwards(TrueRig)
CONTROL_MM = (9000.0, 500.0, 2000.0)
OFF_MM = (12_000.0, -3_000.0, 0.0)  # from the prism to a reflector beside the machine
SILENT = 10**9  # steps of a station from one fix to the next


def look_at_a_reflector(rig: TrueRig, seconds: float = 2.5) -> None:
    x, y, z = rig.target_mm
    rig.target_mm = (x + OFF_MM[0], y + OFF_MM[1], z + OFF_MM[2])
    rig.live(seconds)


def pause(rig: TrueRig, seconds: float) -> None:
    rig.steps_of_fix = SILENT
    rig.live(seconds)
    rig.steps_of_fix = 1


def assert_is_suspected(rig: TrueRig, session: str, of_the_prism: int) -> None:
    assert len(rig.keeper.prism_suspicions()) == 1
    assert rig.used(session) == of_the_prism
    assert texts(rig, EventKind.LOCK_ACQUIRED) == []


@pytest.mark.parametrize("seconds", [1.5, 2.5, 20.0])
def test_a_suspected_target_stays_suspected_however_long_its_station_pauses(rig: TrueRig, seconds: float) -> None:
    session = rig.say("start", prism="r")["id"]
    rig.stand(0, "r", 2.5)
    look_at_a_reflector(rig)
    of_the_prism = rig.used(session)
    for _ in range(4):
        pause(rig, seconds)
        rig.live(3)
    assert of_the_prism > 30
    assert_is_suspected(rig, session, of_the_prism)


@pytest.mark.parametrize("poses", [1, 2])
def test_a_suspected_target_that_is_lost_and_found_again_stays_suspected(rig: TrueRig, poses: int) -> None:
    session = rig.say("start", prism="r")["id"]
    for pose in range(poses):
        rig.stand(pose, "r", 2.5)
    prism_mm = rig.target_mm
    look_at_a_reflector(rig)
    reflector_mm, of_the_prism = rig.target_mm, rig.used(session)
    for _ in range(4):
        rig.target_mm = (prism_mm[0], prism_mm[1] + 200_000.0, prism_mm[2])
        rig.live(STEP_S)
        rig.target_mm = reflector_mm
        rig.live(2.5)
    assert_is_suspected(rig, session, of_the_prism)


@pytest.mark.parametrize("degrees", [0.0, 3.0])
def test_a_suspected_target_stays_suspected_after_the_first_shot_of_a_control_point(
    rig: TrueRig, degrees: float
) -> None:
    session = rig.say("start", prism="r")["id"]
    rig.stand(0, "r", 2.5)
    look_at_a_reflector(rig)
    reflector_mm, of_the_prism = rig.target_mm, rig.used(session)
    rig.shoot("cp1", CONTROL_MM)
    rig.target_mm = reflector_mm
    rig.live(1.0)
    rig.live(1.0, theta1=degrees)
    rig.live(3.0)
    assert_is_suspected(rig, session, of_the_prism)


@pytest.mark.slow
@pytest.mark.parametrize("target", ["b", "s", "w"])
def test_another_prism_of_the_machine_stays_suspected_at_whatever_pose_it_is_found_again(
    rig: TrueRig, target: str
) -> None:
    session = rig.say("start", prism="r")["id"]
    rig.stand(0, "r", 2.5)
    rig.stand(0, target, 2.5)
    of_the_prism = rig.used(session)
    for pose in (0, 3, 6, 9):
        rig.stand(pose, target, 2.5)
        pause(rig, 2.5)
        rig.live(2.0)
        assert len(rig.keeper.prism_suspicions()) == 1
        assert rig.used(session) <= of_the_prism


@pytest.mark.parametrize(("target", "seed"), [("b", 2), ("s", 22), ("w", 23)])
def test_the_prism_counts_again_at_other_poses_that_tell_prisms_apart_only_with_what_was_seen_before(
    rig: TrueRig, target: str, seed: int
) -> None:
    half = np.array([(joint.limits[1] - joint.limits[0]) / 2 for joint in RIG.joints])
    middle = np.array([sum(joint.limits) / 2 for joint in RIG.joints])
    poses = middle + np.random.default_rng(seed).uniform(-0.09, 0.09, (9, len(half))) * half
    session = rig.say("start", prism="r")["id"]
    for pose, seen in zip(poses, ["r", target, target, *["r"] * 6], strict=True):
        pause(rig, 3.0)
        rig.values = dict(zip(RIG.joint_names, map(float, pose), strict=True))
        rig.target_mm = place_mm(seen, rig.values)
        rig.live(2.0)
    assert rig.keeper.prism_suspicions() == []
    assert rig.used(session) > 7 * 25


@pytest.mark.parametrize("off_mm", [450.0, 1500.0, 12_000.0])
def test_a_point_that_is_located_while_many_fixes_are_judged_ends_no_suspicion(rig: TrueRig, off_mm: float) -> None:
    def measured(fixes: int) -> list[Record]:
        records: list[Record] = []
        for _ in range(fixes):
            rig.clock.advance(STEP_S)
            now = rig.clock.now()
            records += [Reading(joint.name, now, rig.values[joint.name], joint.unit) for joint in RIG.joints]
            records.append(rig.fix())
        return records

    def keep(records: list[Record]) -> None:
        rig.tell(records)
        rig.store.insert_records(records)

    rig.say("start", prism="r")
    keep(measured(40))
    x, y, z = rig.target_mm
    rig.target_mm = (x + off_mm, y, z)
    (opened,) = rig.keeper._taking()
    see, seen = rig.keeper._prisms.see, itertools.count()

    def seeing(session: OpenSession, fix: Fix) -> None:
        see(session, fix)
        if next(seen) == 20:
            opened.know([(20_000.0, 20_000.0, 0.0)], opened.constants_mm)  # as a shot does in another thread

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rig.keeper._prisms, "see", seeing)
        keep(measured(40))
    keep(measured(20))
    used = [row["x_mm"] for row in table(rig.store.path, "observations") if row["excluded"] is None]
    assert len(used) >= 30
    assert max(used) - min(used) < 1.0, "of the prism alone"


def test_a_session_that_cannot_be_judged_again_for_lack_of_descriptors_keeps_its_suspicions(rig: TrueRig) -> None:
    session = rig.say("start", prism="r")["id"]
    rig.stand(0, "r", 2.5)
    look_at_a_reflector(rig)
    reflector_mm, of_the_prism = rig.target_mm, rig.used(session)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    rig.shoot("cp1", CONTROL_MM)
    (opened,) = rig.keeper._taking()
    opened.is_outdated = True  # its next fix may have done what the shot asked for already
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
    try:
        rig.target_mm = reflector_mm
        rig.live(1.0)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert len(rig.keeper.prism_suspicions()) == 1
    assert opened.is_outdated, "it is tried again"
    rig.live(3.0)
    assert not opened.is_outdated
    assert_is_suspected(rig, session, of_the_prism)


def test_a_batch_has_its_observations_although_descriptors_run_out_while_its_session_is_judged_again(
    rig: TrueRig,
) -> None:
    rig.say("start", prism="r")
    rig.stand(0, "r", 2.5)
    look_at_a_reflector(rig)
    (opened,) = rig.keeper._taking()
    opened.is_outdated = True
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    before = len(table(rig.store.path, "observations"))

    class TakesTheLast(logging.Handler):
        """Takes the last descriptors once the guards have been judged, as another thread may."""

        def emit(self, record: logging.LogRecord) -> None:
            resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))

    log, taker = logging.getLogger("daemon.sessions.prism_watch"), TakesTheLast()
    log.addHandler(taker)
    try:
        rig.live(1.0)
    finally:
        log.removeHandler(taker)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert len(table(rig.store.path, "observations")) == before + 20
    assert opened.is_outdated, "it is tried again"
    rig.live(1.0)
    assert not opened.is_outdated
    assert len(rig.keeper.prism_suspicions()) == 1


def test_the_prism_that_is_found_again_at_other_poses_counts_once_these_show_where_the_base_stands(
    rig: TrueRig,
) -> None:
    session = rig.say("start", prism="r")["id"]
    rig.stand(0, "r", 2.5)
    look_at_a_reflector(rig)
    for pose in range(4, 7):
        assert len(rig.keeper.prism_suspicions()) == 1
        rig.stand(pose, "r", 2.5)
    assert rig.keeper.prism_suspicions() == []
    assert rig.used(session) > 120
