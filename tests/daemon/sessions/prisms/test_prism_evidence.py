"""A session whose station follows another prism from its start, or after a control point: the joints tell."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from calibration.identification.prism_identity import PrismIdentity
from calibration.rig.description import parse_rig
from daemon.sessions.prisms.evidence import PrismEvidence, Verdict
from daemon.sessions.prisms.identity_loader import IdentityLoader
from daemon.sessions.prisms.sightings import Sighting, targets
from daemon.sessions.station_setups import Place
from drivers.readings import EventKind
from simulators.rig.truth import RigTruth
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.rig_files import ANOTHER_ZERO
from tests.daemon.support.sessions import SOURCE, Rig, closed_afterwards, disk_fails
from tests.daemon.support.store import table

RIG = SOURCE.rig
TRUTH = RigTruth(RIG, 5)
CONTROL_MM = (9000.0, 500.0, 2000.0)
POSES = np.random.default_rng(4).uniform(
    [j.limits[0] for j in RIG.joints], [j.limits[1] for j in RIG.joints], (12, len(RIG.joints))
)


def arrays(joints: Mapping[str, float]) -> dict[str, np.ndarray]:
    return {name: np.array([value]) for name, value in joints.items()}


class TrueRig(Rig):
    """A rig that stands at poses, and whose station measures where a true machine has its prisms."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.say("setup_new", id="S1", instrument="GTS-905A")

    def stand(self, pose: int, target: str, seconds: float = 2.0) -> None:
        """Drive to a pose, with the station locked on a prism of the machine."""
        self.values = dict(zip(RIG.joint_names, map(float, POSES[pose]), strict=True))
        self.target_mm = place_mm(target, self.values)
        self.live(seconds)

    def used(self, session: str) -> int:
        rows = table(self.store.path, "observations")
        return sum(row["session_id"] == session and row["excluded"] is None for row in rows)


def place_mm(target: str, values: Mapping[str, float]) -> Place:
    """Return where the true machine has a prism, in the station's frame."""
    east, north, up = TRUTH.prism_mm(target, arrays(dict(values)), setup="S1")[0]
    return float(east), float(north), float(up)


rig = closed_afterwards(TrueRig)


def texts(rig: Rig, kind: EventKind) -> list[str]:
    return [row["text"] for row in table(rig.store.path, "device_events") if row["kind"] == kind]


def hold_session(rig: TrueRig, prism: str, poses: range) -> None:
    """A session that is on its prism."""
    rig.say("start", prism=prism)
    for pose in poses:
        rig.stand(pose, prism)
    rig.say("stop")


@pytest.mark.parametrize("target", ["b", "s", "w"])
def test_another_prism_from_a_session_s_first_fix_on_is_told_by_what_the_set_up_has_seen(
    rig: TrueRig, target: str
) -> None:
    hold_session(rig, "r", range(4))
    session = rig.say("start", prism="r")["id"]
    rig.stand(4, target)
    assert rig.used(session) == 0
    (suspicion,) = rig.keeper.prism_suspicions()
    assert f"and fits prism {target}" in suspicion.reason
    assert "where the joints place r" in texts(rig, EventKind.PRISM_JUMP)[-1]
    rig.stand(5, "r")
    assert rig.keeper.prism_suspicions() == []
    assert rig.used(session) > 0
    assert texts(rig, EventKind.LOCK_ACQUIRED) != []


def test_another_prism_is_told_by_fixes_of_a_third_one(rig: TrueRig) -> None:
    hold_session(rig, "w", range(4))
    session = rig.say("start", prism="r")["id"]
    rig.stand(4, "b")
    assert rig.used(session) == 0


def test_another_prism_that_is_found_on_the_way_back_from_a_control_point_is_excluded_once_the_boom_has_moved(
    rig: TrueRig,
) -> None:
    session = rig.say("start", prism="r")["id"]
    rig.stand(0, "r", 0.0)
    rig.shoot("cp1", CONTROL_MM)
    for pose in range(5):  # of r there was no fix yet, and nothing to compare with
        rig.stand(pose, "s")
    assert rig.used(session) == 0
    assert [s.station for s in rig.keeper.prism_suspicions()] == ["station"]
    for pose in range(5, 9):
        rig.stand(pose, "r")
    assert rig.keeper.prism_suspicions() == []
    assert rig.used(session) > 80


