"""Gravity loads on every joint by the virtual work of the machine's weights, for any rig with masses.

The second paper's Eqs. 9-11 (ICIC 2020): the torque of joint i is the sum over the masses that it carries of
(z_i x l_ij) . F_j, where (z_i x l_ij) is the derivative of the position of mass j by the joint. So the loads are
J_q' F, with the Jacobian of the masses' positions by the readings. This is also valid for couplings, prismatic joints
and branching rows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from calibration.kinematics import chain_loops
from calibration.kinematics.chain import Chain
from calibration.observations import Floats, Observations
from calibration.rig.description import Rig

STANDARD_GRAVITY = 9.80665  # m/s^2
MASS_SIGMA = 0.15 / math.sqrt(3.0)  # masses and centres of gravity in a rig file are accurate to +-15 %
_LEAST_LOAD = 1e-6  # of the largest load; a joint with less than this in every pose counts as unloaded
_LEVEL = math.cos(math.radians(10.0))  # a station's frame farther from the rig file's vertical is not levelled


class GravityModel:
    """Gravity loads on the joints of a machine with fixed parameters; build it once and evaluate any rows.

    Args:
        chain: kinematics; the placements of its bases affect `down` alone.
        x: (p,) parameters of the chain.

    Attributes:
        direction: (1, 3) unit vector of gravity in the base frame, from the rig file.
        down: (setups, 3) the same at each set-up, as given by a levelled station.
        point_frame: (points,) frame of every point at which a weight acts.
        point_mass: (points,) index of the mass at each point.
    """

    def __init__(self, chain: Chain, x: Floats) -> None:
        rig = chain.rig
        frames, self._offsets_mm, self._share = _points(rig)
        self.point_frame = np.array(frames, dtype=np.intp)
        self.point_mass = self._share.argmax(axis=0) if rig.masses else np.empty(0, dtype=np.intp)
        self.direction = np.array([rig.gravity]) / np.linalg.norm(rig.gravity)
        self.down = np.array([self._down(base) for base in chain.bases(x)]).reshape(-1, 3)
        self._transforms, _ = chain.tables(x)
        self._measured = [(i, f"{j.name}_Nm") for i, j in enumerate(rig.joints) if j.kind == "revolute"]
        self._has_centre = [mass.centre_mm is not None and any(mass.centre_mm) for mass in rig.masses]
        self._weights = STANDARD_GRAVITY * np.array([[mass.kg for mass in rig.masses]])
        self._payload = np.array([mass.payload for mass in rig.masses], dtype=bool)
        # N mm per deg of a reading are 180 / pi N mm per rad; N mm per mm are N.
        self._unit = np.array([math.degrees(1.0) / 1e3 if j.kind == "revolute" else 1.0 for j in rig.joints])

    def places(self, readings: Floats, extra: Mapping[str, Floats]) -> tuple[Floats, Floats]:
        """Return positions and sizes of the weights; there are no points if the rig has no masses.

        Args:
            readings: as for a call.
            extra: as for a call.

        Returns:
            (n, points, 3) positions in the base frame, mm, and (n, points) weights, N.
        """
        places_mm = np.empty((len(readings), len(self.point_frame), 3))
        chain_loops.places(
            np.ascontiguousarray(readings), self._transforms, self.point_frame, self._offsets_mm, places_mm
        )
        force = self._newton(extra) @ self._share
        return places_mm, np.broadcast_to(force, (len(readings), force.shape[1]))

    def parts(self, readings: Floats, extra: Mapping[str, Floats], down: Floats | None = None) -> Floats:
        """Return the changes of the loads if one mass, or the distance of one centre, is larger by `MASS_SIGMA`.

        The masses in a rig file are rarely measured. The changes are zero where the torque is measured.

        Args:
            readings: as for a call.
            extra: as for a call.
            down: as for a call.

        Returns:
            (n, joints, parts) changes, N m or N.
        """
        newton = self._newton(extra)
        out = [np.empty((*readings.shape, 0))]
        for mass, share in enumerate(self._share):
            force = newton[:, [mass]] * share
            whole = self._loads(readings, force, down, self._offsets_mm)
            out.append(MASS_SIGMA * whole[:, :, None])
            if self._has_centre[mass]:
                at_origins = self._loads(readings, force, down, np.zeros_like(self._offsets_mm))
                out.append(MASS_SIGMA * (whole - at_origins)[:, :, None])
        parts = np.concatenate(out, axis=2)
        for index, column in self._measured:
            measured = extra.get(column)
            if measured is not None:
                parts[np.isfinite(measured), index] = 0.0
        return parts

    def __call__(self, readings: Floats, extra: Mapping[str, Floats], down: Floats | None = None) -> Floats:
        """Return the (n, joints) loads, as `gravity_torques` describes them.

        Args:
            readings: (n, joints) deg or mm.
            extra: optional columns of the rows, of which `payload_kg` and `<name>_Nm` are used.
            down: (n, 3) unit vectors of gravity in the base frame; the rig file's by default.
        """
        if len(self._share):
            load = self._loads(readings, self._newton(extra) @ self._share, down, self._offsets_mm)
        else:
            load = np.full(readings.shape, np.nan)
        for index, column in self._measured:
            measured = extra.get(column)
            if measured is not None:
                load[:, index] = np.where(np.isfinite(measured), measured, load[:, index])
        return load

    def _loads(self, readings: Floats, force: Floats, down: Floats | None, offsets_mm: Floats) -> Floats:
        """Return the (n, joints) loads due to forces at the points, N m or N.

        Args:
            readings: (n, joints) deg or mm.
            force: (n, points) forces, N; (1, points) if equal in all rows.
            down: (n, 3) direction of the forces; the rig file's by default.
            offsets_mm: (points, 3) offsets of the points in their frames.
        """
        work = np.empty(readings.shape)
        along = np.ascontiguousarray(self.direction if down is None else down)
        plain, force = np.ascontiguousarray(readings), np.ascontiguousarray(force)
        chain_loops.work(plain, force, along, *self._transforms, self.point_frame, offsets_mm, work)
        work *= self._unit
        return work

    def _down(self, base: Floats) -> Floats:
        """Return gravity (3,) in the frame of a base (7, 3).

        As the station is levelled, the identified base shows the tilt of the machine; loads near a change of sign
        depend on tenths of a degree. If the station's frame is not level, the direction of the rig file is used.
        """
        plumb, by_file = -base[2], self.direction[0]
        down: Floats = plumb if plumb @ by_file >= _LEVEL else by_file
        return down

    def _newton(self, extra: Mapping[str, Floats]) -> Floats:
        """Return the weights (n, masses) with the payload of each row; (1, masses) if there is no payload column."""
        payload = extra.get("payload_kg")
        if payload is None:
            return self._weights
        loaded = self._payload & np.isfinite(payload)[:, None]
        return np.where(loaded, STANDARD_GRAVITY * payload[:, None], self._weights)


def gravity_torques(chain: Chain, x: Floats, observations: Observations) -> Floats:
    """Return the generalised forces of gravity (n, joints) in the rig's order: N m (revolute) or N (prismatic).

    The sign is that of the load: tau = -dE/dq of the potential energy, so a positive load increases the joint's value.
    The load of a joint that drives several rows is the sum over these. The direction of gravity in the base frame is
    from the rig file. The payload is `payload_kg` in rows that have it. Measured torques (`<name>_Nm`, of revolute
    joints, with the same sign) replace computed ones row by row.

    Args:
        chain: kinematics; the placements of its bases are not used.
        x: (p,) parameters of the chain.
        observations: n rows.

    Returns:
        (n, joints) loads; NaN where a torque is not measured and cannot be computed without masses.
    """
    readings = np.array([observations.joints[name] for name in chain.joint_index]).T
    return GravityModel(chain, x)(readings, observations.extra)


def loaded_joints(rig: Rig, torques: Floats) -> tuple[int, ...]:
    """Return the indices of revolute joints whose torque (n, joints) is known in every row and not always zero."""
    known = np.isfinite(torques).all(axis=0)
    turning = np.array([joint.kind == "revolute" for joint in rig.joints])
    most = np.abs(np.where(known, torques, 0.0)).max(axis=0, initial=0.0)
    loaded = known & turning & (most > _LEAST_LOAD * most[turning].max(initial=0.0))
    return tuple(np.flatnonzero(loaded).tolist())


def torque_columns(rig: Rig) -> tuple[str, ...]:
    """Return the names of the joints' loads as columns: `torque_theta1_Nm`, `torque_L2_N`."""
    return tuple(f"torque_{j.name}_{'Nm' if j.kind == 'revolute' else 'N'}" for j in rig.joints)


def _points(rig: Rig) -> tuple[list[int], Floats, Floats]:
    """Return the points at which the masses act: frames, (m, 3) offsets in them, and (masses, m) share of each mass.

    Half of a mass midway between two origins is put at each origin, which has the same weight, moment and energy.
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
    offsets_mm = np.array([place[1] for place in places], dtype=np.float64).reshape(-1, 3)
    return [place[0] for place in places], offsets_mm, share
