"""When the station of a guided session was on no prism: what an export and the next run of the daemon know of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.config.config import parse_config
from daemon.guide.times_away import times_away
from daemon.sessions.export.captured_logs import export_session
from daemon.sessions.export.session_file import SessionFile, read_session_file
from tests.daemon.guide.test_guide_store_order import POSE
from tests.daemon.guide.test_guide_warnings import WatchedRig
from tests.daemon.sessions.test_late_fixes import captured, decode, observed
from tests.daemon.sessions.test_prism_watch import ANOTHER_MM, CONFIG
from tests.daemon.support.sessions import closed_afterwards

rig = closed_afterwards(WatchedRig)


def exported(rig: WatchedRig, session: str, directory: Path) -> SessionFile:
    config = parse_config(CONFIG, directory / "rigcal.toml")
    rig.store.end_run(rig.clock.now())
    export_session(config, session, directory / "out", "log", times_away)
    return read_session_file(directory / "out" / f"{session}.json")


def test_the_times_when_the_station_of_a_guide_was_on_no_prism_are_exported_with_the_session(
    rig: WatchedRig, tmp_path: Path
) -> None:
    rig.guided("start", new_setup={"id": "S1"}, prisms=["r", "s"], check_poses=0, plan=[POSE] * 6)
    ends_ns = []
    for prism in ("r", "s"):
        rig.live(0.2)
        started_ns = rig.clock.now().utc_ns
        opened = rig.keeper.start_command({"prism": prism, "setup": "S1"}, is_aimed=False)
        rig.live(0.2)
        rig.guide._course.happen("opened", {"session": opened["id"], "last": 0})
        rig.guided("skip", reason="fog")
        rig.live(0.2)
        aimed_ns = rig.clock.now().utc_ns
        rig.guided("done")
        rig.live(0.2)
        left_ns = rig.clock.now().utc_ns
        rig.guided("skip", reason="dinner", rest=True)
        rig.live(0.2)
        rig.guided("skip", reason="fog")
        rig.live(0.2)
        rig.say("stop")
        rig.guide._course.happen("closed", {"session": opened["id"]})
        ends_ns.append(((started_ns, aimed_ns), (left_ns, rig.clock.now().utc_ns)))
    assert [exported(rig, session, tmp_path).away_utc_ns for session in ("s001-r", "s002-s")] == ends_ns


def test_a_guide_that_is_abandoned_at_its_poses_leaves_its_session_away_only_until_it_was_aimed(
    rig: WatchedRig, tmp_path: Path
) -> None:
    rig.after_the_point()
    started_ns = rig.clock.now().utc_ns
    rig.live(1)
    aimed_ns = rig.clock.now().utc_ns
    rig.guided("done")
    rig.live(2)
    rig.guided("stop", reason="rain")
    assert exported(rig, "s001-r", tmp_path).away_utc_ns == ((started_ns, aimed_ns),)


def test_a_session_without_a_guide_is_exported_as_on_its_prism_throughout(rig: WatchedRig, tmp_path: Path) -> None:
    rig.say("setup_new", id="S1")
    rig.say("start", prism="r")
    rig.live(1)
    rig.say("stop")
    assert exported(rig, "s001-r", tmp_path).away_utc_ns == ()


@pytest.mark.parametrize("is_ended", [False, True])
def test_fixes_that_a_killed_run_left_undecoded_before_the_station_was_aimed_are_not_used(
    rig: WatchedRig, is_ended: bool
) -> None:
    rig.after_the_point()
    prism_mm, rig.target_mm = rig.target_mm, ANOTHER_MM
    late = captured(rig, 3)
    rig.values["theta1"] += 5.0  # to another standstill, where nothing else shows which prism it was
    rig.target_mm = prism_mm
    rig.guided("done")
    late += captured(rig, 3)
    if is_ended:
        rig.guided("stop", reason="rain")
    rig.restarted()
    decode(rig, late)
    assert observed(rig) == {("s001-r", "r", 8000)}
