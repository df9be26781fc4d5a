"""The servo of a robotic station: pointing, lock on a prism, loss and search.

Sequence on a loss of lock, as the instruments have it: coast on the last motion (still "tracking"), wait, search
around the place of the loss, lock again; and again while nothing is found. Times are simulated seconds.
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

_ON_AXIS_DEG = 0.05  # the distance meter's beam is this narrow
_SERVO_DEG_PER_S = 60.0
_OPERATOR_S = 1.0  # to find the target in the telescope


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
        prediction_s: duration of coasting on the last motion after a loss of sight.
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
    """A direction, and the distance along it if there is an echo: deg from north, deg from up, mm.

    Attributes:
        target: what echoes.
    """

    hz_deg: float
    zenith_deg: float
    range_mm: float | None
    target: str | None = None


class Tracker:
    """A servo-driven telescope with automatic target recognition.

    Args:
        names: targets in the field, in the order of preference when two are equally near.
        position: where a target is at an instant.
        noise: random errors of circles, distance and target.
        rng: their source.
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
        self._until = math.inf  # when the present phase ends of itself
        self._search_after_turn = True
        self._target: str | None = None
        self._wanted: str | None = None  # the target that the operator turns it to
        self._lost_at: float | None = None  # out of sight since then, while it still counts as locked
        self._blocked_until = -math.inf
        self._aim = (0.0, 90.0)

    def target(self, now_s: float) -> str | None:
        """Name of the target that it is locked on; None if there is none."""
        self._advance(now_s)
        return self._target

    def flag(self, now_s: float) -> Flag:
        """Tracking flag at an instant."""
        self._advance(now_s)
        return self._flag

    def aim_at(self, name: str, now_s: float, *, track: bool) -> None:
        """Turn to a target, as an operator does: `track` locks on it when it is there, else it stays in standby.

        Raises:
            ValueError: no such target.
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
        """Something stands in the line of sight until then."""
        self._advance(now_s)
        self._blocked_until = until_s
        if self._flag is Flag.LOCKED and self._lost_at is None:
            self._lost_at = now_s

    def jump(self, name: str, now_s: float) -> None:
        """Follow another target from now on, unreported: two prisms passed each other in the field of view.

        Raises:
            ValueError: no such target.
        """
        if name not in self._names:
            raise ValueError(f"no target {name!r}; there are {', '.join(self._names)}")
        self._advance(now_s)
        if self._flag is Flag.LOCKED:
            self._target = name

    def track(self, now_s: float) -> None:
        """Tracking on: keep a lock, else search where it points."""
        self._advance(now_s)
        if self._flag is Flag.STANDBY:
            self._set(Flag.SEARCHING, now_s + self._settings.search_s)

    def stand_by(self, now_s: float) -> None:
        """Servo still, no tracking."""
        self._advance(now_s)
        self._set(Flag.STANDBY, math.inf)
        self._target = self._wanted = None

    def turn(self, hz_deg: float, zenith_deg: float, now_s: float, *, search: bool) -> None:
        """Rotate to a direction, then search there or stand by."""
        self._advance(now_s)
        way = max(abs((hz_deg - self._aim[0] + 180) % 360 - 180), abs(zenith_deg - self._aim[1]))
        self._aim = (hz_deg % 360, zenith_deg)
        self._target, self._wanted, self._search_after_turn = None, None, search
        self._set(Flag.ROTATING, now_s + way / _SERVO_DEG_PER_S + 0.5)

    def point(self, now_s: float) -> Pointing:
        """Measure: where the telescope points at an instant, with the errors of circles, distance and target."""
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
        """Live through everything that happens by itself up to now."""
        while self._step(now_s):
            pass

    def _step(self, now_s: float) -> bool:
        settings = self._settings
        if self._flag is Flag.LOCKED:
            if self._lost_at is None:
                return False
            end = self._lost_at + settings.prediction_s
            if now_s >= self._blocked_until and self._blocked_until <= end:
                self._lost_at = None  # in sight again before the coasting was over
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
