"""The machine for its simulated devices: moving joints, the loads on them, and the true positions of the prisms."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from simulators.devices.can.machine_signals import MachineState
from simulators.hydraulics import (
    START_TEMPERATURE_DEGC,
    TEMPERATE_DEGC,
    VALVE_JOINTS,
    boom_load_bar,
    motion_columns,
    oil_temperature_degC,
)
from simulators.rig.dataset import random_poses
from simulators.rig.motion import BoomMotion
from simulators.rig.truth import RigTruth, replace_effects

Floats = NDArray[np.float64]

_LOAD_EVERY_S = 0.25  # loads change slowly and are costly to compute
_CONTROL_POINTS = 4


class Machine:
    """A true machine in motion, seen from one station set-up.

    Attributes:
        truth, motion: geometry and motion of the machine.
        setup: name of the station set-up.
        control_points_mm: fixed marks around the machine, in the station's frame: name -> (3,).

    Args:
        truth: geometry and effects. Effects count time from simulated second 0 and temperature from `TEMPERATE_DEGC`.
        seed: seed of the control points and the reading noise.
        motion: motion of the joints.
        setup: name of the station set-up, which determines where the machine stands.

    Raises:
        ValueError: an effect needs a quantity that this machine does not measure (a payload, a boom cylinder pressure).
    """

    def __init__(self, truth: RigTruth, seed: int, motion: BoomMotion, *, setup: str = "") -> None:
        self.truth = replace_effects(truth, [effect.anchored(0.0, TEMPERATE_DEGC) for effect in truth.effects])
        self.motion, self.setup = motion, setup
        self.rng = np.random.default_rng([seed, 30])
        self.control_points_mm = _control_points(np.random.default_rng([seed, 31]))
        self._rig = truth.rig
        self._sigma = {j.name: j.sigma for j in self._rig.joints}
        self._valves = {v: self._rig.joint(j) for v, j in VALVE_JOINTS.items() if j in self._rig.joint_names}
        self._load_at_s = -1e9
        self._load_bar = float(boom_load_bar(0.0))
        self._last_place: tuple[str, float, Floats] | None = None
        for prism in self._rig.prism_names:
            self._solve(prism, motion.values(0.0), 0.0)

    def joint(self, name: str, t_s: float) -> tuple[float, float]:
        """Return the noisy value of a joint, and its rate: deg or mm, and per second."""
        value, rate = self.motion.joint(name, t_s)
        return value + self._sigma[name] * self.rng.standard_normal(), rate

    def place_mm(self, target: str, t_s: float) -> Floats:
        """Return the (3,) true position of a prism or control point in the station's frame; KeyError if unknown."""
        if target in self.control_points_mm:
            return self.control_points_mm[target]
        # Cached, as a tracker requests direction and distance of the same instant separately
        last = self._last_place
        if last is None or last[:2] != (target, t_s):
            last = self._last_place = (target, t_s, self._solve(target, self.motion.values(t_s), t_s))
        return last[2]

    def prism_at_mm(self, prism: str, pose: Mapping[str, float], columns: Mapping[str, float]) -> Floats:
        """Return the (3,) true position of a prism in any pose, to check a model against the truth.

        Args:
            prism: name of the prism.
            pose: joint name -> value, deg or mm.
            columns: other quantities that effects need (`theta4_dir`, `theta4_rate`, `boom_valve_mA`, ...). Missing
                ones have their values for a machine that has just come to rest at simulated second 0 without any
                travel of its joints.

        Raises:
            ValueError: the prism is unknown, or a joint is missing or unknown.
        """
        rig = self._rig
        if prism not in rig.prism_names:
            raise ValueError(f"no prism {prism!r}; this rig has {', '.join(rig.prism_names)}")
        if set(pose) != set(rig.joint_names):
            raise ValueError(f"a pose must have exactly the joints {', '.join(rig.joint_names)}")
        rest = dict.fromkeys(rig.joint_names, 0.0)
        standing = self._columns(rest, dict.fromkeys(rig.joint_names, 0), dwell_s=0.0, travel=rest, t_s=0.0)
        return self._place(prism, pose, standing | dict(columns))

    def _solve(self, prism: str, pose: Mapping[str, float], t_s: float) -> Floats:
        motion, names = self.motion, self._rig.joint_names
        rates = {j: motion.joint(j, t_s)[1] for j in names}
        travel = {j: motion.travelled(j, t_s) for j in names}
        columns = self._columns(rates, motion.directions(t_s), dwell_s=motion.standing_s(t_s), travel=travel, t_s=t_s)
        return self._place(prism, pose, columns)

    def _columns(
        self,
        rates: Mapping[str, float],
        directions: Mapping[str, int],
        *,
        dwell_s: float,
        travel: Mapping[str, float],
        t_s: float,
    ) -> dict[str, float]:
        """Return the columns on which effects may depend in addition to the pose, without sensor noise."""
        speeds = {j.name: rates[j.name] / j.max_rate for j in self._rig.joints}
        columns = {f"{j}_dir": float(d) for j, d in directions.items()} | {f"{j}_rate": r for j, r in rates.items()}
        columns |= {f"{j.name}_travel_m": travel[j.name] / 1e3 for j in self._rig.joints if j.kind == "prismatic"}
        columns |= {"time_s": t_s, "dwell_s": dwell_s}
        columns["temperature_degC"] = float(oil_temperature_degC(t_s, START_TEMPERATURE_DEGC))
        return columns | {name: float(value) for name, value in motion_columns(speeds).items()}

    def _place(self, prism: str, pose: Mapping[str, float], columns: Mapping[str, float]) -> Floats:
        joints = {name: np.array([value]) for name, value in pose.items()}
        more = {name: np.array([value]) for name, value in columns.items()}
        place: Floats = self.truth.prism_mm(prism, joints, more, setup=self.setup)[0]
        return place

    def state(self, t_s: float) -> MachineState:
        """Return speeds and loads for the machine controller's signals."""
        speeds = {valve: self.motion.joint(j.name, t_s)[1] / j.max_rate for valve, j in self._valves.items()}
        return MachineState(speeds, self.boom_load_bar(t_s))

    def boom_load_bar(self, t_s: float) -> float:
        """Return the pressure in the lower side of the boom cylinder."""
        if "boom" in self._valves and abs(t_s - self._load_at_s) >= _LOAD_EVERY_S:
            self._load_at_s = t_s
            joints = {name: np.array([value]) for name, value in self.motion.values(t_s).items()}
            torque = float(self.truth.gravity_load(self._valves["boom"].name, joints, setup=self.setup)[0])
            self._load_bar = float(boom_load_bar(torque))
        return self._load_bar

    def random_poses(self, n: int, seed: int) -> list[dict[str, float]]:
        """Draw n poses within the joint limits."""
        drawn = random_poses(self._rig, n, np.random.default_rng([seed, 32]))
        return [{name: round(float(values[i]), 4) for name, values in drawn.items()} for i in range(n)]


def _control_points(rng: np.random.Generator) -> dict[str, Floats]:
    """Return marks on the walls: all around, 6 to 15 m away, from knee height to the roof."""
    out = {}
    for i in range(_CONTROL_POINTS):
        hz = 2 * np.pi * (i + rng.uniform(0.1, 0.9)) / _CONTROL_POINTS
        level, up = rng.uniform(6000, 15000), rng.uniform(-1000, 4000)
        out[f"cp{i + 1}"] = np.array([level * np.sin(hz), level * np.cos(hz), up])
    return out