@pytest.mark.long
def test_another_prism_that_is_told_while_the_disk_fails_is_excluded_once_it_works_again(rig: TrueRig) -> None:
    session = rig.say("start", prism="r")["id"]
    rig.stand(0, "r", 0.0)
    rig.shoot("cp1", CONTROL_MM)
    rig.stand(0, "s")
    assert rig.used(session) > 0, "there is nothing to compare it with yet"
    rig.observing = disk_fails
    for pose in range(1, 5):
        rig.stand(pose, "s")
    rig.observing = contextlib.nullcontext
    rig.stand(4, "s")
    assert rig.used(session) == 0
    assert any("where the joints place r" in text for text in texts(rig, EventKind.PRISM_JUMP))
    observed = [row["monotonic_ns"] for row in table(rig.store.path, "observations")]
    assert len(observed) > 190, "none of those that waited is lost"
    assert observed == sorted(observed)


def test_a_reflector_that_stands_beside_the_machine_is_no_prism(rig: TrueRig) -> None:
    session = rig.say("start", prism="r")["id"]
    rig.stand(0, "r", 0.0)
    stands_mm = rig.target_mm
    for pose in range(1, 4):
        rig.stand(pose, "r", 0.0)
        rig.target_mm = stands_mm
        rig.live(2)
    assert rig.used(session) == 0
    assert "a stationary reflector" in rig.keeper.prism_suspicions()[0].reason


def test_a_boom_that_moves_far_while_lock_is_lost_is_not_suspected(rig: TrueRig) -> None:
    hold_session(rig, "r", range(3))
    session = rig.say("start", prism="r")["id"]
    for pose in range(3, 9):  # metres from one to the next, within one step
        rig.stand(pose, "r")
    assert rig.keeper.prism_suspicions() == []
    assert rig.say("stop")["poses"] == 6
    assert not any(
        "perhaps" in str(row["excluded"])
        for row in table(rig.store.path, "observations")
        if row["session_id"] == session
    )


def test_what_a_restarted_daemon_sees_is_held_against_what_was_stored_before(rig: TrueRig) -> None:
    session = rig.say("start", prism="r")["id"]
    for pose in range(4):
        rig.stand(pose, "r")
    before = rig.used(session)
    rig.keeper = rig.new_keeper()
    rig.stand(4, "s", 4.0)
    assert rig.used(session) == before
    assert len(rig.keeper.prism_suspicions()) == 1


def test_what_an_operator_confirms_the_joints_do_not_overrule(rig: TrueRig) -> None:
    hold_session(rig, "r", range(4))
    session = rig.say("start", prism="r")["id"]
    rig.stand(4, "s")
    rig.say("confirm_prism", operator="Ada")
    rig.live(2)
    assert rig.keeper.prism_suspicions() == []
    assert rig.used(session) > 0


def seen(target: str, poses: range, slack_mm: float = 0.0) -> list[Sighting]:
    """What a session of prism r sees of a target at poses."""
    rows = []
    for pose in poses:
        joints = tuple(map(float, POSES[pose]))
        values = dict(zip(RIG.joint_names, joints, strict=True))
        x, y, z = map(float, TRUTH.prism_mm(target, arrays(values), setup="S1")[0])
        rows.append(Sighting("r", joints, (x, y, z), slack_mm))
    return rows


def loaded() -> tuple[IdentityLoader, PrismIdentity]:
    loader = IdentityLoader(RIG)
    loader.start(60)
    identity = loader.now()
    assert identity is not None
    return loader, identity


def test_what_cannot_be_loaded_is_told_and_loaded_once_it_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("daemon.sessions.prisms.identity_loader.RETRY_S", 0.05)
    loader = IdentityLoader(RIG)
    with monkeypatch.context() as without:
        for variable in ("NUMBA_CACHE_DIR", "CACHE_DIRECTORY", "XDG_CACHE_HOME", "HOME"):
            without.delenv(variable, raising=False)
        without.setattr("tempfile.tempdir", "/dev/null")
        loader.start()
        wait_until(lambda: loader.trouble is not None)
        assert loader.now() is None
    wait_until(lambda: loader.now() is not None)
    wait_until(lambda: loader.trouble is None)


