"""The stroke that effects outside the library speak of."""

from __future__ import annotations

from calibration.rig import Rig


def boom_stroke(rig: Rig) -> str | None:
    """The first prismatic joint; None if there is none."""
    return next((joint.name for joint in rig.joints if joint.kind == "prismatic"), None)
