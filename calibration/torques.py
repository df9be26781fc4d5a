"""Gravity's load on every joint: the virtual work of the machine's weights, for any rig with masses.

The second paper's Eqs. 9-11 (ICIC 2020): the torque of joint i is the sum over the masses that it carries of
(z_i x l_ij) . F_j, and (z_i x l_ij) is what the joint does to the place of mass j. So the loads are J_q' F, with a
Jacobian of the masses' places by the readings, which holds for couplings, prismatic joints and branching rows too.
"""

from __future__ import annotations

import math

import numpy as np

from calibration.kernels.lineariser import Lineariser
from calibration.kinematics import Chain, ChainData, Placement
from calibration.observations import Floats, Observations
from calibration.rig import Prism, Rig

STANDARD_GRAVITY = 9.80665  # m/s^2
_LEAST_LOAD = 1e-6  # of the largest load; a joint with less than this in every pose carries nothing


def gravity_torques(chain: Chain, x: Floats, observations: Observations) -> Floats:
    """(n, joints) generalised force of gravity on every joint, in the rig's order: N m (revolute) or N (prismatic).

    Its sign is that of the load: tau = -dE/dq of the potential energy, so a positive one drives the joint's value up.
    A joint that drives several rows has the sum. Gravity points as the rig file says, in the base frame; the payload
    weighs `payload_kg` in the rows that have it. Measured torques (`<name>_Nm`, of revolute joints, with the same sign)
    take the place of computed ones row by row.

    Args:
        chain: kinematics; where its bases stand plays no part.
        x: (p,) its parameters.
        observations: n rows.

    Returns:
        NaN where a torque is neither measured nor, for want of masses, to be computed.
    """
    rig = chain.rig
    readings = np.column_stack([observations.joints[name] for name in rig.joint_names])
    load = _computed(chain, x, readings, observations) if rig.masses else np.full(readings.shape, np.nan)
    for index, joint in enumerate(rig.joints):
        measured = observations.extra.get(f"{joint.name}_Nm")
        if joint.kind == "revolute" and measured is not None:
            load[:, index] = np.where(np.isfinite(measured), measured, load[:, index])
    return load


def loaded_joints(rig: Rig, torques: Floats) -> tuple[int, ...]:
    """Indices of the revolute joints whose torque (n, joints) is known in every row and not zero throughout."""
    known = np.isfinite(torques).all(axis=0)
    turning = np.array([joint.kind == "revolute" for joint in rig.joints])
    most = np.abs(np.where(known, torques, 0.0)).max(axis=0, initial=0.0)
    loaded = known & turning & (most > _LEAST_LOAD * most[turning].max(initial=0.0))
    return tuple(np.flatnonzero(loaded).tolist())


def torque_columns(rig: Rig) -> tuple[str, ...]:
    """Names that the joints' loads have as columns: `torque_theta1_Nm`, `torque_L2_N`."""
    return tuple(f"torque_{j.name}_{'Nm' if j.kind == 'revolute' else 'N'}" for j in rig.joints)


def _computed(chain: Chain, x: Floats, readings: Floats, observations: Observations) -> Floats:
    """(n, joints) loads by the masses of the rig."""
    rig = chain.rig
    direction = np.array(rig.gravity) / np.linalg.norm(rig.gravity)
    weight_newton = STANDARD_GRAVITY * _kilograms(rig, observations)
    points, mass_of = _points(rig)
    body = Chain(rig.model_copy(update={"prisms": points}), {"": Placement.identity()})
    rows = sum(p.kind == "row" for p in chain.parameters)
    own = np.concatenate([x[:rows], np.zeros(len(body) - rows)])
    setup = np.zeros(len(readings), dtype=np.intp)
    load = np.zeros(readings.shape)
    linearise = Lineariser(body)
    for point, (mass, share) in enumerate(mass_of):
        by_joint = linearise(own, ChainData(readings, setup + point, setup)).joint_jacobian
        lowered = by_joint.transpose(0, 2, 1) @ direction
        load += share * weight_newton[:, [mass]] * lowered
    # N mm per deg of a reading are 180 / pi N mm per rad; N mm per mm are N.
    return load * [math.degrees(1.0) / 1e3 if j.kind == "revolute" else 1.0 for j in rig.joints]


def _kilograms(rig: Rig, observations: Observations) -> Floats:
    """(n, masses) what each mass of the rig weighs in each row."""
    kg = np.tile([mass.kg for mass in rig.masses], (len(observations), 1))
    payload = observations.extra.get("payload_kg")
    if payload is not None:
        carried = np.array([mass.payload for mass in rig.masses])
        kg = np.where(carried & np.isfinite(payload)[:, None], payload[:, None], kg)
    return kg


def _points(rig: Rig) -> tuple[tuple[Prism, ...], tuple[tuple[int, float], ...]]:
    """Points of the machine, and which mass hangs at each with which share.

    A mass midway between two origins is half at each: that has the same weight, moment and energy.
    """
    places: list[tuple[int, tuple[float, float, float]]] = []
    shares: list[tuple[int, float]] = []
    for index, mass in enumerate(rig.masses):
        if mass.centre_mm is not None:
            places.append((mass.frame, mass.centre_mm))
            shares.append((index, 1.0))
        else:
            places += [(mass.frame, (0.0, 0.0, 0.0)), (mass.frame + 1, (0.0, 0.0, 0.0))]
            shares += [(index, 0.5), (index, 0.5)]
    points = tuple(Prism(name=f"mass{i}", frame=frame, offset_mm=place) for i, (frame, place) in enumerate(places))
    return points, tuple(shares)
