"""The servo of a robotic station: pointing, lock on a prism, loss and search.

After a loss of lock the servo behaves like real instruments: it coasts on the last motion (still "tracking"), waits,
searches around the place of the loss and locks again. It repeats this until something is found. Times are simulated
seconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import Station
from simulators.rig.noise import ARCSEC

Floats = NDArray[np.float64]
# (target, simulated seconds) -> (3,) mm from the instrument's centre: east, north, up
TargetPosition = Callable[[str, float], Floats]

_ON_AXIS_DEG = 0.05  # half width of the distance meter's beam
_SERVO_DEG_PER_S = 60.0
_OPERATOR_S = 1.0  # time to find the target in the telescope


class Flag(IntEnum):
    """Tracking flag of GTS-8 records."""

    STANDBY = 0
    LOCKED = 1
    SEARCHING = 2
    WAITING = 3
    ROTATING = 4


@dataclass(frozen=True)
class TrackerSettings:
    """Timing and range of the servo's search.

    Attributes:
        prediction_s: duration of coasting on the last motion after the sight is lost.
        wait_s: pause between coasting and search.
        search_s: duration of one search.
        search_range_deg: half width of the search around the place of the loss, in both circles.
    """

    prediction_s: float = 1.0
    wait_s: float = 2.0
    search_s: float = 2.0
    search_range_deg: float = 15.0


@dataclass(frozen=True)
class Pointing:
    """A direction (deg from north, deg from up), and the distance in mm if there is an echo.

    Attributes:
        target: name of the target that returns the echo.
    """

    hz_deg: float
    zenith_deg: float
    range_mm: float | None
    target: str | None = None


class Tracker:
    """A servo-driven telescope with automatic target recognition.

    Args:
        names: targets in the field; of two equally near targets the first is preferred.
        position: function that returns the position of a target at an instant.
        noise: random errors of circles, distance and target.
        rng: random generator.
        settings: see TrackerSettings.
    """

    def __init__(
        self,
        names: Sequence[str],
        position: TargetPosition,
        noise: Station,
        rng: np.random.Generator,
        settings: TrackerSettings,
    ) -> None:
        self._names, self._position, self._noise, self._rng = tuple(names), position, noise, rng
        self._settings = settings
        self._flag = Flag.STANDBY
        self._until = math.inf  # end of the current phase
        self._search_after_turn = True
        self._target: str | None = None
        self._wanted: str | None = None  # the target to which the operator turns
        self._lost_at: float | None = None  # when the target went out of sight, while the flag is still LOCKED
        self._blocked_until = -math.inf
        self._aim = (0.0, 90.0)

    def target(self, now_s: float) -> str | None:
        """Return the name of the target that the telescope is locked on, or None."""
        self._advance(now_s)
        return self._target

    def flag(self, now_s: float) -> Flag:
        """Return the tracking flag at an instant."""
        self._advance(now_s)
        return self._flag

    def aim_at(self, name: str, now_s: float, *, track: bool) -> None:
        """Turn to a target like an operator; with `track` lock on it on arrival, else stay in standby.

        Raises:
            ValueError: the target is unknown.
        """
        if name not in self._names:
            raise ValueError(f"no target {name!r}; there are {', '.join(self._names)}")
        self._advance(now_s)
        hz_deg, zenith_deg, _ = self._direction(name, now_s)
        if track:
            self.turn(hz_deg, zenith_deg, now_s, search=False)
            self._wanted, self._until = name, self._until + _OPERATOR_S
        else:
            self._aim, self._target, self._lost_at = (hz_deg, zenith_deg), None, None
            self._set(Flag.STANDBY, math.inf)

    def block(self, now_s: float, until_s: float) -> None:
        """Block the line of sight until `until_s`."""
        self._advance(now_s)
        self._blocked_until = until_s
        if self._flag is Flag.LOCKED and self._lost_at is None:
            self._lost_at = now_s

    def jump(self, name: str, now_s: float) -> None:
        """Follow a different target from now on without reporting it, as when two prisms pass in the field of view.

        Raises:
            ValueError: the target is unknown.
        """
        if name not in self._names:
            raise ValueError(f"no target {name!r}; there are {', '.join(self._names)}")
        self._advance(now_s)
        if self._flag is Flag.LOCKED:
            self._target = name

    def track(self, now_s: float) -> None:
        """Switch tracking on: keep a lock, else search around the current direction."""
        self._advance(now_s)
        if self._flag is Flag.STANDBY:
            self._set(Flag.SEARCHING, now_s + self._settings.search_s)

    def stand_by(self, now_s: float) -> None:
        """Stop the servo and tracking."""
        self._advance(now_s)
        self._set(Flag.STANDBY, math.inf)
        self._target = self._wanted = None

    def turn(self, hz_deg: float, zenith_deg: float, now_s: float, *, search: bool) -> None:
        """Rotate to a direction, then search there or stand by.

        Args:
            hz_deg: horizontal direction, clockwise from north.
            zenith_deg: zenith angle.
            now_s: current time, simulated seconds.
            search: search for a prism on arrival, else stand by.
        """
        self._advance(now_s)
        way = max(abs((hz_deg - self._aim[0] + 180) % 360 - 180), abs(zenith_deg - self._aim[1]))
        self._aim = (hz_deg % 360, zenith_deg)
        self._target, self._wanted, self._search_after_turn = None, None, search
        self._set(Flag.ROTATING, now_s + way / _SERVO_DEG_PER_S + 0.5)

    def point(self, now_s: float) -> Pointing:
        """Measure the direction of the telescope at an instant, with the errors of circles, distance and target."""
        self._advance(now_s)
        visible = now_s >= self._blocked_until
        if self._flag is Flag.LOCKED and self._target is not None and visible:
            self._aim = self._direction(self._target, now_s)[:2]
            return self._measured(self._target, now_s)
        if visible and self._flag is not Flag.ROTATING:
            for name in self._names:
                hz, zenith, _ = self._direction(name, now_s)
                if self._offset((hz, zenith)) < _ON_AXIS_DEG:
                    return self._measured(name, now_s)
        return Pointing(*self._aim, None)

    def _measured(self, name: str, now_s: float) -> Pointing:
        noise, rng = self._noise, self._rng
        shaken = self._position(name, now_s) + rng.normal(0.0, 1.0, 3) * noise.target_sigma_mm
        hz, zenith, range_mm = _spherical(shaken)
        circle = math.degrees(noise.angle_sigma_arcsec * ARCSEC)
        sigma_mm = noise.distance_sigma_mm + noise.distance_sigma_ppm * 1e-6 * range_mm
        e_hz, e_zenith, e_range = rng.normal(0.0, 1.0, 3)
        return Pointing((hz + e_hz * circle) % 360, zenith + e_zenith * circle, range_mm + e_range * sigma_mm, name)

    def _direction(self, name: str, now_s: float) -> tuple[float, float, float]:
        return _spherical(self._position(name, now_s))

    def _offset(self, direction: tuple[float, float]) -> float:
        around = abs((direction[0] - self._aim[0] + 180) % 360 - 180)
        return max(around * math.sin(math.radians(direction[1])), abs(direction[1] - self._aim[1]))

    def _set(self, flag: Flag, until_s: float) -> None:
        self._flag, self._until = flag, until_s

    def _advance(self, now_s: float) -> None:
        """Carry out all phase changes that are due up to now."""
        while self._step(now_s):
            pass

    def _step(self, now_s: float) -> bool:
        settings = self._settings
        if self._flag is Flag.LOCKED:
            if self._lost_at is None:
                return False
            end = self._lost_at + settings.prediction_s
            if now_s >= self._blocked_until and self._blocked_until <= end:
                self._lost_at = None  # in sight again before the end of coasting
                return False
            if now_s < end:
                return False
            self._target, self._lost_at = None, None
            self._set(Flag.WAITING, end + settings.wait_s)
            return True
        if now_s < self._until:
            return False
        end = self._until
        if self._flag is Flag.WAITING or (self._flag is Flag.ROTATING and self._search_after_turn):
            self._set(Flag.SEARCHING, end + settings.search_s)
        elif self._flag is Flag.ROTATING and self._wanted is not None:
            self._lock(self._wanted, end)
        elif self._flag is Flag.ROTATING:
            self._set(Flag.STANDBY, math.inf)
        else:
            self._finish_search(end)
        return True

    def _finish_search(self, now_s: float) -> None:
        found = None
        if now_s >= self._blocked_until:
            offsets = {name: self._offset(self._direction(name, now_s)[:2]) for name in self._names}
            nearest = min(offsets, key=lambda name: offsets[name])
            found = nearest if offsets[nearest] <= self._settings.search_range_deg else None
        if found is None:
            self._set(Flag.WAITING, now_s + self._settings.wait_s)
        else:
            self._lock(found, now_s)

    def _lock(self, name: str, now_s: float) -> None:
        self._target = name
        self._aim = self._direction(name, now_s)[:2]
        self._lost_at = now_s if now_s < self._blocked_until else None
        self._set(Flag.LOCKED, math.inf)


def _spherical(position_mm: Floats) -> tuple[float, float, float]:
    east, north, up = (float(v) for v in position_mm)
    level = math.hypot(east, north)
    return math.degrees(math.atan2(east, north)) % 360, math.degrees(math.atan2(level, up)), math.hypot(level, up)
