"""The inputs of effects: a machine, its observations, and quantities derived from both."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.kinematics.chain import Chain, ChainData
from calibration.kinematics.compiled_chain import CompiledChain, Facing, Located
from calibration.kinematics.torques import GravityModel
from calibration.numerics.statistics import halton
from calibration.observations import Floats, Observations
from calibration.rig.description import Rig

_VOLUME_POSES = 256
_LEAST_LOAD = 1e-6  # share of the largest load on any revolute joint below which a load is rounding error
_LEAST_NM = 1e-6  # smallest load: a milligram on a lever of 100 mm
_LEAST_RANGE_MM = 1e-6
_STEEP = 0.9  # cosine; an axis closer to the vertical has no well-defined level direction


@dataclass(frozen=True)
class EffectContext:
    """A machine and n observations of it; its properties are computed on first use and cached.

    Attributes:
        chain: kinematics.
        x: (p,) parameters of the chain. The base's tilt against the station's vertical affects the loads.
        observations: n rows.
        prepared_loads: the weights of `chain` at `x`, if computed before.
        prepared_machine: `chain` compiled at `x`, if compiled before.
        levelled: True if gravity is along the station's vertical; otherwise it is as in the rig file.
    """

    chain: Chain
    x: Floats
    observations: Observations
    prepared_loads: GravityModel | None = None
    prepared_machine: CompiledChain | None = None
    levelled: bool = True

    def __len__(self) -> int:
        return len(self.observations)

    @property
    def rig(self) -> Rig:
        """The rig description."""
        return self.chain.rig

    # -- columns of the observations -----------------------------------------------------------------------------------

    def reading(self, joint: str) -> Floats:
        """Return the (n,) readings of a joint, deg or mm."""
        return self.observations.joints[joint]

    def extra(self, column: str) -> Floats:
        """Return an optional column (n,), NaN where it was not measured."""
        measured = self.observations.extra.get(column)
        return np.full(len(self), np.nan) if measured is None else measured

    @cached_property
    def has_rates(self) -> NDArray[np.bool_]:
        """(n,) True if any joint rates are recorded; an empty rate then means that the joint stands still."""
        columns = (f"{name}_rate" for name in self.rig.joint_names)
        return np.full(len(self), any(column in self.observations.extra for column in columns))

    @cached_property
    def data(self) -> ChainData:
        """The observations bound to the chain."""
        return self.chain.bind(self.observations)

    # -- geometry from kinematics and readings, without any effect -----------------------------------------------------

    @cached_property
    def machine(self) -> CompiledChain:
        """The chain compiled at its parameters."""
        return self.prepared_machine or CompiledChain(self.chain, self.x)

    @cached_property
    def located(self) -> Located:
        """Positions of prisms and frames."""
        return self.machine.locate(self.data)

    @cached_property
    def facing(self) -> Facing:
        """Orientation of the prisms, and the displacement due to each drive of a row."""
        return self.machine.face(self.data)

    @cached_property
    def prism_frame(self) -> NDArray[np.intp]:
        """(n,) number of the frame on which each fix's prism is mounted."""
        frames = np.array([prism.frame for prism in self.rig.prisms], dtype=np.intp)
        return frames[self.data.prism]

    def rows_of_prism(self, prism: str) -> NDArray[np.bool_]:
        """Return an (n,) mask of the rows of one prism."""
        rows: NDArray[np.bool_] = self.data.prism == self.rig.prism_names.index(prism)
        return rows

    @cached_property
    def rotation(self) -> Floats:
        """(n, 3, 3) rotations from the base frame to the station's."""
        return self.machine.rotations(self.data)

    def to_station(self, vectors: Floats) -> Floats:
        """Transform vectors (n, 3, k) from the base frame to the station's frame."""
        return self.rotation @ vectors

    @cached_property
    def line_of_sight(self) -> Floats:
        """(n, 3) unit vectors from the instrument's centre to the prism, in the station's frame."""
        position_mm = self.located.position_mm
        range_mm = np.sqrt((position_mm**2).sum(axis=1))
        lines: Floats = position_mm / np.maximum(range_mm, _LEAST_RANGE_MM)[:, None]
        return lines

    @cached_property
    def velocity_mm_per_s(self) -> Floats:
        """(n, 3) velocity of the prism in the station's frame; a joint without a measured rate stands still."""
        rates = np.column_stack([self.extra(f"{name}_rate") for name in self.rig.joint_names])
        moved = self.located.joint_jacobian @ np.nan_to_num(rates)[:, :, None]
        return self.to_station(moved)[:, :, 0]

    def base_motion_mm(self, amount: Floats) -> Floats:
        """Return (n, 3, 3) displacements in the station's frame as the base tilts and rises by `amount` (n,).

        The columns are tilts about the level axes x and y through the base frame's origin, mm per rad, and a rise,
        mm per mm; see `level_axes`.
        """
        axes = level_axes(self.rig.gravity)
        place = self.located.prism_mm
        tilts = [np.cross(axis, place) for axis in axes[:2]]
        moved = np.stack([*tilts, np.tile(axes[2], (len(self), 1))], axis=2)
        return self.to_station(moved * amount[:, None, None])

    def mast_tilt_mm(self, share: float) -> Floats:
        """Return (n, 3, 2) displacements in the station's frame, mm per rad, as the mast tilts above a point of it.

        The columns are tilts about the level axes x and y through that point; see `level_axes`.

        Args:
            share: position of the point: 0 at the base frame's origin, 1 at the frame that the first joint moves.
        """
        first = self.rig.joint_names[0]
        moved_row = next(
            number for number, row in enumerate(self.rig.rows, 1) if any(first in drive for drive in row.drive.values())
        )
        lever_mm = self.located.prism_mm - share * self.located.frames_mm[:, moved_row]
        tilts = [np.cross(axis, lever_mm) for axis in level_axes(self.rig.gravity)[:2]]
        return self.to_station(np.stack(tilts, axis=2))

    def base_shift_mm(self, amount: Floats) -> Floats:
        """Return (n, 3, 3) displacements in the station's frame as the base moves over the ground by `amount` (n,).

        The columns are shifts along the level axes x and y, mm per mm, and a turn about the upright axis through the
        base frame's origin, mm per rad; see `level_axes`.
        """
        x, y, up = level_axes(self.rig.gravity)
        moved = np.stack(np.broadcast_arrays(x, y, np.cross(up, self.located.prism_mm)), axis=2)
        return self.to_station(moved * amount[:, None, None])

    # -- loads ---------------------------------------------------------------------------------------------------------

    @cached_property
    def loads(self) -> GravityModel:
        """The weights of the machine."""
        return self.prepared_loads or GravityModel(self.chain, self.x)

    @cached_property
    def down(self) -> Floats:
        """(n, 3) unit vectors of gravity in the base frame."""
        loads = self.loads
        return loads.down[self.data.setup] if self.levelled else np.repeat(loads.direction, len(self), axis=0)

    def torque(self, joint: str) -> Floats:
        """Return the (n,) load on a joint, N m or N; NaN where it is not known."""
        return self._torques[:, self.chain.joint_index[joint]]

    def torque_parts(self, joint: str) -> Floats:
        """Return (n, parts) changes of the load on a joint if a weight, or its lever, is larger by `MASS_SIGMA`."""
        return self._parts[:, self.chain.joint_index[joint]]

    def is_torque_measured(self, joint: str) -> bool:
        """Return True if most rows have the joint's own torque column."""
        return bool(np.isfinite(self.extra(f"{joint}_Nm")).mean() > 0.5) if len(self) else False

    def payload_torque(self, joint: str) -> Floats:
        """Return the (n,) load that the payload of each row adds to a joint, N m or N; 0 where it is not known."""
        with_payload, without = (self.loads(self.data.readings, extra, self.down) for extra in self._payloads)
        # NaN where there are no masses.
        return np.nan_to_num(with_payload - without)[:, self.chain.joint_index[joint]]

    def payload_parts(self, joint: str) -> Floats:
        """Return the (n, parts) changes of `payload_torque`, like `torque_parts` for the total load."""
        with_payload, without = (self.loads.parts(self.data.readings, extra, self.down) for extra in self._payloads)
        return (with_payload - without)[:, self.chain.joint_index[joint]]

    def greatest_torque(self, joint: str) -> float:
        """Return the largest load on a joint in the work volume; in the observations if the rig has no masses.

        Returns 0 where the load as designed is negligible compared with those of the other revolute joints. The small
        load on a vertical axis due to build errors depends on quantities that are not known.
        """
        designed = self.as_designed
        by_joint = [designed._greatest(j.name) for j in self.rig.joints if j.kind == "revolute"]
        carries = designed._greatest(joint) > _LEAST_LOAD * max(by_joint, default=0.0)
        return self._greatest(joint) if carries else 0.0

    def _greatest(self, joint: str) -> float:
        loads = self.work_volume.torque(joint) if self.rig.masses else self.torque(joint)
        greatest = float(np.abs(loads[np.isfinite(loads)]).max(initial=0.0))
        return greatest if greatest > _LEAST_NM else 0.0

    @cached_property
    def greatest_moments(self) -> dict[int, float]:
        """Cache: row -> largest moment of the weights beyond it in the work volume, N m; filled by links."""
        return {}

    @cached_property
    def overturning_Nm(self) -> Floats:  # noqa: N802 - the unit is N m
        """(n, 2) moments of all weights about the level axes through the base's origin; see `level_axes`."""
        lever_mm, newton = self.loads.places(self.data.readings, self.observations.extra)
        axes = level_axes(self.rig.gravity)
        moment = np.cross((newton[:, :, None] * lever_mm).sum(axis=1) / 1e3, -axes[2])
        out: Floats = moment @ axes[:2].T
        return out

    @cached_property
    def _torques(self) -> Floats:
        return self.loads(self.data.readings, self.observations.extra, self.down)

    @cached_property
    def _parts(self) -> Floats:
        return self.loads.parts(self.data.readings, self.observations.extra, self.down)

    @property
    def _payloads(self) -> tuple[dict[str, Floats], dict[str, Floats]]:
        """Optional columns with the payload and without it."""
        kg = np.nan_to_num(self.extra("payload_kg"))
        return {"payload_kg": kg}, {"payload_kg": np.zeros_like(kg)}

    # -- other contexts of the same machine ----------------------------------------------------------------------------

    @cached_property
    def work_volume(self) -> EffectContext:
        """Context of this machine in poses spread evenly between the joint limits, without optional columns."""
        unit = halton(len(self.rig.joints), _VOLUME_POSES)
        blank = np.full((_VOLUME_POSES, 3), np.nan)
        empty = np.full(_VOLUME_POSES, "")
        joints = {j.name: j.limits[0] + (j.limits[1] - j.limits[0]) * unit[:, i] for i, j in enumerate(self.rig.joints)}
        prism = np.full(_VOLUME_POSES, self.rig.prism_names[0])
        setup = np.full(_VOLUME_POSES, next(iter(self.chain.setups), ""))
        return replace(self, observations=Observations(prism, joints, blank, blank, setup, empty, empty))

    @cached_property
    def as_designed(self) -> EffectContext:
        """Context of these observations for the machine exactly as in its rig file."""
        x = np.zeros_like(self.x)
        return replace(self, x=x, prepared_loads=None, prepared_machine=None, levelled=False)


