"""Fixes that are decoded long after they were measured: whose they are, after stops, restarts and boots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from daemon.acquisition.thinning import Thinning
from daemon.sessions.lifecycle import NOT_ENCLOSED
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import CanCapture, DeviceEvent, EventKind, Reading, Record
from tests.daemon.sessions.test_prism_watch import ANOTHER_MM, PRISM_MM, used
from tests.daemon.support.sessions import SOURCE, STEP_S, Rig, closed_afterwards, start
from tests.daemon.support.store import table

CONTROL_MM = (9000.0, 500.0, 2000.0)


class DelayedRig(Rig):
    """A rig whose station sends each fix a while after it has measured it, and whose records are thinned."""

    link_delay_s: Mapping[str, float] = {"station": 0.3}

    def live(self, seconds: float, **rates: float) -> None:
        thinning = Thinning(self.keeper.is_of_session)
        for _ in range(round(seconds / STEP_S)):
            self.clock.advance(STEP_S)
            now = self.clock.now()
            records = [*(Reading(j.name, now, self.values[j.name], j.unit) for j in SOURCE.rig.joints), self.fix()]
            self.store.insert_records(thinning.kept(records))
            self.tell(records)


rig, delayed = closed_afterwards(Rig), closed_afterwards(DelayedRig)


def captured(rig: Rig, seconds: float) -> list[list[Record]]:
    """Let time pass that is captured and not decoded yet: what decoding it will give."""
    rig.store.append_captures([CanCapture("can0", rig.clock.now(), 0x181, b"")])
    late: list[list[Record]] = []
    for _ in range(round(seconds / STEP_S)):
        rig.clock.advance(STEP_S)
        now = rig.clock.now()
        readings = [Reading(j.name, now, rig.values[j.name], j.unit) for j in SOURCE.rig.joints]
        late.append([*readings, rig.fix()])
    rig.clock.advance(STEP_S)
    return late


def decode(rig: Rig, late: Sequence[Sequence[Record]]) -> None:
    rig.store.mark_decoded(rig.store.undecoded_chunks())
    for records in late:
        rig.store.insert_records(records)
        rig.tell(records)


def boot_with_an_earlier_clock(rig: Rig) -> None:
    rig.clock.set(Stamp(rig.clock.now().utc_ns - 86_400 * NS_PER_S, NS_PER_S, "next boot"))


def change_prism(rig: Rig, prism: str, place_mm: tuple[float, float, float]) -> None:
    rig.say("stop")
    rig.clock.advance(STEP_S)
    rig.target_mm = place_mm
    rig.say("start", prism=prism)


def observed(rig: Rig) -> set[tuple[str, str, int]]:
    """Session, prism and place of what calibration may use."""
    rows = table(rig.store.path, "observations")
    return {(r["session_id"], r["prism"], round(r["y_mm"])) for r in rows if r["excluded"] is None}


def test_fixes_that_a_killed_run_left_undecoded_never_go_to_a_later_session_on_another_prism(rig: Rig) -> None:
    start(rig)
    late = captured(rig, 3)
    change_prism(rig, "b", ANOTHER_MM)
    late += captured(rig, 3)
    rig.keeper = rig.new_keeper()
    decode(rig, late)
    rig.live(3)
    assert observed(rig) == {("s001-r", "r", 8000), ("s002-b", "b", 18000)}


def test_fixes_of_a_boot_with_a_later_clock_do_not_go_to_a_session_that_was_started_after_it(rig: Rig) -> None:
    start(rig)
    late = captured(rig, 3)
    rig.say("stop")
    boot_with_an_earlier_clock(rig)
    rig.keeper = rig.new_keeper()
    rig.target_mm = ANOTHER_MM
    rig.say("start", prism="b")
    decode(rig, late)
    rig.live(3)
    assert observed(rig) == {("s001-r", "r", 8000), ("s002-b", "b", 18000)}


def test_sessions_that_end_while_decoding_is_behind_get_their_fixes_each(rig: Rig) -> None:
    start(rig)
    late = captured(rig, 3)
    change_prism(rig, "b", ANOTHER_MM)
    late += captured(rig, 3)
    change_prism(rig, "r", PRISM_MM)
    decode(rig, late)
    rig.live(3)
    assert observed(rig) == {("s001-r", "r", 8000), ("s002-b", "b", 18000), ("s003-r", "r", 8000)}


def test_a_session_that_ended_before_a_restart_gets_the_fixes_that_were_left_undecoded(rig: Rig) -> None:
    start(rig)
    late = captured(rig, 3)
    rig.say("stop")
    rig.keeper = rig.new_keeper()
    decode(rig, late)
    rig.live(3)
    assert observed(rig) == {("s001-r", "r", 8000)}


def test_a_jump_after_a_session_excludes_nothing_of_it_after_a_restart(rig: Rig) -> None:
    start(rig)
    late = captured(rig, 3)
    rig.say("stop")
    rig.clock.advance(1)
    rig.store.insert_records([DeviceEvent("theta1", rig.clock.now(), EventKind.PRESET_JUMP, "from 22 to 33")])
    rig.keeper = rig.new_keeper()
    decode(rig, late)
    rig.live(1)
    assert observed(rig) == {("s001-r", "r", 8000)}


def test_whether_a_session_is_used_is_decided_again_when_its_poses_are_decoded_after_its_end(rig: Rig) -> None:
    start(rig)
    rig.shoot("cp1", CONTROL_MM)
    rig.live(3)
    rig.shoot("cp1", CONTROL_MM)
    late = []
    for change in (1, -1) * 3:
        rig.values["theta8"] += change  # which hardly moves prism r
        late += captured(rig, 3)
    rig.say("stop")
    assert rig.say("show", id="s001-r")["not_used"] is None
    decode(rig, late)
    rig.live(3)
    shown = rig.say("show", id="s001-r")
    assert shown["poses"] > 4
    assert shown["not_used"] == NOT_ENCLOSED
    rig.say("accept", id="s001-r")
    rig.live(3)
    assert rig.say("show", id="s001-r")["not_used"] is None


def test_another_prism_stays_suspected_in_a_boot_whose_clock_was_set_back(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    rig.target_mm = ANOTHER_MM
    rig.live(5)
    boot_with_an_earlier_clock(rig)
    rig.keeper = rig.new_keeper()
    rig.live(5)
    assert set(used(rig)) == {8000}
    assert len(rig.keeper.prism_suspicions()) == 1


def test_fixes_that_arrive_after_a_session_of_which_they_are_keep_their_rows(delayed: DelayedRig) -> None:
    start(delayed)
    delayed.live(3)
    delayed.say("stop")
    delayed.live(3)
    observations = table(delayed.store.path, "observations")
    assert len(observations) > 55
    assert all(row["fix_id"] is not None for row in observations)


def test_a_target_that_was_measured_before_a_sessions_start_is_none_of_its_targets(delayed: DelayedRig) -> None:
    delayed.say("setup_new", id="S1", instrument="GTS-905A")
    delayed.target_mm = ANOTHER_MM
    delayed.live(2)
    delayed.say("start", prism="r")
    delayed.live(0.25)
    delayed.target_mm = PRISM_MM
    delayed.live(3)
    assert delayed.keeper.prism_suspicions() == []
    assert observed(delayed) == {("s001-r", "r", 8000)}
