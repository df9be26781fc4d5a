"""Motion of the boom through a plan: each joint moves with limited rate and acceleration, then stands still.

Times are simulated seconds. The state can be requested for the present and for the past, because a measurement may
belong to a slightly earlier instant.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass

from calibration.rig.description import Rig

ACCELERATION_TIME_S = 0.5  # from rest to the full rate


@dataclass(frozen=True, slots=True)
class _Ramp:
    """Motion of one joint between two values: accelerate, hold, decelerate (trapezoidal rate)."""

    start: float
    end: float
    rate: float
    acceleration: float

    @property
    def distance(self) -> float:
        return self.end - self.start

    @property
    def peak(self) -> float:
        """Rate actually reached; short motions never reach the full rate."""
        return min(self.rate, math.sqrt(abs(self.distance) * self.acceleration))

    @property
    def duration_s(self) -> float:
        if self.distance == 0.0:
            return 0.0
        return abs(self.distance) / self.peak + self.peak / self.acceleration

    def travelled(self, elapsed_s: float) -> float:
        """Return the distance travelled so far, 0 or more."""
        return abs(self.at(elapsed_s)[0] - self.start)

    def at(self, elapsed_s: float) -> tuple[float, float]:
        """Return value and rate."""
        total = self.duration_s
        if elapsed_s >= total:
            return self.end, 0.0
        if elapsed_s <= 0.0:
            return self.start, 0.0
        sign, peak, a = math.copysign(1.0, self.distance), self.peak, self.acceleration
        ramp_s = peak / a
        if elapsed_s < ramp_s:
            return self.start + sign * a * elapsed_s**2 / 2, sign * a * elapsed_s
        left_s = total - elapsed_s
        if left_s < ramp_s:
            return self.end - sign * a * left_s**2 / 2, sign * a * left_s
        return self.start + sign * (peak * elapsed_s - peak * ramp_s / 2), sign * peak


@dataclass(frozen=True, slots=True)
class _Leg:
    begin_s: float
    end_s: float
    ramps: Mapping[str, _Ramp]
    directions: Mapping[str, int]
    travelled: Mapping[str, float]  # by each joint, in all previous legs
    rested_s: float  # when the motion before this leg ended


class BoomMotion:
    """The joint values over time.

    Args:
        rig: description with joints, limits and rates.
        start: joint name -> initial value, deg or mm; missing joints start in the middle of their limits.

    Raises:
        ValueError: a joint is unknown, or a value is beyond its limits.
    """

    def __init__(self, rig: Rig, start: Mapping[str, float] | None = None) -> None:
        self._rig = rig
        pose = {j.name: sum(j.limits) / 2 for j in rig.joints} | dict(start or {})
        self._check(pose)
        ramps = {j.name: _Ramp(pose[j.name], pose[j.name], j.max_rate, j.max_rate) for j in rig.joints}
        nothing = dict.fromkeys(pose, 0.0)
        self._legs = [_Leg(-math.inf, -math.inf, ramps, dict.fromkeys(pose, 0), nothing, 0.0)]
        self._begins = [-math.inf]

    def _check(self, pose: Mapping[str, float]) -> None:
        for name, value in pose.items():
            if name not in self._rig.joint_names:
                raise ValueError(f"no joint {name!r}; this rig has {', '.join(self._rig.joint_names)}")
            low, high = self._rig.joint(name).limits
            if not low <= value <= high:
                raise ValueError(f"{name} = {value} is beyond its limits {low} .. {high}")

    def move(self, now_s: float, target: Mapping[str, float], *, speed: float = 0.25, dwell_s: float = 0.0) -> float:
        """Append a move, which begins when the previous moves have ended, but not before `now_s`.

        Args:
            now_s: current time.
            target: joint name -> value; missing joints do not move.
            speed: share of every joint's `max_rate`, 0 < speed <= 1.
            dwell_s: standstill before the next move may begin.

        Returns:
            Time of arrival (without the dwell) in simulated seconds.

        Raises:
            ValueError: a joint is unknown, a value is beyond its limits, or the speed is invalid.
        """
        self._check(target)
        if not 0 < speed <= 1:
            raise ValueError(f"speed is a share of the joints' maximum rate: above 0 and at most 1, not {speed}")
        last = self._legs[-1]
        begin = max(now_s, last.end_s)
        ramps, directions = {}, dict(last.directions)
        for joint in self._rig.joints:
            here = last.ramps[joint.name].end
            there = target.get(joint.name, here)
            rate = speed * joint.max_rate
            ramps[joint.name] = _Ramp(here, there, rate, rate / ACCELERATION_TIME_S)
            if there != here:
                directions[joint.name] = 1 if there > here else -1
        arrival = begin + max(r.duration_s for r in ramps.values())
        travelled = {name: last.travelled[name] + abs(ramp.distance) for name, ramp in last.ramps.items()}
        longest = max((r.duration_s for r in last.ramps.values()), default=0.0)
        rested = last.begin_s + longest if longest else last.rested_s
        self._legs.append(_Leg(begin, arrival + dwell_s, ramps, directions, travelled, rested))
        self._begins.append(begin)
        return arrival

    def _leg(self, t_s: float) -> _Leg:
        return self._legs[bisect_right(self._begins, t_s) - 1]

    def joint(self, name: str, t_s: float) -> tuple[float, float]:
        """Return value (deg, mm) and rate (deg/s, mm/s) of a joint at an instant."""
        leg = self._leg(t_s)
        return leg.ramps[name].at(t_s - leg.begin_s)

    def values(self, t_s: float) -> dict[str, float]:
        """Return all joint values at an instant."""
        leg = self._leg(t_s)
        return {name: ramp.at(t_s - leg.begin_s)[0] for name, ramp in leg.ramps.items()}

    def directions(self, t_s: float) -> Mapping[str, int]:
        """Return the direction of each joint's last motion begun up to `t_s`: -1, 1, or 0 if it has not moved."""
        return self._leg(t_s).directions

    def travelled(self, name: str, t_s: float) -> float:
        """Return the total distance that a joint has travelled back and forth since the start, deg or mm."""
        leg = self._leg(t_s)
        return leg.travelled[name] + leg.ramps[name].travelled(t_s - leg.begin_s)

    def standing_s(self, t_s: float) -> float:
        """Return the time since the last motion of any joint, or since second 0; 0 while a joint moves."""
        leg = self._leg(t_s)
        longest = max(ramp.duration_s for ramp in leg.ramps.values())
        rested = leg.begin_s + longest if longest else leg.rested_s
        return max(0.0, t_s - rested)

    def moving(self, t_s: float) -> bool:
        """Return True if any joint moves."""
        leg = self._leg(t_s)
        return any(t_s - leg.begin_s < ramp.duration_s for ramp in leg.ramps.values())

    def forget_before(self, t_s: float) -> None:
        """Discard the legs before the one at `t_s`, which are no longer needed."""
        keep = max(0, bisect_right(self._begins, t_s) - 1)
        del self._legs[:keep], self._begins[:keep]
