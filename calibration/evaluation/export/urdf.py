"""model.urdf: the identified kinematics as URDF, for ROS, pinocchio, MoveIt and others; lengths m, angles rad."""

from __future__ import annotations

from calibration.evaluation.exports import Export, Format
from calibration.evaluation.writers.urdf_text import urdf_text


def _content(export: Export) -> bytes:
    model = export.model
    return urdf_text(model.chain, model.values, export.heading(export.kinematics_alone)).encode()


FORMAT = Format(
    "urdf",
    "model.urdf",
    "the identified kinematics for ROS, pinocchio and others",
    _content,
    lambda export: export.kinematics_alone,
)
