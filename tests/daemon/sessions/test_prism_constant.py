"""The prism constant that a station applies, as its records say it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from drivers.readings import Fix
from tests.daemon.support.sessions import Rig, closed_afterwards, controlled
from tests.daemon.support.store import table


class ConstantRig(Rig):
    """A rig whose station says the prism constant that is set on it."""

    constant_mm: float | None = -30.0

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.say("setup_new", id="S1", prism_constants_mm={"r": -30.0})

    def fix(self) -> Fix:
        found = super().fix()
        applied_mm = -30.0 if self.constant_mm is None else self.constant_mm
        assert found.slope_distance_m is not None
        distance_m = found.slope_distance_m + (applied_mm + 30.0) / 1000
        return dataclasses.replace(found, slope_distance_m=distance_m, prism_constant_mm=self.constant_mm)


rig = closed_afterwards(ConstantRig)
CP1 = (9000.0, 500.0, 2000.0)
OTHER = "the station applies a prism constant of 0 mm, but applied -30 mm at first"


def test_fixes_with_another_prism_constant_than_the_session_began_with_are_not_used(rig: ConstantRig) -> None:
    name = rig.say("start", prism="r")["id"]
    rig.live(2)
    rig.constant_mm = 0.0
    rig.live(2)
    rig.keeper = rig.new_keeper()  # a restart of the daemon forgets nothing of it
    rig.live(2)
    rig.constant_mm = -30.0
    rig.live(2)
    assert rig.say("show", id=name)["excluded"][OTHER] > 40
    constants = {row["id"]: row["prism_constant_mm"] for row in table(rig.store.path, "fixes")}
    used = [row["fix_id"] for row in table(rig.store.path, "observations") if row["excluded"] is None]
    assert {constants[fix] for fix in used} == {-30.0}
    assert len(used) == 60, "40 before, and 20 after the boom stood long enough again"


def test_fixes_with_another_prism_constant_stay_unused_where_they_are_the_most_of_a_standstill(
    rig: ConstantRig,
) -> None:
    rig.say("start", prism="r")
    rig.live(2)
    x, y, z = rig.target_mm
    rig.target_mm, rig.constant_mm = (x, y + 250.0, z), 0.0  # as from another prism, which is too near to be a jump
    rig.live(5)
    constants = {row["id"]: row["prism_constant_mm"] for row in table(rig.store.path, "fixes")}
    used = [row["fix_id"] for row in table(rig.store.path, "observations") if row["excluded"] is None]
    assert {constants[fix] for fix in used} == {-30.0}


def test_a_station_that_does_not_say_its_prism_constant_is_taken_at_its_word(rig: ConstantRig) -> None:
    rig.constant_mm = None
    name = controlled(rig)
    assert rig.say("show", id=name)["observations"] > 20


def test_fixes_of_a_control_point_before_its_first_shot_say_nothing_of_the_prism(rig: ConstantRig) -> None:
    prism_mm, rig.target_mm, rig.constant_mm = rig.target_mm, CP1, 0.0
    name = rig.say("start", prism="r")["id"]
    rig.live(3)
    rig.shoot("cp1", CP1)
    rig.target_mm, rig.constant_mm = prism_mm, -30.0
    rig.live(1)
    rig.say("confirm_prism")
    rig.live(3)
    assert rig.say("show", id=name)["observations"] > 40


def test_fixes_that_are_refused_for_another_reason_say_nothing_of_it_after_a_restart_either(rig: ConstantRig) -> None:
    rig.constant_mm = 0.0
    name = rig.say("start", prism="r")["id"]
    rig.live(2, theta1=5.0)  # moving
    rig.constant_mm = -30.0
    rig.live(3)
    before = rig.say("show", id=name)["observations"]
    rig.keeper = rig.new_keeper()
    rig.live(3)
    assert rig.say("show", id=name)["observations"] > before > 30


def ended(rig: ConstantRig, constant_mm: float) -> dict[str, Any]:
    """A session with a prism constant; the control point's own prism has the right one."""
    rig.clock.advance(1.0)
    rig.say("start", prism="r")
    rig.constant_mm = -30.0
    rig.shoot("cp1", CP1)
    rig.constant_mm = constant_mm
    rig.live(3)
    rig.constant_mm = -30.0
    rig.shoot("cp1", CP1)
    return dict(rig.say("stop"))


def test_a_session_whose_constant_is_not_the_one_of_its_set_up_is_not_used(rig: ConstantRig) -> None:
    assert ended(rig, 0.0)["not_used"] == "station applied a prism constant of 0 mm to r, but set-up S1 gives -30 mm"
    assert ended(rig, -30.0)["not_used"] is None


def test_sessions_with_different_constants_are_not_used_together(rig: ConstantRig) -> None:
    rig.clock.advance(1.0)
    rig.say("setup_new", id="S2")
    assert ended(rig, -30.0)["not_used"] is None
    assert ended(rig, 0.0)["not_used"] == "station applied a prism constant of 0 mm to r, but session s001-r has -30 mm"
    assert ended(rig, -30.0)["not_used"] is None
    rig.clock.advance(1.0)
    rig.say("setup_new", id="S3")
    assert ended(rig, 0.0)["not_used"] is None, "another instrument may count otherwise"
