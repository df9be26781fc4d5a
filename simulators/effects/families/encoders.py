"""Errors of an encoder's own reading: scale, eccentricity, error curve, slip on its shaft."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from calibration.rig.description import Rig
from simulators.effects.base import Body, DrawContext, Effect, Floats, step_time_s

_MOST_CYCLES = 10_000  # cycles per turn, far more than the visible lines of any encoder


@dataclass(frozen=True)
class AngleScale(Effect):
    """An encoder with a wrong scale.

    d_theta = scale * theta as read, from the zero of the reading; 1e-3 is 0.9 mrad at 50 deg.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"scale": 5e-3}
    has_either_sign = True
    acts_at = ("revolute",)
    scale: float = 1.0e-3

    def joint_change(self, body: Body) -> Floats:
        return self.scale * body.read[self.where]


@dataclass(frozen=True)
class EncoderHarmonic(Effect):
    """An eccentric encoder: an error that repeats k times per turn.

    True angle - read angle = A cos(k theta) + B sin(k theta), theta the true angle.

    Attributes:
        cosk_rad, sink_rad: A and B.
        k: cycles per turn.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"cosk_rad": 6e-3, "sink_rad": 6e-3}
    has_either_sign = True
    acts_at = ("revolute",)
    cosk_rad: float = 1.0e-3
    sink_rad: float = 1.0e-3
    k: int = 1

    def draw_shape(self, data: DrawContext, rng: np.random.Generator) -> Effect:
        del data
        return replace(self, k=int(rng.integers(1, 3)))

    def joint_change(self, body: Body) -> Floats:
        read = body.read[self.where]
        change = np.zeros_like(read)
        # The disc's error depends on the shaft's true angle; three iterations reach the fixed point to 1e-9 rad
        for _ in range(3):
            true = read + change
            change = self.cosk_rad * np.cos(self.k * true) + self.sink_rad * np.sin(self.k * true)
        return change


_EVEN_POINTS = 721
_WAVES = 60


@dataclass(frozen=True)
class JointErrorMap(Effect):
    """The error curve of an encoder, a gear or a worn rack: many cycles over the joint's own angle.

    True angle - read angle = a curve of the angle as read, drawn once from `seed`.

    If `lines` is 0, this is a smooth random curve with Gaussian correlation over `length_deg`, else a sum of `lines`
    cosines of equal size with 3 to `highest` cycles per turn.

    Attributes:
        rms_rad: root mean square of the curve about its mean, between the joint's limits.
        length_deg: correlation length.
        lines, highest: number of cosines, and their largest number of cycles per turn.
        seed: the same seed draws the same curve.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rms_rad": 5e-3}
    acts_at = ("revolute",)
    rms_rad: float = 1.0e-3
    length_deg: float = 8.0
    lines: int = 0
    highest: int = 40
    seed: int = 0

    def check(self, rig: Rig) -> None:
        super().check(rig)
        has_room = max(3, self.lines + 2) <= self.highest <= _MOST_CYCLES
        if self.length_deg <= 0.0 or self.lines < 0 or self.seed < 0 or not has_room:
            raise ValueError(
                f"{self.family}@{self.where}: length_deg must be positive, lines and seed 0 or more, "
                f"highest 3 to {_MOST_CYCLES} with room for {self.lines} lines"
            )

    def draw_shape(self, data: DrawContext, rng: np.random.Generator) -> Effect:
        """Draw a smooth curve with about five waves over the joint's range, or a sum of two cosines."""
        low, high = data.rig.joint(self.where).limits
        once = 360.0 / min(high - low, 360.0)  # cycles per turn that give one cycle over the range
        return replace(
            self,
            seed=int(rng.integers(1 << 31)),
            length_deg=(high - low) * float(rng.uniform(0.06, 0.12)),
            lines=int(rng.choice([0, 2])),
            highest=max(6, round(8 * once)),
        )

    def joint_change(self, body: Body) -> Floats:
        low, high = np.deg2rad(body.rig.joint(self.where).limits)
        cycles, phase = self._waves()
        even = np.linspace(low, high, _EVEN_POINTS)
        curve = _curve(even, cycles, phase)
        size = float(np.std(curve))
        change: Floats = self.rms_rad / size * (_curve(body.read[self.where], cycles, phase) - np.mean(curve))
        return change

    def _waves(self) -> tuple[Floats, Floats]:
        rng = np.random.default_rng([self.seed, 71])
        if self.lines:
            cycles = rng.choice(np.arange(3, self.highest + 1), self.lines, replace=False).astype(float)
        else:  # cosines with frequencies from the spectrum of a Gaussian correlation
            cycles = rng.normal(0.0, 1.0 / np.deg2rad(self.length_deg), _WAVES)
        return cycles, rng.uniform(0.0, 2 * np.pi, len(cycles))


def _curve(angle: Floats, cycles: Floats, phase: Floats) -> Floats:
    total: Floats = np.cos(np.outer(angle, cycles) + phase).sum(axis=1)
    return total


@dataclass(frozen=True)
class ZeroStep(Effect):
    """An encoder that slips on its shaft: from one instant on the joint's zero is different.

    d_theta = jump at all times after `time_s` (column `time_s`).
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"jump_rad": 35e-3}
    has_either_sign = True
    acts_at = ("revolute",)
    jump_rad: float = 2e-3
    time_s: float = 0.0

    def draw_shape(self, data: DrawContext, rng: np.random.Generator) -> Effect:
        return replace(self, time_s=step_time_s(data, rng))

    def joint_change(self, body: Body) -> Floats:
        return np.where(body.column("time_s") > self.time_s, self.jump_rad, 0.0)