def test_a_session_for_which_there_is_no_thread_begins_and_the_next_one_has_the_joints_asked() -> None:
    loader = IdentityLoader(RIG)
    before = threading.stack_size(1 << 47)  # more than a process can have
    try:
        loader.start(60)
    finally:
        threading.stack_size(before)
    assert "can't start new thread" in (loader.trouble or "")
    loader.start(60)
    assert loader.now() is not None
    assert loader.trouble is None


def test_fixes_of_another_prism_are_not_cleared_by_those_around_them_that_fit(rig: TrueRig) -> None:
    loader, identity = loaded()
    evidence = PrismEvidence(RIG, "r", loader)
    found = []
    for number, pose in enumerate(range(2, 8)):
        stretch = evidence.stretch("station", rig.clock.now().shifted(number), False)
        poses = range(pose, pose + 1)
        # Once, while the boom moves, the station is on s, which is 1.5 m from r
        stretch.sightings += seen("s", poses, slack_mm=400.0) if number == 1 else seen("r", poses)
        evidence._judge(identity, [stretch])
        found.append(stretch)
    assert found[1].verdict is Verdict.OTHER
    assert {stretch.verdict for stretch in found[2:]} == {Verdict.NAMED}


def test_an_earlier_session_on_the_wrong_prism_does_not_make_the_right_one_wrong(rig: TrueRig) -> None:
    loader, identity = loaded()
    evidence = PrismEvidence(RIG, "r", loader, [seen("r", range(3)), seen("b", range(3, 5)), seen("r", range(5, 7))])
    stretch = evidence.stretch("station", rig.clock.now(), False)
    stretch.sightings += seen("r", range(8, 9))
    relied = evidence._relied_on(identity, [stretch])
    assert len(relied) == 5
    assert (identity.own_misfits(relied) <= 1.0).all()
    (finding,) = evidence._judge(identity, [stretch])
    assert finding.stretch.verdict is Verdict.NAMED
    assert len(targets(RIG, [])) == 0


def test_a_station_that_was_knocked_while_its_fixes_were_suspected_has_moved(rig: TrueRig) -> None:
    def stand(pose: int, knock_mm: float, seconds: float = 2.0) -> None:
        rig.values = dict(zip(RIG.joint_names, map(float, POSES[pose]), strict=True))
        east, north, up = place_mm("r", rig.values)
        rig.target_mm = (east + knock_mm, north, up)
        rig.live(seconds)

    session = rig.say("start", prism="r")["id"]
    rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    stand(0, 0.0, 0.3)
    stand(1, 0.0)
    assert (rig.used(session), len(rig.keeper.prism_suspicions())) == (0, 1)
    again = rig.shoot("cp1", (9060.0, 500.0, 2000.0))
    assert (again["phase"], again["misclosure_mm"]) == ("start", None), "as it seems, no pose came before it"
    for pose in range(4, 9):
        stand(pose, 60.0)
    rig.shoot("cp1", (9060.0, 500.0, 2000.0))
    ended = rig.say("stop")
    assert ended["observations"] > 100, "the joints have told that all were of the prism, also those before the knock"
    assert ended["not_used"] == "control point cp1 was 60.0 mm off when it was shot again, so the station had moved"


def test_sessions_of_a_rig_file_that_was_wrong_do_not_speak_against_a_prism(rig: TrueRig) -> None:
    rig.say("start", prism="r")
    for pose in range(5):
        rig.values = dict(zip(RIG.joint_names, map(float, POSES[pose]), strict=True))
        rig.target_mm = place_mm("r", rig.values)
        rig.values["theta4"] += 8.0
        rig.live(2.0)
    rig.say("stop")
    rig.machine = parse_rig(rig.machine.text.replace(*ANOTHER_ZERO), "rig")
    rig.keeper = rig.new_keeper()
    session = rig.say("start", prism="r")["id"]
    for pose in range(5, 10):
        rig.stand(pose, "r")
    assert rig.keeper.prism_suspicions() == []
    assert rig.used(session) > 100
