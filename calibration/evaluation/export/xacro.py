"""model.xacro: as model.urdf, with a prefix in front of all names that the caller gives."""

from __future__ import annotations

from calibration.evaluation.exports import Export, Format
from calibration.evaluation.writers.urdf_text import xacro_text


def _content(export: Export) -> bytes:
    model = export.model
    return xacro_text(model.chain, model.values, export.heading(export.kinematics_alone)).encode()


FORMAT = Format(
    "xacro",
    "model.xacro",
    "the same with a prefix that the caller gives",
    _content,
    lambda export: export.kinematics_alone,
)
