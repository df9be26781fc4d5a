"""What the data cannot see: rank, null space, the words for it and the observability indices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.effects.columns import EffectColumns
from calibration.identification.identifiability import Identifiability, identifiability, observability_indices
from calibration.identification.samples import Samples, averaged
from calibration.kinematics.chain import Chain, ChainData, Placement
from calibration.rig.description import Rig, shipped_rig
from simulators.rig.dataset import random_poses
from tests.calibration.conftest import Session


def uniform_samples(rig: Rig, n: int = 250, seed: int = 0, setups: tuple[str, ...] = ("",)) -> tuple[Chain, Samples]:
    """Random poses, the prisms and set-ups in turn, 3 mm of noise."""
    place = Placement(np.eye(3), np.array([1e3, 8e3, 500.0]))
    chain = Chain(rig, dict.fromkeys(setups, place))
    poses = random_poses(rig, n, np.random.default_rng(seed))
    readings = np.column_stack([poses[j] for j in rig.joint_names])
    data = ChainData(readings, np.arange(n) % len(rig.prisms), np.arange(n) // len(rig.prisms) % len(setups))
    covariance = np.tile(9.0 * np.eye(3), (n, 1, 1))
    rates, scatter = np.zeros_like(readings), np.zeros(readings.shape[1])
    return chain, Samples(
        data, np.zeros((n, 3)), covariance, rates, np.arange(n), 0.0, np.ones(n), scatter, np.arange(n)
    )


def rows(samples: Samples, chosen: np.ndarray) -> Samples:
    return samples.select(chosen)


def seen(rig: Rig) -> Identifiability:
    chain, samples = uniform_samples(rig)
    return identifiability(chain, samples, np.zeros(len(chain)), 0.0)


def with_beta_at_row_2(rig: Rig) -> Rig:
    second = rig.rows[1].model_copy(update={"identify": ("alpha", "a", "d", "theta", "beta")})
    return rig.model_copy(update={"rows": (rig.rows[0], second, *rig.rows[2:])})


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(
    ("known", "parameters", "rank"),
    [(("base", "prism"), 38, 34), (("prism",), 44, 35), ((), 56, 44)],
    ids=["base and prisms known", "base free", "prisms free too"],
)
def test_the_booms_redundancies_are_found(known: tuple[str, ...], parameters: int, rank: int, seed: int) -> None:
    chain, samples = uniform_samples(shipped_rig("swdt82"), seed=seed)
    free = np.array([p.kind not in known for p in chain.parameters])
    found = identifiability(chain, samples, np.zeros(len(chain)), 0.0, free=free)
    assert (found.parameters, found.rank) == (parameters, rank)
    assert len(found.unidentifiable) == parameters - rank


def test_a_model_is_judged_where_it_was_fitted_and_keeps_the_booms_redundancies(session: Session) -> None:
    model = session.model
    samples = averaged(model.chain, session.training)
    fitted = identifiability(model.chain, samples, model.values, model.excess_sigma_mm**2)
    nominal = identifiability(model.chain, samples, model.nominal_values, model.excess_sigma_mm**2)
    assert model.identifiability.observability == pytest.approx(dict(fitted.observability), rel=1e-9)
    assert model.identifiability.observability != pytest.approx(dict(nominal.observability), rel=1e-4)
    assert (model.identifiability.parameters, model.identifiability.rank) == (56, 44)


def test_the_second_papers_redundancies_are_found_and_named() -> None:
    found = seen(shipped_rig("ys100"))
    assert (found.parameters, found.rank) == (32, 27)
    assert found.unidentifiable == (
        "row1.theta repeats base.rz: the offset of theta1 repeats the attitude of the base",
        "row1.d repeats base.z: d at row 1 repeats the place of the base",
        "row3.d repeats row2.d: d at row 3 repeats d at row 2",
        "row6.theta repeats prism.tool.y and prism.tool.x: the offset of theta6 repeats the place of prism tool",
        "row6.d repeats prism.tool.z: d at row 6 repeats the place of prism tool",
    )


def test_beta_at_row_2_is_said_to_repeat_the_offset_of_theta3() -> None:
    rig = with_beta_at_row_2(shipped_rig("swdt82"))
    found = seen(rig)
    assert (found.parameters, found.rank) == (57, 44)
    assert "row2.beta repeats row3.theta: beta at row 2 repeats the offset of theta3" in found.unidentifiable
    assert "row2.beta" in found.marked
    assert not any("row2.beta" in sentence for sentence in seen(shipped_rig("swdt82")).unidentifiable)


def test_what_stays_at_its_prior_is_marked_and_what_the_data_determine_is_not() -> None:
    marked = seen(shipped_rig("swdt82")).marked
    # A base whose place is unknown takes up what row 1 is off; row 1 stays at its prior.
    assert {"row1.a", "row1.d", "row4.d", "row5.d", "row9.theta"} <= set(marked)
    assert not {"base.x", "row4.theta", "row4.a", "row7.theta", "row1.beta", "prism.w.z"} & set(marked)


def test_a_prism_that_was_never_measured_is_named_with_the_rows_only_it_would_show() -> None:
    chain, samples = uniform_samples(shipped_rig("swdt82"))
    wanted = [chain.rig.prism_names.index(name) for name in ("w", "b")]
    fewer = rows(samples, np.isin(samples.data.prism, wanted))
    found = identifiability(chain, fewer, np.zeros(len(chain)), 0.0)
    assert "prism.r.x: the data show nothing about x of prism r: prism r was not measured" in found.unidentifiable
    assert "row7.d: the data show nothing about d at row 7: no prism beyond row 7 was measured" in found.unidentifiable
    assert len(found.unidentifiable) == found.parameters - found.rank
    assert {"prism.r.x", "prism.s.z", "row7.d", "row9.alpha"} <= set(found.marked)


def test_a_joint_that_never_moved_is_named_as_the_reason_where_moving_it_would_help() -> None:
    chain, samples = uniform_samples(shipped_rig("swdt82"))
    moving = identifiability(chain, samples, np.zeros(len(chain)), 0.0)
    joint = chain.rig.joint_names.index("theta7")
    noise = np.random.default_rng(1).normal(0.0, 0.005, len(samples))
    samples.data.readings[:, joint] = -100.0 + noise  # an encoder at rest still twitches
    still = identifiability(chain, samples, np.zeros(len(chain)), 0.0)
    assert still.rank < moving.rank
    new = [s for s in still.unidentifiable if s.endswith(", as theta7 never moved")]
    assert len(new) >= moving.rank - still.rank
    assert not any("never moved" in sentence for sentence in moving.unidentifiable)


def test_a_set_up_has_a_base_of_its_own_and_is_named() -> None:
    chain, samples = uniform_samples(shipped_rig("ys100"), setups=("a", "b"))
    found = identifiability(chain, samples, np.zeros(len(chain)), 0.0)
    assert (found.parameters, found.rank) == (38, 33)
    # What repeats the base repeats it at all of them: once is enough.
    assert any(sentence.endswith(": d at row 1 repeats the place of the base") for sentence in found.unidentifiable)
    one = rows(samples, samples.data.setup == 0)
    sentences = identifiability(chain, one, np.zeros(len(chain)), 0.0).unidentifiable
    assert "base[b].x: the data show nothing about x of the base at set-up 'b': set-up 'b' has no fixes" in sentences


def additions(names: tuple[str, ...], joint: int, columns: np.ndarray) -> EffectColumns:
    return EffectColumns(names, np.full(len(names), joint), columns, np.full(len(names), 0.1))


def test_coefficients_of_effects_join_the_analysis() -> None:
    rig = shipped_rig("ys100")
    chain, samples = uniform_samples(rig)
    angle = np.radians(samples.data.readings[:, 1])
    names = ("encoder_harmonic@theta2:sine", "angle_scale@theta2:zero", "backlash@theta2:gap")
    columns = np.column_stack([np.sin(angle), np.ones(len(angle)), np.zeros(len(angle))])
    more = additions(names, 1, columns)
    found = identifiability(chain, samples, np.zeros(len(chain)), 0.0, additions=more)
    # The sine is seen; a constant is the offset itself, and what never changes a reading is not seen.
    assert (found.parameters, found.rank) == (35, 28)
    (repeat,) = [s for s in found.unidentifiable if "angle_scale" in s]
    assert "row2.theta" in repeat
    assert repeat.endswith(("zero of angle_scale at theta2", "the offset of theta2"))
    assert "backlash@theta2:gap: the data show nothing about gap of backlash at theta2" in found.unidentifiable
    assert "encoder_harmonic@theta2:sine" not in found.marked


def test_coefficients_that_are_not_zero_move_the_point_of_linearisation() -> None:
    rig = shipped_rig("ys100")
    chain, samples = uniform_samples(rig)
    more = additions(("joint_error_map@theta2:all",), 1, np.ones((len(samples), 1)))
    shifted = samples.data.readings.copy()
    shifted[:, 1] += 25.0
    other = replace(samples, data=replace(samples.data, readings=shifted))
    at = np.append(np.zeros(len(chain)), 25.0)
    near = identifiability(chain, samples, at, 0.0, additions=more).observability
    same = identifiability(chain, other, np.zeros(len(chain)), 0.0, additions=more).observability
    assert near == pytest.approx(same)


def test_fewer_fixes_than_parameters_leave_the_rest_unseen() -> None:
    chain, samples = uniform_samples(shipped_rig("swdt82"), n=8)
    found = identifiability(chain, samples, np.zeros(len(chain)), 0.0)
    assert found.rank <= 24
    assert len(found.unidentifiable) == 56 - found.rank


def test_observability_indices_are_those_of_their_authors() -> None:
    indices = observability_indices(np.array([8.0, 2.0, 0.5]), 16)
    assert indices == pytest.approx({"O1": 2.0 / 4.0, "O2": 0.5 / 8.0, "O3": 0.5, "O4": 0.25 / 8.0, "O5": 1.0 / 2.625})
    assert observability_indices(np.zeros(0), 16) == {}


def test_poses_within_a_corner_of_the_limits_are_less_observable() -> None:
    chain, samples = uniform_samples(shipped_rig("ys100"))
    wide = identifiability(chain, samples, np.zeros(len(chain)), 0.0).observability
    samples.data.readings[:] *= 0.2
    narrow = identifiability(chain, samples, np.zeros(len(chain)), 0.0).observability
    assert all(narrow[name] < wide[name] for name in wide)


def test_the_json_object_has_the_contracts_keys_first() -> None:
    answer = seen(shipped_rig("ys100")).as_dict()
    assert list(answer)[:3] == ["parameters", "rank", "unidentifiable"]
    assert list(answer)[3:] == ["marked", "observability"]
