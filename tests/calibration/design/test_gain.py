"""Expected accuracy from what is measured so far, and what the next poses bring."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.design.gain import LEAST_POSES, chosen_poses, from_rows, random_poses, reached, rms_mm, volume_share
from calibration.observations import Floats, Observations, parse_observations
from calibration.rig.description import shipped_rig
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

RIG = shipped_rig("swdt82")
TRUTH = RigTruth(RIG, 5)


def csv_text(poses: Floats, setup: str, prism: str) -> str:
    held = dict(zip(RIG.joint_names, poses.T, strict=True))
    data = simulate_observations(
        TRUTH, len(poses), 7, poses=held, prisms=[prism], repeats=3, setup=setup, session=f"s-{setup}-{prism}"
    )
    return data.csv_text()


def rows(poses: Floats, setup: str = "S1") -> Observations:
    return parse_observations(csv_text(poses, setup, "r").encode(), RIG, "simulated.csv")


@pytest.fixture(scope="module")
def poses() -> Floats:
    return chosen_poses(from_rows(RIG, None, "S1"), "r", 20, 1)


def test_few_poses_do_not_tell_where_the_station_stands(poses: Floats) -> None:
    assert not from_rows(RIG, None, "S1").is_placed
    assert not from_rows(RIG, rows(poses[: LEAST_POSES - 1]), "S1").is_placed
    assert from_rows(RIG, rows(poses[:LEAST_POSES]), "S1").is_placed


def test_what_the_next_poses_are_said_to_bring_they_bring(poses: Floats) -> None:
    before = from_rows(RIG, rows(poses[:15]), "S1")
    foretold = rms_mm(before.accuracy(before.after(poses[15:], "r")), ("r",))
    now = rms_mm(before.accuracy(), ("r",))
    after = rms_mm(from_rows(RIG, rows(poses), "S1").accuracy(), ("r",))
    assert after < now
    assert foretold == pytest.approx(after, rel=0.35)


def test_chosen_poses_bring_more_than_as_many_at_random(poses: Floats) -> None:
    chosen = from_rows(RIG, rows(poses), "S1")
    at_random = from_rows(RIG, rows(random_poses(chosen, "r", len(poses), 3)), "S1")
    assert rms_mm(chosen.accuracy(), ("r",)) < rms_mm(at_random.accuracy(), ("r",))


@pytest.mark.long
def test_poses_are_inside_the_limits_and_the_same_for_the_same_seed(poses: Floats) -> None:
    low, high = np.array([joint.limits for joint in RIG.joints]).T
    assert poses.shape == (20, len(RIG.joints))
    assert ((poses >= low) & (poses <= high)).all()
    assert np.array_equal(poses, chosen_poses(from_rows(RIG, None, "S1"), "r", 20, 1))


def test_what_other_set_ups_told_of_the_machine_is_known_at_a_new_one(poses: Floats) -> None:
    fresh, known = from_rows(RIG, None, "S2"), from_rows(RIG, rows(poses), "S2")
    assert not known.is_placed
    body = known.knowledge.chain.base_start
    spread = [np.diag(m.knowledge.root @ m.knowledge.root.T)[:body].sum() for m in (fresh, known)]
    assert spread[1] < 0.8 * spread[0]
    assert not np.allclose(known.knowledge.x[:body], 0.0)


def test_a_prism_far_off_is_learned_beside_one_that_fits_well() -> None:
    volume = from_rows(RIG, None, "S1").volume
    inner, outer = csv_text(volume[:90], "S1", "w"), csv_text(volume[100:108], "S1", "b")
    text = inner + outer.partition("\n")[2]
    both = from_rows(RIG, parse_observations(text.encode(), RIG, "simulated.csv"), "S1")
    assert rms_mm(both.accuracy(), ("b",)) < 5.0


def test_coverage_is_the_share_of_the_work_volume_inside_all_ranges() -> None:
    volume = from_rows(RIG, None, "S1").volume
    whole = {joint.name: joint.limits for joint in RIG.joints}
    assert volume_share(volume, whole) == 1.0
    half = whole | {"theta1": (whole["theta1"][0], float(np.median(volume[:, 0])))}
    assert volume_share(volume, half) == pytest.approx(0.5, abs=0.01)
    assert reached(RIG, volume)["L2"][1] <= RIG.joints[-2].limits[1]
