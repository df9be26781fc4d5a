"""A link that the sun bends."""

from __future__ import annotations

import numpy as np

from calibration.effects.base import Coefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.errors import ModelError
from calibration.observations import Floats
from calibration.rig.description import Rig

_COLUMN = "temperature_degC"
_SETTINGS = ("mean_degC", "change_degC", "frame")
_LEAST_LINK_MM = 500.0  # shorter offsets are brackets, not links
_JOINT_ANGLE = 0  # setting `frame` of the variant that uses the joint's own angle as the elevation


class SolarBow(JointFamily):
    """The sun-side flange of a link gets longer, and the link bows, most when it is horizontal.

    The link extends from the joint's axis to the origin of the next frame at a distance of half a metre or more. A
    variant uses the joint's angle as the elevation, for a link that is level when its joint reads zero.
    """

    name = "solar_bow"
    equation = "d_theta = k (T - mean T of the training data) cos(elevation of the link)"
    source = "temperature gradient over a beam's height h: slope alpha dT L / h (EN 1991-1-5)"
    confused_with = ("thermal_expansion", "base_settlement", "joint_compliance")
    revealed_by = "the same flat and steep poses of the link, cold in the morning and warm at noon"
    fixed = (Coefficient("rad_per_K", "rad/K", 1e-4, -5e-4, 5e-4),)
    column = _COLUMN
    kind = "revolute"

    def places(self, rig: Rig) -> tuple[str, ...]:
        turning = {joint for _, driven, joint, _ in rig.couplings() if driven == "theta"}
        return tuple(name for name in super().places(rig) if name in turning)

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        known, frame = self.known(context, where), _link_end(context, where)
        carries = context.greatest_torque(where) > 0.0 or not context.rig.masses
        if not carries or not known.any():
            return ()
        mean = float(context.extra(_COLUMN)[known].mean())
        found = []
        for end in (_JOINT_ANGLE,) if frame is None else (frame, _JOINT_ANGLE):
            settings = {"mean_degC": mean, "frame": float(end)}
            usual = float(np.sqrt(np.mean(_change_K(context, where, settings)[known] ** 2)))
            found += [{**settings, "change_degC": usual}] if usual > 0.0 else []
        return tuple(found)

    def form(self, settings: Settings) -> str:
        return "the joint's angle is the elevation" if settings["frame"] == _JOINT_ANGLE else "elevation of the link"

    def check_settings(self, settings: Settings) -> None:
        if set(settings) != set(_SETTINGS) or settings["change_degC"] <= 0.0 or settings["frame"] < 0.0:
            raise ValueError(f"the settings are {', '.join(_SETTINGS)}")

    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        return np.degrees(_change_K(context, where, settings))[:, None]

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        del plausible
        return float(np.degrees(values[0] * settings["change_degC"])) ** 2


def _axis_frame(rig: Rig, where: str) -> tuple[int, int]:
    """Return the row that a revolute joint turns first, and the frame whose origin lies on the joint's axis."""
    row = next(number for number, driven, joint, _ in rig.couplings() if joint == where and driven == "theta")
    if rig.convention != "dh":
        return row, row
    before = rig.path(row)[:-1]
    return row, before[-1] if before else 0


def _link_end(context: EffectContext, where: str) -> int | None:
    """Return the frame at the end of the link that a joint moves; None if there is no such link."""
    rig, frames_mm = context.rig, context.located.frames_mm
    row, own = _axis_frame(rig, where)
    for frame in range(own + 1, len(rig.rows) + 1):
        if row in rig.path(frame):
            length_mm = np.linalg.norm(frames_mm[:, frame] - frames_mm[:, own], axis=1)
            if length_mm.min(initial=np.inf) >= _LEAST_LINK_MM:
                return frame
    return None


def _change_K(context: EffectContext, where: str, settings: Settings) -> Floats:  # noqa: N802 - the unit is K
    """Return the temperature change (n,) multiplied by the cosine of the link's elevation, K."""
    warmer: Floats = np.nan_to_num(context.extra(_COLUMN) - settings["mean_degC"])
    rig, end = context.rig, int(settings["frame"])
    if end == _JOINT_ANGLE:
        warmer *= np.cos(np.radians(context.reading(where)))
        return warmer
    frames_mm = context.located.frames_mm
    _, own = _axis_frame(rig, where)
    if end >= frames_mm.shape[1]:
        raise ModelError(f"the model has a link that ends at frame {end}, which its rig lacks; calibrate again")
    link = frames_mm[:, end] - frames_mm[:, own]
    along = (link * context.down).sum(axis=1)
    square = (link**2).sum(axis=1)
    warmer *= np.sqrt(np.clip(1.0 - along**2 / np.maximum(square, np.finfo(np.float64).tiny), 0.0, 1.0))
    return warmer


FAMILY = SolarBow()
