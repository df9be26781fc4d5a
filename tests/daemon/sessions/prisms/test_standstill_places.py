"""Two places in one standstill: the fixes of the minority are excluded, and more fixes may turn the decision."""

from daemon.sessions.prisms.standstill_places import EVERY_FIX, Exclusions, Standstill, StandstillPlaces
from tests.daemon.support.sessions import SOURCE, STEP_S, Rig

JOINTS = {j.column: sum(j.limits) / 2 for j in SOURCE.rig.joints}
PRISM = (3000.0, 8000.0, 1000.0)
STANDSTILL = Standstill("s001-r", 1, 1)


def away(metres: float) -> tuple[float, float, float]:
    return PRISM[0], PRISM[1] + 1000.0 * metres, PRISM[2]


def observed(rig: Rig) -> list[tuple[float, str | None]]:
    """y of every fix of a standstill, and why it is excluded."""
    rows = rig.store.rows("SELECT y_mm, excluded FROM observations WHERE pose IS NOT NULL ORDER BY id")
    return [(round(row["y_mm"], 3), row["excluded"]) for row in rows]


def stand(rig: Rig, place: tuple[float, float, float], fixes: int) -> None:
    rig.target_mm = place
    rig.live(fixes * STEP_S)


def test_another_prism_too_near_to_be_a_jump_is_excluded_by_name(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    stand(session_rig, PRISM, 60)
    stand(session_rig, away(0.3), 40)
    stand(session_rig, PRISM, 60)
    reason = "another prism or a reflection: more fixes of this standstill lie 0.30 m away"
    summary = session_rig.say("stop")
    assert summary["excluded"][reason] == 40
    assert {why for y, why in observed(session_rig) if y == 8000.0} == {None}
    assert summary["observations"] == sum(y == 8000.0 for y, _ in observed(session_rig))


def test_a_place_that_an_operator_confirms_counts_within_its_standstill_and_the_others_are_excluded(
    session_rig: Rig,
) -> None:
    session_rig.say("start", prism="r")
    stand(session_rig, away(0.5), 60)
    stand(session_rig, PRISM, 20)
    session_rig.say("confirm_prism", operator="Ada")
    stand(session_rig, PRISM, 30)
    assert {y for y, why in observed(session_rig) if why is None} == {8000.0}
    stand(session_rig, away(0.5), 3)  # and the fixes since then decide, as before
    excluded = session_rig.say("stop")["excluded"]
    assert excluded["another prism or a reflection: more fixes of this standstill lie 0.50 m away"] > 40
    assert {y for y, why in observed(session_rig) if why is None} == {8000.0}


def test_what_came_first_is_excluded_when_it_turns_out_to_be_the_minority(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    stand(session_rig, away(0.3), 40)
    stand(session_rig, PRISM, 35)
    assert {y for y, why in observed(session_rig) if why is None} == {8300.0}
    stand(session_rig, PRISM, 60)
    assert {y for y, why in observed(session_rig) if why is None} == {8000.0}
    assert all((why is None) == (y == 8000.0) for y, why in observed(session_rig))


def test_while_two_places_have_equally_many_fixes_both_are_excluded() -> None:
    places = StandstillPlaces(SOURCE.rig)
    kept: Exclusions = {}
    for i, place in enumerate([PRISM, away(2.0), PRISM, away(2.0)]):
        kept |= places.add(STANDSTILL, i, place, JOINTS)
    assert set(kept.values()) == {"another prism or a reflection: as many fixes of this standstill lie 2.00 m away"}
    kept |= places.add(STANDSTILL, 4, PRISM, JOINTS)
    assert [i for i, why in kept.items() if why is None] == [0, 2, 4]


def test_a_third_place_is_excluded_with_the_second() -> None:
    places = StandstillPlaces(SOURCE.rig)
    kept: Exclusions = {}
    for i, place in enumerate([PRISM, PRISM, PRISM, away(2.0), away(-5.0), away(2.0)]):
        kept |= places.add(STANDSTILL, i, place, JOINTS)
    assert [why and why.split(" lie ")[1] for why in kept.values()] == [
        *[None] * 3,
        "2.00 m away",
        "5.00 m away",
        "2.00 m away",
    ]


def test_each_standstill_has_a_place_of_its_own(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    for metres in (0.0, 0.3, 0.6):
        session_rig.live(1, theta1=5.0)
        stand(session_rig, away(metres), 60)
    assert {why for _, why in observed(session_rig)} == {None}


def test_restarts_of_the_daemon_within_a_standstill_forget_none_of_its_places(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    stand(session_rig, PRISM, 120)
    stand(session_rig, away(0.3), 30)
    for _ in range(2):
        session_rig.keeper = session_rig.new_keeper()
        stand(session_rig, away(0.3), 30)
    assert {y for y, why in observed(session_rig) if why is None} == {8000.0}
    session_rig.keeper = session_rig.new_keeper()
    stand(session_rig, away(0.3), 120)  # most fixes now: what was stored before the restarts is decided anew
    assert {y for y, why in observed(session_rig) if why is None} == {8300.0}


def test_an_operator_s_word_within_a_standstill_outlasts_a_restart(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    stand(session_rig, away(0.5), 90)
    session_rig.say("confirm_prism", operator="Ada")
    stand(session_rig, PRISM, 30)
    session_rig.keeper = session_rig.new_keeper()
    stand(session_rig, away(0.5), 20)
    assert {y for y, why in observed(session_rig) if why is None} == {8000.0}


def test_a_boom_that_moved_while_the_daemon_was_down_stands_at_a_new_place(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    stand(session_rig, PRISM, 60)
    session_rig.keeper = session_rig.new_keeper()
    session_rig.values["theta1"] += 5.0
    stand(session_rig, away(0.3), 40)
    assert {why for _, why in observed(session_rig)} == {None}


def test_scatter_sway_and_a_boom_that_sinks_are_one_place() -> None:
    places = StandstillPlaces(SOURCE.rig)
    for i in range(200):
        scatter_mm = 20.0 * (i % 3 - 1)
        sunk_mm = 5.0 * i  # a metre in all
        assert places.add(STANDSTILL, i, (PRISM[0], PRISM[1], PRISM[2] - sunk_mm + scatter_mm), JOINTS) == {i: None}


def test_what_the_joints_have_moved_between_two_fixes_is_no_other_place() -> None:
    places = StandstillPlaces(SOURCE.rig)
    crept = {**JOINTS, "theta4_deg": JOINTS["theta4_deg"] + 2.0}
    assert places.add(STANDSTILL, 0, PRISM, JOINTS) == {0: None}
    assert places.add(STANDSTILL, 1, away(0.35), crept) == {1: None}, "10 m of boom, 2 degrees"
    assert places.add(STANDSTILL, 2, PRISM, crept)[2] is not None


def test_fixes_that_are_excluded_for_another_reason_have_no_say(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    session_rig.shoot("cp1", away(3.0))
    stand(session_rig, away(3.0), 80)
    stand(session_rig, PRISM, 40)
    summary = session_rig.say("stop")
    assert "a control point, not the prism" in summary["excluded"]
    assert not [reason for reason in summary["excluded"] if "another prism" in reason]
    assert summary["observations"] > 20


def test_a_station_that_swings_between_two_prisms_for_an_hour_costs_little() -> None:
    places = StandstillPlaces(SOURCE.rig)
    fixes = 10_000
    changes = sum(len(places.add(STANDSTILL, i, away(float(i % 2)), JOINTS)) for i in range(fixes))
    assert changes < fixes * 8 * EVERY_FIX, "each fix rewriting all before it would be 50 million"
