"""rigcal_model.h: forward kinematics with effects, and the inverse, as C99 for a controller.

The learned residual is left out (docs/decisions/0032-models-for-other-tools.md).
"""

from __future__ import annotations

import numpy as np

from calibration.effects.context import EffectContext
from calibration.effects.fitted import FittedEffect
from calibration.effects.library import library
from calibration.evaluation.correction_grid import Machine
from calibration.evaluation.exports import Export, Format, LeftOut
from calibration.evaluation.writers.c_effects import EffectWriter
from calibration.evaluation.writers.c_header import c_header
from calibration.evaluation.writers.motions import carriers, motion_tree
from calibration.kinematics.torques import GravityModel
from calibration.model.prediction import Predictor


def _context(export: Export) -> EffectContext:
    """Return a pose of the machine as effects see it; the shapes of uncertain loads are of its work volume."""
    model = export.model
    rows = Machine(model, export.setup).rows(model.rig.prism_names[0], np.zeros((1, len(model.rig.joints))))
    return Predictor.of(model).context(rows)


def _writer(export: Export) -> EffectWriter:
    return EffectWriter(_context(export), carriers(motion_tree(export.model.chain, export.model.values)))


def written_effects(export: Export) -> tuple[FittedEffect, ...]:
    """Return the effects of a model that the header has."""
    writer = _writer(export)
    moving = [effect for effect in export.model.effects if library()[effect.family].moves_machine]
    return tuple(effect for effect in moving if writer.can_write(effect))


def _left_out(export: Export) -> LeftOut:
    kept = written_effects(export)
    return export.without(lambda effect: effect in kept)


def _content(export: Export) -> bytes:
    model = export.model
    down = GravityModel(model.chain, model.values).down[export.setup]
    remarks = export.heading(_left_out(export))
    return c_header(_writer(export), down, written_effects(export), remarks).encode()


FORMAT = Format(
    "c-header",
    "rigcal_model.h",
    "forward kinematics with effects, and the inverse, as one C99 file",
    _content,
    _left_out,
)
