"""Whether a model may take another's place, and the paired test that decides it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from calibration.errors import DataError, UnsafeError
from calibration.evaluation.promotion import compare_held_out
from calibration.model.model import CalibratedModel
from calibration.numerics.statistics import paired_test
from calibration.observations import Observations
from tests.calibration.conftest import Session, simulated


def worse(model: CalibratedModel, by_mm: float, prisms: Sequence[str] = ("r",)) -> CalibratedModel:
    """The model with the places of prisms off."""
    values = model.values.copy()
    for prism in prisms:
        values[model.chain.index(f"prism.{prism}.z")] += by_mm
    return replace(model, values=values)


def few(session: Session, count: int = 40) -> Observations:
    return session.held_out.select(np.arange(count))


# ---- the test --------------------------------------------------------------------------------------------------------


def test_the_test_is_the_paired_t_test_over_the_groups_means() -> None:
    rng = np.random.default_rng(0)
    before, after = rng.chisquare(3, 60) * 1.5, rng.chisquare(3, 60)
    groups = np.repeat(np.arange(12), 5)
    found = paired_test(before, after, groups)
    means = [(before - after)[groups == g].mean() for g in range(12)]
    assert found.p == pytest.approx(stats.ttest_1samp(means, 0.0, alternative="greater").pvalue)
    assert (found.rows, found.groups) == (60, 12)
    assert found.before_mm == pytest.approx(np.sqrt(before.mean()))


@pytest.mark.parametrize("groups", [np.zeros(8, dtype=int), np.arange(8)])
def test_one_group_or_groups_without_spread_prove_nothing(groups: np.ndarray) -> None:
    found = paired_test(np.full(8, 4.0), np.full(8, 1.0), groups)
    assert found.p == 1.0
    assert not found.is_better


def test_a_gain_too_small_to_matter_is_none_however_sure_it_is() -> None:
    before = np.full(100, 1.0) + np.arange(100) * 1e-9
    found = paired_test(before, 0.99 * before, np.arange(100))
    assert found.p < 1e-6
    assert not found.is_better


def test_chance_alone_passes_seldom() -> None:
    rng = np.random.default_rng(1)
    passed = sum(paired_test(*rng.chisquare(3, (2, 30)), np.arange(30)).is_better for _ in range(1000))
    assert passed <= 20


# ---- a candidate beside the live model -------------------------------------------------------------------------------


def test_a_better_candidate_is_found_better_and_a_worse_one_is_not(session: Session) -> None:
    live = worse(session.model, 15.0)
    better = compare_held_out(session.model, live, few(session))
    assert better.is_better
    assert (better.against, better.fixes, better.standstills) == ("live", 40, 40)
    assert better.after_mm < better.before_mm
    assert "better beyond chance" in better.sentence
    again = compare_held_out(live, session.model, few(session))
    assert not again.is_better
    assert again.before_mm == pytest.approx(better.after_mm)
    assert "no gain beyond chance" in again.sentence


def test_the_same_model_again_does_not_beat_itself(session: Session) -> None:
    same = compare_held_out(session.model, session.model, few(session))
    assert (same.is_better, same.p) == (False, 1.0)


def test_a_gain_on_too_few_standstills_asks_for_more_check_sessions(session: Session) -> None:
    found = compare_held_out(session.model, worse(session.model, 15.0), few(session, 3))
    assert not found.is_better
    assert found.sentence.endswith("no gain beyond chance; more check sessions may show one")


def test_a_first_model_may_go_live_unless_it_is_worse_than_the_nominal_one(session: Session) -> None:
    first = compare_held_out(session.model, None, few(session, 2))
    assert (first.against, first.standstills, first.is_better) == ("nominal", 2, True)
    assert first.sentence.endswith("nominal stage: enough, as there is no live model to beat")
    for count in (3, 40):
        spoilt = compare_held_out(worse(session.model, 500.0), None, few(session, count))
        assert not spoilt.is_better
        assert spoilt.sentence.endswith(
            "larger, overall or at most standstills; more check fixes must show that it is not larger"
        )


@pytest.mark.parametrize("by_mm", [0.0, 500.0])
def test_a_first_model_does_not_go_live_on_one_standstill(session: Session, by_mm: float) -> None:
    rows = few(session).select(np.zeros(4, dtype=int))
    found = compare_held_out(worse(session.model, by_mm), None, rows)
    assert (found.standstills, found.p, found.is_better) == (1, 1.0, False)
    assert found.sentence.endswith("more check fixes must show that it is not larger")


def test_the_probability_that_is_told_is_that_of_the_gain(session: Session) -> None:
    assert compare_held_out(session.model, None, few(session)).p < 0.01
    spoilt = compare_held_out(worse(session.model, 500.0), session.model, few(session))
    assert spoilt.p > 0.99
    assert "(a gain by chance: p = 1)" in spoilt.sentence


def test_shots_at_something_else_do_not_let_a_worse_first_model_go_live(session: Session) -> None:
    """Their errors are nearly the same by any model, and hide all others in an RMS."""
    rows = few(session)
    spoilt, refused = worse(session.model, 150.0, session.rig.prism_names), 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        stray = np.where(rng.random(len(rows)) < 0.3, 5000.0, 0.0)[:, None] * rng.standard_normal((len(rows), 3))
        shots = replace(rows, position_mm=rows.position_mm + stray)
        assert compare_held_out(session.model, None, shots).before_mm > 1000.0
        refused += not compare_held_out(spoilt, None, shots).is_better
    assert refused == 8


def test_a_live_model_of_a_machine_with_other_prisms_is_not_compared_with(session: Session) -> None:
    rig = session.model.rig.model_copy(update={"prisms": tuple(p for p in session.rig.prisms if p.name == "w")})
    other = replace(session.model, rig=rig)
    assert compare_held_out(session.model, other, few(session)).against == "nominal"


def test_fixes_of_one_standstill_are_one_draw(session: Session) -> None:
    rows = few(session)
    thrice = rows.select(np.repeat(np.arange(len(rows)), 3))
    found = compare_held_out(session.model, worse(session.model, 15.0), thrice)
    assert (found.fixes, found.standstills) == (120, 40)


def test_an_unknown_set_up_is_placed_by_its_own_fixes_for_both_alike(session: Session) -> None:
    elsewhere = simulated(session.truth, 30, 9, setup="S2")
    found = compare_held_out(session.model, worse(session.model, 15.0), elsewhere)
    assert found.refitted == ("S2",)
    assert found.is_better
    assert found.after_mm < 10.0


def test_a_set_up_that_its_fixes_cannot_place_is_left_out_and_said(session: Session) -> None:
    rows = few(session, 20)
    setup = rows.setup.astype("<U8")
    setup[-2:] = "S9"
    found = compare_held_out(session.model, worse(session.model, 15.0), replace(rows, setup=setup))
    assert (found.fixes, found.left_out) == (18, ("S9",))
    with pytest.raises(UnsafeError, match="at set-up 'S9'"):
        compare_held_out(session.model, None, replace(rows, setup=setup).select(setup == "S9"))


def test_no_rows_are_refused(session: Session) -> None:
    with pytest.raises(DataError, match="there are none"):
        compare_held_out(session.model, None, few(session, 0))
