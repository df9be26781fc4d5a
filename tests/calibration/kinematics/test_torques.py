"""Gravity's load on the joints: the slope of potential energy, the simulated machine's own load, measured torques."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.kinematics.chain import Chain, Placement
from calibration.kinematics.torques import STANDARD_GRAVITY, gravity_torques, loaded_joints, torque_columns
from calibration.observations import Floats, Observations
from calibration.rig.description import Rig, parse_rig, shipped_rig
from simulators.rig.truth import RigTruth

RIGS = Path(__file__).parents[2] / "rigs"
BRANCHING = """
[[mass]]
name = "chest"
frame = 4
kg = 30
centre_mm = [20, 10, 200]
[[mass]]
name = "left upper arm"
frame = 5
kg = 4
midway = true
[[mass]]
name = "left hand"
frame = 6
kg = 2
centre_mm = [250, 0, 30]
payload = true
[[mass]]
name = "right forearm"
frame = 8
kg = 3
centre_mm = [150, 5, 0]
"""


def branching_rig() -> Rig:
    return parse_rig((RIGS / "torso.toml").read_text(encoding="utf-8") + BRANCHING, "torso.toml")


def poses(rig: Rig, n: int, seed: int = 0, **extra: Floats) -> Observations:
    rng = np.random.default_rng(seed)
    blank = np.full(n, "", dtype=np.str_)
    return Observations(
        prism=np.full(n, rig.prism_names[0]),
        joints={j.name: rng.uniform(*j.limits, n) for j in rig.joints},
        position_mm=np.full((n, 3), np.nan),
        sigma_mm=np.full((n, 3), np.nan),
        setup=blank,
        session=blank,
        pose=blank,
        extra=extra,
    )


def perturbed(rig: Rig, seed: int = 1) -> tuple[Chain, Floats]:
    chain = Chain(rig, {"": Placement.identity()})
    sigma = np.where([p.kind == "base" for p in chain.parameters], 0.0, np.minimum(chain.prior_sigma, 5.0))
    return chain, np.random.default_rng(seed).normal(0.0, 1.0, len(chain)) * sigma


def energy_joule(chain: Chain, x: Floats, observations: Observations) -> Floats:
    """Potential energy of all masses, from places that the chain computes for points declared as prisms."""
    rig = chain.rig
    height_mm = np.zeros(len(observations))
    payload = observations.extra.get("payload_kg")
    for mass in rig.masses:
        ends = [(mass.frame, mass.centre_mm)] if mass.centre_mm else [(mass.frame + i, (0.0, 0.0, 0.0)) for i in (0, 1)]
        places = []
        for frame, offset in ends:
            point = rig.prisms[0].model_copy(update={"frame": frame, "offset_mm": offset})
            own = Chain(rig.model_copy(update={"prisms": (point,)}), chain.placements)
            rows = sum(p.kind == "row" for p in own.parameters)
            values = np.concatenate([x[:rows], np.zeros(len(own) - rows)])
            places.append(own.positions_mm(values, own.bind(observations)))
        up = -np.array(rig.gravity) / np.linalg.norm(rig.gravity)
        kg = payload if mass.payload and payload is not None else mass.kg
        height_mm += kg * (np.mean(places, axis=0) @ up)
    return STANDARD_GRAVITY * height_mm / 1e3


@pytest.mark.parametrize("rig", [shipped_rig(n) for n in ("swdt82", "ys100", "ur10")] + [branching_rig()])
def test_the_load_of_a_joint_is_the_falling_slope_of_potential_energy(rig: Rig) -> None:
    chain, x = perturbed(rig)
    table = poses(rig, 12, payload_kg=np.linspace(0.0, 300.0, 12))
    load = gravity_torques(chain, x, table)
    assert load.shape == (12, len(rig.joints))
    for index, joint in enumerate(rig.joints):
        step, unit = (1e-3, np.radians(1.0)) if joint.kind == "revolute" else (1e-1, 1e-3)

        def moved(by: float, name: str = joint.name) -> Observations:
            return replace(table, joints={**table.joints, name: table.joints[name] + by})

        slope = (energy_joule(chain, x, moved(step)) - energy_joule(chain, x, moved(-step))) / (2 * step * unit)
        np.testing.assert_allclose(load[:, index], -slope, rtol=1e-5, atol=1e-2)


@pytest.mark.parametrize("name", ["swdt82", "ys100", "ur10", "levers"])
def test_the_load_is_the_simulated_machines_own(name: str) -> None:
    own = RIGS / f"{name}.toml"
    rig = parse_rig(own.read_text(encoding="utf-8"), own.name) if own.exists() else shipped_rig(name)
    truth = RigTruth(rig, 4, perturbation=0.0)
    # The simulated base leans a little; the rig file of this test says so, so that both mean the same gravity.
    down = tuple(float(v) for v in truth.placement().rotation.T @ [0.0, 0.0, -1.0])
    chain = Chain(rig.model_copy(update={"gravity": down}), {"": Placement.identity()})
    table = poses(rig, 20)
    load = gravity_torques(chain, np.zeros(len(chain)), table)
    for index, joint in enumerate(rig.joint_names):
        np.testing.assert_allclose(load[:, index], truth.gravity_load(joint, table.joints), rtol=1e-9, atol=1e-6)


def test_where_the_base_stands_changes_no_load() -> None:
    rig = shipped_rig("ys100")
    table = poses(rig, 5)
    here = Chain(rig, {"": Placement.identity()})
    there = Chain(rig, {"A": Placement(np.eye(3)[[1, 0, 2]] * [[1], [1], [-1]], np.array([1e3, 2e3, 3e3]))})
    x = np.zeros(len(here))
    x[here.base_index(0)] = 0.3
    np.testing.assert_allclose(
        gravity_torques(here, np.zeros(len(here)), table), gravity_torques(there, x, table), atol=1e-9
    )


def test_a_payload_is_what_payload_kg_says_in_the_rows_that_have_it() -> None:
    rig = shipped_rig("ys100")
    chain = Chain(rig, {"": Placement.identity()})
    x = np.zeros(len(chain))
    heavy, light = (
        gravity_torques(chain, x, poses(rig, 6, payload_kg=np.array([kg] * 3 + [np.nan] * 3))) for kg in (220.0, 0.0)
    )
    usual = gravity_torques(chain, x, poses(rig, 6))
    np.testing.assert_allclose(heavy[3:], usual[3:])
    np.testing.assert_allclose((heavy + light)[:3] / 2, usual[:3], atol=1e-9)
    assert (np.abs(heavy - light)[:3, 1] > 100.0).all()


def test_measured_torques_take_the_place_of_computed_ones_row_by_row() -> None:
    rig = shipped_rig("ys100")
    chain = Chain(rig, {"": Placement.identity()})
    x = np.zeros(len(chain))
    measured = np.array([np.nan, 123.0, np.nan, -7.0])
    plain, mixed = (
        gravity_torques(chain, x, poses(rig, 4)),
        gravity_torques(chain, x, poses(rig, 4, theta2_Nm=measured)),
    )
    np.testing.assert_array_equal(mixed[[1, 3], 1], [123.0, -7.0])
    mixed[[1, 3], 1] = plain[[1, 3], 1]
    np.testing.assert_array_equal(mixed, plain)


def test_without_masses_only_measured_torques_are_known() -> None:
    rig = shipped_rig("ys100").model_copy(update={"masses": ()})
    chain = Chain(rig, {"": Placement.identity()})
    table = poses(rig, 3, theta2_Nm=np.array([5.0, 6.0, 7.0]), theta3_Nm=np.array([5.0, np.nan, 7.0]))
    load = gravity_torques(chain, np.zeros(len(chain)), table)
    np.testing.assert_array_equal(load[:, 1], [5.0, 6.0, 7.0])
    assert np.isnan(load[1, 2])
    assert np.isnan(load[:, [0, 3, 4, 5]]).all()
    assert loaded_joints(rig, load) == (1,)


def test_a_joint_about_the_vertical_carries_no_load_and_a_transducer_is_no_revolute_joint() -> None:
    ys100, boom = shipped_rig("ys100"), shipped_rig("swdt82")
    chain = Chain(ys100, {"": Placement.identity()})
    assert loaded_joints(ys100, gravity_torques(chain, np.zeros(len(chain)), poses(ys100, 9))) == (1, 2, 3, 4, 5)
    chain = Chain(boom, {"": Placement.identity()})
    turning = tuple(i for i, j in enumerate(boom.joints) if j.kind == "revolute" and j.name != "theta3")
    assert loaded_joints(boom, gravity_torques(chain, np.zeros(len(chain)), poses(boom, 9))) == turning


def test_torque_columns_say_joint_and_unit() -> None:
    names = torque_columns(shipped_rig("swdt82"))
    assert names[0] == "torque_theta1_Nm"
    assert "torque_L2_N" in names
    assert len(names) == 9
