from __future__ import annotations

from dataclasses import replace

from simulators.blind.cells import full_plan


def test_every_cell_is_drawn_as_often_as_asked_and_every_case_has_a_seed_of_its_own() -> None:
    once, twice = (full_plan(["backlash", "angle_scale"], ["knock"], 7, repeats) for repeats in (1, 2))
    assert [c.seed for c in twice] == list(range(7, 7 + 2 * len(once)))
    for number in range(2):
        assert [replace(c, seed=0) for c in twice[number::2]] == [replace(c, seed=0) for c in once]
