"""Gravity's load on every joint: the virtual work of the machine's weights, for any rig with masses.

The second paper's Eqs. 9-11 (ICIC 2020): the torque of joint i is the sum over the masses that it carries of
(z_i x l_ij) . F_j, and (z_i x l_ij) is what the joint does to the place of mass j. So the loads are J_q' F, with a
Jacobian of the masses' places by the readings, which holds for couplings, prismatic joints and branching rows too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from calibration.kernels.machine import Carrier
from calibration.kinematics import Chain, Placement
from calibration.observations import Floats, Observations
from calibration.rig import Rig

STANDARD_GRAVITY = 9.80665  # m/s^2
MASS_SIGMA = 0.15 / math.sqrt(3.0)  # a rig file's masses and centres of gravity are within +-15 % of the machine's
_LEAST_LOAD = 1e-6  # of the largest load; a joint with less than this in every pose carries nothing
_LEVEL = math.cos(math.radians(10.0))  # a station's frame that is further off the rig file's vertical is not levelled


class GravityLoads:
    """Gravity's load on the joints of a machine whose parameters stay; build it once and ask for any rows.

    Args:
        chain: kinematics; where its bases stand counts in `down` alone.
        x: (p,) its parameters.

    Attributes:
        direction: (1, 3) unit vector of gravity in the base frame, as the rig file has it.
        down: (setups, 3) the same at each set-up, by a levelled station.
        point_frame, point_mass: (points,) of every point at which weight hangs its frame and the index of its mass.
    """

    def __init__(self, chain: Chain, x: Floats) -> None:
        rig = chain.rig
        frames, offsets_mm, share = _points(rig)
        self.point_frame = np.array(frames, dtype=np.intp)
        self.point_mass = share.argmax(axis=0) if rig.masses else np.empty(0, dtype=np.intp)
        self.direction = np.array([rig.gravity]) / np.linalg.norm(rig.gravity)
        self.down = np.array([self._down(chain.base(x, setup)) for setup in range(len(chain.setups))]).reshape(-1, 3)
        self._measured = [(i, f"{j.name}_Nm") for i, j in enumerate(rig.joints) if j.kind == "revolute"]
        self._carrier: Carrier | None = None
        self._origins: Carrier | None = None
        if not rig.masses:
            return
        self._carrier = Carrier(chain, x, frames, offsets_mm)
        self._origins = Carrier(chain, x, frames, np.zeros_like(offsets_mm))
        self._has_centre = [mass.centre_mm is not None and any(mass.centre_mm) for mass in rig.masses]
        self._share_newton = STANDARD_GRAVITY * share
        self._kilograms = np.array([[mass.kg for mass in rig.masses]])
        self._payload = np.array([mass.payload for mass in rig.masses])
        # N mm per deg of a reading are 180 / pi N mm per rad; N mm per mm are N.
        self._unit = np.array([math.degrees(1.0) / 1e3 if j.kind == "revolute" else 1.0 for j in rig.joints])

    def places(self, readings: Floats, extra: Mapping[str, Floats]) -> tuple[Floats, Floats]:
        """(n, points, 3) where the weights hang, mm in the base frame; (n, points) how heavy they are, N.

        No points where the rig has no masses.

        Args:
            readings, extra: as for a call.
        """
        if self._carrier is None:
            return np.empty((len(readings), 0, 3)), np.empty((len(readings), 0))
        force = self._kilograms_of(extra) @ self._share_newton
        return self._carrier.places_mm(readings), np.broadcast_to(force, (len(readings), force.shape[1]))

    def parts(self, readings: Floats, extra: Mapping[str, Floats], down: Floats | None = None) -> Floats:
        """(n, joints, parts) change of the loads when one mass, or one centre's distance, is `MASS_SIGMA` larger.

        The weights that a rig file gives are rarely weighed. Zero where the torque is measured.

        Args:
            readings, extra, down: as for a call.
        """
        if self._carrier is None or self._origins is None:
            return np.empty((*readings.shape, 0))
        along = self.direction if down is None else down
        newton = STANDARD_GRAVITY * self._kilograms_of(extra)
        out = []
        for mass, share in enumerate(self._share_newton / STANDARD_GRAVITY):
            force = newton[:, [mass]] * share
            whole = self._carrier.work(readings, force, along) * self._unit
            out.append(MASS_SIGMA * whole)
            if self._has_centre[mass]:
                out.append(MASS_SIGMA * (whole - self._origins.work(readings, force, along) * self._unit))
        parts = np.stack(out, axis=2)
        for index, column in self._measured:
            measured = extra.get(column)
            if measured is not None:
                parts[np.isfinite(measured), index] = 0.0
        return parts

    def _down(self, base: Placement) -> Floats:
        """(3,) gravity in the base frame.

        The station is levelled, so that the base as found tells how the machine leans; loads that are about to change
        their sign depend on tenths of a degree. The rig file says where gravity points in a frame that is not level.
        """
        plumb, by_file = -base.rotation[2], self.direction[0]
        down: Floats = plumb if plumb @ by_file >= _LEVEL else by_file
        return down

    def _kilograms_of(self, extra: Mapping[str, Floats]) -> Floats:
        """(n, masses) with the payload of each row; (1, masses) where none is known."""
        payload = extra.get("payload_kg")
        if payload is None:
            return self._kilograms
        return np.where(self._payload & np.isfinite(payload)[:, None], payload[:, None], self._kilograms)

    def __call__(self, readings: Floats, extra: Mapping[str, Floats], down: Floats | None = None) -> Floats:
        """(n, joints) loads, as `gravity_torques` describes them.

        Args:
            readings: (n, joints) deg or mm.
            extra: optional columns of the rows; `payload_kg` and `<name>_Nm` count.
            down: (n, 3) unit vectors of gravity in the base frame; the rig file's by default.
        """
        if self._carrier is None:
            load = np.full(readings.shape, np.nan)
        else:
            along = self.direction if down is None else down
            load = self._carrier.work(readings, self._kilograms_of(extra) @ self._share_newton, along) * self._unit
        for index, column in self._measured:
            measured = extra.get(column)
            if measured is not None:
                load[:, index] = np.where(np.isfinite(measured), measured, load[:, index])
        return load


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
    readings = np.array([observations.joints[name] for name in chain.joint_index]).T
    return GravityLoads(chain, x)(readings, observations.extra)


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


def _points(rig: Rig) -> tuple[list[int], Floats, Floats]:
    """Points at which the masses hang: their frames, (m, 3) places in them, and (masses, m) the share of each mass.

    A mass midway between two origins is half at each: that has the same weight, moment and energy.
    """
    origin = (0.0, 0.0, 0.0)
    places: list[tuple[int, tuple[float, float, float], int, float]] = []
    for index, mass in enumerate(rig.masses):
        if mass.centre_mm is not None:
            places.append((mass.frame, mass.centre_mm, index, 1.0))
        else:
            places += [(mass.frame, origin, index, 0.5), (mass.frame + 1, origin, index, 0.5)]
    share = np.zeros((len(rig.masses), len(places)))
    for point, (_, _, index, part) in enumerate(places):
        share[index, point] = part
    return [place[0] for place in places], np.array([place[1] for place in places]), share
