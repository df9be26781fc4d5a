"""Confirmations, turns and shots apply to fixes by when these were measured, not by when they arrived."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from daemon.sessions.prisms.standstill_places import ELSEWHERE
from drivers.readings import Fix
from tests.daemon.sessions.test_prism_watch import ANOTHER_MM, PRISM_MM, reasons, used
from tests.daemon.support.sessions import STEP_S, Rig, closed_afterwards, start
from tests.daemon.support.store import table

CONTROL_MM = (9000.0, 500.0, 2000.0)
BESIDE_MM = (3000.0, 8200.0, 1000.0)  # 0.2 m from the prism: no jump that a guard suspects
STEPS_LATE = 10  # 0.5 s
WITHIN_S = 0.3  # after which an operator who has turned the station says so


class LateRig(Rig):
    """A rig whose station measures in the middle of each step, and sends the fix `STEPS_LATE` steps later."""

    link_delay_s: Mapping[str, float] = {"station": (STEPS_LATE + 0.5) * STEP_S}

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._unsent: deque[Fix] = deque(maxlen=STEPS_LATE + 1)

    def fix(self) -> Fix:
        self._unsent.append(super().fix())
        now = self.clock.now()
        return replace(self._unsent[0], stamp=now, last_byte=now)

    def new_aiming_keeper(self) -> None:
        """Go on with a program that aims the station at prisms and control points."""
        self.keeper = self.new_keeper(self._aim)

    def _aim(self, target: str) -> None:
        self.target_mm = CONTROL_MM if target == "cp1" else PRISM_MM

    def shoot_where_it_is(self) -> Any:
        return self.shoot("cp1", self.target_mm)


rig = closed_afterwards(LateRig)


def on_another_prism(rig: LateRig) -> None:
    start(rig)
    rig.live(2)
    rig.target_mm = ANOTHER_MM
    rig.live(3)
    assert len(rig.keeper.prism_suspicions()) == 1


def confirmed_at_once(rig: LateRig) -> int:
    """Confirm the prism just after the station was turned back to it; return how many fixes were used before."""
    on_another_prism(rig)
    rig.target_mm = PRISM_MM
    rig.live(WITHIN_S)
    rig.say("confirm_prism", operator="Ada")
    return len(used(rig))


def test_a_prism_confirmed_while_fixes_of_another_one_still_arrive_is_used_and_the_other_is_not(rig: LateRig) -> None:
    before = confirmed_at_once(rig)
    rig.live(4)
    assert rig.keeper.prism_suspicions() == []
    assert set(used(rig)) == {8000}
    assert len(used(rig)) - before > 50


@pytest.mark.parametrize("seconds", [0.1, 0.4, 2.0])
def test_after_a_restart_a_confirmation_still_applies_to_what_was_measured_after_it(
    rig: LateRig, seconds: float
) -> None:
    before = confirmed_at_once(rig)
    rig.live(seconds)
    rig.keeper = rig.new_keeper()
    rig.live(4)
    assert rig.keeper.prism_suspicions() == []
    assert set(used(rig)) == {8000}
    assert len(used(rig)) - before > 50


def test_fixes_that_arrive_after_a_program_has_turned_the_station_and_were_measured_before_are_not_used(
    rig: LateRig,
) -> None:
    rig.new_aiming_keeper()
    on_another_prism(rig)
    before = len(used(rig))
    rig.keeper.aim_again()
    rig.live(4)
    assert rig.keeper.prism_suspicions() == []
    assert set(used(rig)) == {8000}
    assert len(used(rig)) - before > 50


def test_within_a_standstill_only_fixes_measured_after_a_confirmation_decide_where_the_prism_is(rig: LateRig) -> None:
    rig.target_mm = BESIDE_MM
    start(rig)
    rig.live(3)
    rig.target_mm = PRISM_MM
    rig.live(STEP_S)
    rig.say("confirm_prism", operator="Ada")
    before = len(used(rig))
    rig.live((STEPS_LATE + 4) * STEP_S)  # more fixes of the other place than of the prism have arrived since
    assert before > 20
    assert set(used(rig)) == {8000}
    assert any(reason.startswith(ELSEWHERE) for reason in reasons(rig))


@pytest.mark.parametrize("is_aimed", [False, True])
def test_a_control_point_is_located_by_fixes_measured_after_the_station_was_turned_to_it(
    rig: LateRig, is_aimed: bool
) -> None:
    if is_aimed:
        rig.new_aiming_keeper()
    start(rig)
    rig.live(3)
    if not is_aimed:
        rig.target_mm = CONTROL_MM  # by the operator, who has not waited for fixes of it
    shot = rig.shoot_where_it_is()
    assert (shot["x_mm"], shot["y_mm"], shot["z_mm"]) == pytest.approx(CONTROL_MM)
    (point,) = table(rig.store.path, "control_points")
    assert (point["x_mm"], point["y_mm"], point["z_mm"]) == pytest.approx(CONTROL_MM)


def test_fixes_measured_in_a_shot_that_arrive_after_its_end_are_not_of_the_prism(rig: LateRig) -> None:
    rig.new_aiming_keeper()
    start(rig)
    rig.live(3)
    before = len(used(rig))
    rig.shoot_where_it_is()
    rig.target_mm = PRISM_MM
    rig.live(4)
    assert rig.keeper.prism_suspicions() == []
    assert set(used(rig)) == {8000}
    assert len(used(rig)) - before > 50
