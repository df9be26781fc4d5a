"""An encoder that sits off its axis, or whose disc is oval."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from calibration.effects.base import Coefficient, JointFamily, Settings, Situation
from calibration.observations import Floats

_CYCLES = (1.0, 2.0)


class EncoderHarmonic(JointFamily):
    """An error that repeats k times a turn: k = 1 for eccentricity, 2 for an oval or tilted disc."""

    name: ClassVar[str] = "encoder_harmonic"
    equation: ClassVar[str] = "d_theta = cosk cos(k theta) + sink sin(k theta), k = 1 or 2"
    source: ClassVar[str] = "eccentricity of a rotary encoder's disc: e / r = error in rad, once a turn"
    confused_with: ClassVar[tuple[str, ...]] = ("angle_scale", "joint_error_map", "joint_compliance")
    revealed_by: ClassVar[str] = "the joint alone over its whole range, in even steps"
    kind: ClassVar[Literal["revolute", "prismatic"]] = "revolute"

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        del situation, where
        return tuple({"k": k} for k in _CYCLES)

    def form(self, settings: Settings) -> str:
        return f"k = {settings['k']:g}"

    def names(self, settings: Settings) -> tuple[str, ...]:
        if set(settings) != {"k"} or settings["k"] not in _CYCLES:
            raise ValueError("the only setting is k, 1 or 2")
        return "cosk_rad", "sink_rad"

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where
        return tuple(Coefficient(name, "rad", 1.5e-3, -6e-3, 6e-3) for name in self.names(settings))

    def columns(self, situation: Situation, where: str, settings: Settings) -> Floats:
        angle = settings["k"] * np.radians(situation.reading(where))
        change: Floats = np.degrees(np.array([np.cos(angle), np.sin(angle)])).T
        return change


FAMILY = EncoderHarmonic()