def level_axes(gravity: tuple[float, float, float]) -> Floats:
    """Return two level axes of the base frame and the axis that points up, as rows (3, 3).

    Up is opposite to the rig file's gravity, and x is the frame's own x axis made level. If the frame's z axis points
    up, these are the frame's own axes.

    Args:
        gravity: direction of gravity in the base frame, of any length.
    """
    up = -np.array(gravity) / np.linalg.norm(gravity)
    own = np.eye(3)[0 if abs(up[0]) < _STEEP else 1]
    x = own - (own @ up) * up
    x /= np.linalg.norm(x)
    axes: Floats = np.array([x, np.cross(up, x), up])
    return axes


@dataclass(frozen=True)
class Carried:
    """The part of a machine that moves with a row of its kinematic table; vectors are of the base frame.

    Attributes:
        context: n rows of observations.
        row: number of the row of the kinematic table.
    """

    context: EffectContext
    row: int

    @cached_property
    def _beyond(self) -> NDArray[np.bool_]:
        """(rows + 1,) mask of the frames that move with the row."""
        rig = self.context.rig
        return np.array([self.row in rig.path(frame) for frame in range(len(rig.rows) + 1)])

    @cached_property
    def carries_prism(self) -> NDArray[np.bool_]:
        """(n,) mask of the observations whose prism moves with the row."""
        carried: NDArray[np.bool_] = self._beyond[self.context.prism_frame]
        return carried

    @cached_property
    def hanging(self) -> NDArray[np.bool_]:
        """(points,) mask of the machine's point weights that the row carries."""
        return self._beyond[self.context.loads.point_frame]

    @cached_property
    def weights(self) -> tuple[Floats, Floats]:
        """(n, points, 3) positions of the machine's point weights, mm, and (n, points) their sizes, N."""
        return self.context.loads.places(self.context.data.readings, self.context.observations.extra)
