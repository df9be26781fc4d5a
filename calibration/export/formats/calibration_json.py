"""calibration.json: all identified values with units and standard errors; lengths mm, angles rad."""

from __future__ import annotations

import json

import numpy as np

from calibration.design.accuracy import expected_accuracy
from calibration.errors import UnsafeError
from calibration.export.model_export import Export, Format, LeftOut
from calibration.model.model import CalibratedModel


def document(model: CalibratedModel) -> dict[str, object]:
    """Return parameters, bases, effects, accuracy and provenance of a model as a JSON object."""
    chain = model.chain
    nominal = {op.parameter: op.constant for ops in (*chain.row_ops, *chain.prism_ops) for op in ops}
    try:
        expected: object = expected_accuracy(model, np.random.default_rng(0)).as_dict()
    except UnsafeError:
        expected = None
    bases = [chain.base(model.values, number) for number in range(len(chain.setups))]
    return {
        "format": "rigcal calibration",
        "version": 1,
        "rig": model.rig.name,
        "convention": model.rig.convention,
        "rig_file": model.rig_text,
        "parameters": [
            {
                "name": p.name,
                "unit": p.unit,
                "kind": p.kind,
                "nominal": nominal[index],
                "correction": p.value,
                "value": nominal[index] + p.value,
                "standard_error": p.standard_error,
            }
            for index, p in enumerate(model.parameters)
            if p.kind != "base"
        ],
        "bases": [
            {"setup": setup, "rotation": base.rotation.tolist(), "translation_mm": base.translation_mm.tolist()}
            for setup, base in zip(chain.setups, bases, strict=True)
        ],
        "effects": [effect.as_dict() for effect in model.effects],
        "residual": model.residual.learner.kind if model.residual else None,
        "noise_mm": model.noise_mm,
        "expected_accuracy": expected,
        "identifiability": model.identifiability.as_dict(),
        "trained_on": {
            "fixes": dict(model.coverage.fixes),
            "ranges": {name: list(ends) for name, ends in model.coverage.ranges.items()},
        },
        "warnings": list(model.warnings),
        "provenance": dict(model.provenance),
    }


def _content(export: Export) -> bytes:
    about = document(export.model) | {
        "manifest_sha256": export.manifest_sha256,
        "leaves_out": _left_out(export).as_dict(),
    }
    return (json.dumps(about, indent=1, allow_nan=False) + "\n").encode()


def _left_out(export: Export) -> LeftOut:
    """Return the part that the file only names, the learned residual; the numbers of effects are in the file."""
    return export.without(lambda _: True)


FORMAT = Format(
    "json",
    "calibration.json",
    "parameters with units and standard errors, effects, bases, accuracy, provenance",
    _content,
    _left_out,
    is_default=True,
)
