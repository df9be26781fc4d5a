from __future__ import annotations

import pytest

from simulators.faults import KINDS, FaultSchedule, make_fault, parse_faults, random_faults


def test_a_script_is_read_and_played_in_the_order_of_time() -> None:
    faults = parse_faults("node_reboot@45:node=33, lock_loss@30:seconds=4,emergency@50:code=0x8120")
    schedule = FaultSchedule(faults)
    assert schedule.next_deadline() == 30.0
    assert schedule.due(29.9) == []
    (first,) = schedule.due(44.0)
    assert (first.kind, first.number("seconds")) == ("lock_loss", 4.0)
    schedule.add(make_fault("clutter", 46.0, {}))
    assert [f.kind for f in schedule.due(60.0)] == ["node_reboot", "clutter", "emergency"]
    assert schedule.next_deadline() == float("inf")
    assert faults[2].count("code") == 0x8120
    assert parse_faults("") == ()


def test_every_kind_has_usable_defaults() -> None:
    for kind in KINDS:
        fault = make_fault(kind, 1.0, {})
        assert set(fault.parameters) == set(KINDS[kind])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rust@3", "unknown fault 'rust'; known: lock_loss"),
        ("lock_loss", "give the time in seconds, as in lock_loss@30"),
        ("lock_loss@soon", "give the time"),
        ("lock_loss@-1", "not a valid time"),
        ("lock_loss@1:minutes=3", "known: seconds"),
        ("lock_loss@1:seconds", r"expected KIND@SECONDS\[:NAME=VALUE...\]"),
        ("lock_loss@1:seconds=x", "'x' is not a number"),
        ("lock_loss@1:seconds=-1", "not a number of 0 or more"),
        ("clutter@1:count=1.5", "not a whole number"),
        ("unplug@1:link=usb", "allowed: can, station"),
        ("bus_error@1:state=dead", "allowed: warning, passive"),
    ],
)
def test_a_bad_script_is_refused_in_a_sentence(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_faults(text)


def test_a_preset_may_jump_backwards() -> None:
    assert make_fault("preset_jump", 0.0, {"counts": -300}).count("counts") == -300


def test_random_faults_are_seeded_and_spread_over_the_time() -> None:
    faults = random_faults(3, 10_000.0, 10.0)
    assert faults == random_faults(3, 10_000.0, 10.0)
    assert faults != random_faults(4, 10_000.0, 10.0)
    assert len(faults) == pytest.approx(1000, rel=0.15)
    assert {f.kind for f in faults} == set(KINDS)
    assert all(0 < f.at_s < 10_000 for f in faults)
    assert {f.kind for f in random_faults(3, 1000.0, 10.0, ["clutter"])} == {"clutter"}
