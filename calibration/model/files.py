"""A calibrated model as files: TOML, JSON, LightGBM's text and npz without pickle, under a SHA-256 manifest.

Nothing is parsed before its checksum has been verified, because LightGBM crashes on a truncated file.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import fields
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calibration.effects.base import FittedCoefficient
from calibration.effects.fitted import FittedEffect
from calibration.effects.library import library
from calibration.effects.regime import Regime
from calibration.errors import ModelError, RigError
from calibration.identification.identifiability import Identifiability
from calibration.identification.refinement import Prior
from calibration.kinematics.chain import Chain, Placement
from calibration.model.model import CalibratedModel, LearnedResidual, Outlier, TrainingExtent
from calibration.numerics.stored_arrays import (
    LARGEST,
    check_covariance,
    check_names,
    check_rotation,
    float_array,
    read_npz,
)
from calibration.residual.conformal import Intervals, StageIntervals
from calibration.residual.features import no_features
from calibration.residual.learners import LOADERS
from calibration.residual.region import Region
from calibration.residual.selection import Trial
from calibration.rig.description import parse_rig

MANIFEST = "manifest.json"
FORMAT = "rigcal model"
VERSION = 3

Finite = Annotated[float, Field(allow_inf_nan=False)]
Bounded = Annotated[float, Field(gt=-LARGEST, lt=LARGEST, allow_inf_nan=False)]
Setting = Annotated[float, Field(ge=-1e12, le=1e12, allow_inf_nan=False)]  # wide enough for `time_s` counted from 1970
Size = Annotated[float, Field(ge=0.0, le=LARGEST, allow_inf_nan=False)]
Variance = Annotated[float, Field(ge=0.0, le=LARGEST**2, allow_inf_nan=False)]
Multiple = Annotated[float, Field(gt=0.0, le=LARGEST, allow_inf_nan=False)]
Plausible = Annotated[float, Field(ge=1e-30, le=LARGEST, allow_inf_nan=False)]  # effect families divide by it
Count = Annotated[int, Field(ge=0)]
Triple = tuple[Bounded, Bounded, Bounded]

_DOCUMENT_MAX_BYTES = 8 << 20  # 300 joints, prisms and set-ups need a tenth of that

# Errors, in addition to KeyError, that the parsers of JSON and TOML and the learners raise for hostile bytes.
_UNREADABLE = (ArithmeticError, AttributeError, IndexError, RuntimeError, TypeError, ValueError, RigError)


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, from_attributes=True)


class _File(_Part):
    sha256: str
    bytes: int


class _Manifest(_Part):
    format: Literal["rigcal model"]
    version: int
    files: dict[str, _File]


class _Placement(_Part):
    rotation: tuple[Triple, Triple, Triple]
    translation_mm: Triple


class _Parameter(_Part):
    name: str
    unit: str
    value: Bounded
    standard_error: Size
    geometric_stage_value: Bounded
    nominal_stage_value: Bounded


class _Coefficient(_Part):
    name: str
    unit: str
    value: Bounded
    standard_error: Size
    prior_sigma: Plausible


class _Regime(_Part):
    variable: str
    above: bool
    border: Finite


class _Effect(_Part):
    family: str
    where: str
    settings: dict[str, Setting]
    coefficients: tuple[_Coefficient, ...]
    regime: _Regime | None = None


class _Outlier(_Part):
    row: Count
    sigma: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class _Trial(_Part):
    kind: str
    before_mm: Finite
    after_mm: Finite
    p: Annotated[float, Field(ge=0.0, le=1.0)]
    kept: bool


class _Residual(_Part):
    kind: str
    signals: tuple[str, ...]
    prisms: tuple[str, ...]
    excess_variance_mm2: tuple[Variance, Variance, Variance]
    files: tuple[str, ...]


class _Intervals(_Part):
    axes: tuple[Multiple, Multiple, Multiple]
    radius: Multiple


class _Identifiability(_Part):
    parameters: Count
    rank: Count
    unidentifiable: tuple[str, ...]
    marked: tuple[str, ...]
    observability: dict[str, Finite]


class _Document(_Part):
    rig: str
    placements: dict[str, _Placement]
    parameters: tuple[_Parameter, ...]
    prior: Prior
    prior_scale: Multiple
    excess_sigma_mm: Size
    repeat_sigma_mm: Size
    effects_noise_mm: Size
    effects: tuple[_Effect, ...]
    effects_reason: str
    joint_error_scale: Size
    identifiability: _Identifiability
    fixes: dict[str, Count]
    ranges: dict[str, tuple[Bounded, Bounded]]
    torques: tuple[str, ...]
    payload: tuple[Variance, Variance] | None
    loads: dict[str, tuple[Setting, Setting]] = {}  # absent in older models
    outliers: tuple[_Outlier, ...]
    residual: _Residual | None
    trials: tuple[_Trial, ...]
    residual_reason: str
    intervals: _Intervals
    effects_intervals: _Intervals | None = None  # absent in older models
    warnings: tuple[str, ...]
    fitted_rows: tuple[str, ...] = ()  # absent in older models
    provenance: dict[str, str | int | Finite]


# Fields of the document with the same name in the model or in its coverage.
_COVERAGE = tuple(field.name for field in fields(TrainingExtent))
_SAME = _Document.model_fields.keys() & {field.name for field in fields(CalibratedModel)}
_SAME -= {"rig", "placements", "residual", "intervals"}


def model_to_files(model: CalibratedModel) -> dict[str, bytes]:
    """Return a model as named files, including `manifest.json` with their sizes and SHA-256 checksums."""
    residual = model.residual
    learned = residual.learner.to_files() if residual else {}
    stages = zip(model.parameters, model.geometric_values, model.nominal_values, strict=True)
    document = _Document.model_validate(
        {name: getattr(model, name) for name in _SAME}
        | {name: getattr(model.coverage, name) for name in _COVERAGE}
        | {
            "rig": model.rig.name,
            "intervals": model.intervals.hybrid,
            "effects_intervals": model.intervals.effects,
            "placements": {
                setup: {"rotation": p.rotation.tolist(), "translation_mm": p.translation_mm.tolist()}
                for setup, p in model.placements.items()
            },
            "parameters": [
                {
                    **{name: getattr(parameter, name) for name in ("name", "unit", "value", "standard_error")},
                    "geometric_stage_value": geometric,
                    "nominal_stage_value": nominal,
                }
                for parameter, geometric, nominal in stages
            ],
            "residual": residual
            and {
                "kind": residual.learner.kind,
                "signals": residual.signals,
                "prisms": residual.prisms,
                "excess_variance_mm2": residual.excess_variance_mm2.tolist(),
                "files": sorted(learned),
            },
        }
    )
    arrays = io.BytesIO()
    refitted: dict[str, Any] = {} if model.base_covariance is None else {"base_covariance": model.base_covariance}
    np.savez(arrays, covariance=model.covariance, **refitted)
    files = {
        "rig.toml": model.rig_text.encode(),
        "model.json": (document.model_dump_json(indent=1) + "\n").encode(),
        "covariance.npz": arrays.getvalue(),
        **learned,
        **(residual.region.to_files() if residual else {}),
    }
    listed = {name: {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)} for name, data in files.items()}
    manifest = {"format": FORMAT, "version": VERSION, "files": listed}
    return files | {MANIFEST: (json.dumps(manifest, indent=1) + "\n").encode()}


def check_manifest(files: Mapping[str, bytes]) -> dict[str, bytes]:
    """Verify files against their manifest, and return those that it lists.

    Raises:
        ModelError: there is no manifest, the version is not supported, or a file is missing, truncated or edited.
    """
    if MANIFEST not in files:
        raise ModelError(f"{MANIFEST} is missing: this is not a rigcal model")
    try:
        manifest = _Manifest.model_validate_json(files[MANIFEST])
    except ValidationError as error:
        raise ModelError(f"{MANIFEST} is damaged ({_first(error)}); calibrate again or restore the model") from error
    if manifest.version != VERSION:
        raise ModelError(
            f"the model has format version {manifest.version}, this program supports version {VERSION}; calibrate again"
        )
    checked: dict[str, bytes] = {}
    for name, listed in manifest.files.items():
        data = files.get(name)
        if data is None:
            raise ModelError(f"{name} is missing; calibrate again or restore the model")
        if len(data) < listed.bytes:
            raise ModelError(f"{name} is truncated ({len(data)} of {listed.bytes} bytes); restore the model")
        if hashlib.sha256(data).hexdigest() != listed.sha256:
            raise ModelError(f"{name} was changed after it was written (SHA-256 differs); restore the model")
        checked[name] = data
    return checked


def model_from_files(files: Mapping[str, bytes]) -> CalibratedModel:
    """Read a model from named files, the inverse of `model_to_files`.

    Args:
        files: name -> content; files that the manifest does not list are ignored.

    Raises:
        ModelError: the model is truncated, edited or of an unsupported version, or the files are not a model. The
            message is one sentence.
        MemoryError: this computer has too little memory.
    """
    checked = check_manifest(files)
    if len(checked.get("model.json", b"")) > _DOCUMENT_MAX_BYTES:
        raise ModelError(f"model.json is larger than {_DOCUMENT_MAX_BYTES:,} bytes; this is not a model")
    try:
        document = _Document.model_validate_json(checked["model.json"])
        rig_text = checked["rig.toml"].decode()
        rig = parse_rig(rig_text, "rig.toml of the model")
        arrays = read_npz(checked["covariance.npz"])
        covariance = float_array(arrays, "covariance")
        base_covariance = float_array(arrays, "base_covariance") if "base_covariance" in arrays else None
        residual = None if document.residual is None else _read_residual(document.residual, checked)
    except KeyError as error:
        raise ModelError(f"the model lacks {str(error.args[0]).split(' is not a file')[0]}; calibrate again") from error
    except ValidationError as error:
        raise ModelError(f"model.json is malformed ({_first(error)}); calibrate again") from error
    except _UNREADABLE as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ModelError(f"the model cannot be read ({reason}); calibrate again") from error
    rig_sha256 = hashlib.sha256(rig_text.encode()).hexdigest()
    if document.rig != rig.name or document.provenance.get("rig_sha256") != rig_sha256:
        raise ModelError("rig.toml is not the rig file that the model was calibrated with; calibrate again")
    placements = {
        setup: Placement(np.array(p.rotation), np.array(p.translation_mm)) for setup, p in document.placements.items()
    }
    chain = Chain(rig, placements)
    _check_parts(document, chain, covariance, base_covariance)
    if residual is not None:
        _check_residual(residual, chain)
    return CalibratedModel(
        **{name: getattr(document, name) for name in _SAME}
        | {
            "effects": tuple(_read_effect(part, chain) for part in document.effects),
            "identifiability": Identifiability(**dict(document.identifiability)),
            "intervals": _stage_intervals(document),
            "outliers": tuple(Outlier(**dict(outlier)) for outlier in document.outliers),
            "trials": tuple(Trial(**dict(trial)) for trial in document.trials),
        },
        rig=rig,
        rig_text=rig_text,
        placements=placements,
        values=np.array([p.value for p in document.parameters]),
        covariance=covariance,
        geometric_values=np.array([p.geometric_stage_value for p in document.parameters]),
        nominal_values=np.array([p.nominal_stage_value for p in document.parameters]),
        coverage=TrainingExtent(**{name: getattr(document, name) for name in _COVERAGE}),
        residual=residual,
        base_covariance=base_covariance,
    )


def _read_residual(part: _Residual, files: Mapping[str, bytes]) -> LearnedResidual:
    learner = LOADERS[part.kind]({name: files[name] for name in part.files})
    region = Region.from_files(files)
    return LearnedResidual(learner, part.signals, part.prisms, np.array(part.excess_variance_mm2), region)


def _check_residual(residual: LearnedResidual, chain: Chain) -> None:
    """Raise ModelError if learner and region do not match the rig or each other."""
    if not residual.learner.fits(no_features(chain, residual.signals)):
        raise ModelError("the features of the residual differ from those of the model's rig; calibrate again")
    if not residual.region.fits(len(chain.rig.joints)):
        raise ModelError("the residual's region does not match the model's rig; calibrate again")
    if residual.region.signals != residual.signals:
        raise ModelError("the signals of the residual's region differ from those in model.json; calibrate again")


def _stage_intervals(document: _Document) -> StageIntervals:
    """Return the intervals of both stages; those of stage effects, absent in older models, are then at least normal."""
    hybrid = Intervals(**dict(document.intervals))
    if document.effects_intervals is not None:
        return StageIntervals(hybrid, Intervals(**dict(document.effects_intervals)))
    return StageIntervals(hybrid, hybrid if document.residual is None else hybrid.or_wider(Intervals()))


def _check_parts(document: _Document, chain: Chain, covariance: np.ndarray, base_covariance: np.ndarray | None) -> None:
    expected = [p.name for p in chain.parameters]
    if [p.name for p in document.parameters] != expected:
        raise ModelError("the parameters of model.json differ from those of its rig; calibrate again")
    size = len(expected) + sum(len(effect.coefficients) for effect in document.effects)
    check_covariance(covariance, size, "parameters and effects")
    if base_covariance is not None:
        check_covariance(base_covariance, len(expected) - chain.base_start, "set-ups")
    for setup, placement in chain.placements.items():
        check_rotation(setup, placement.rotation)
    rig = chain.rig
    check_names((*document.ranges, *document.torques, *document.loads), rig.joint_names, "joint")
    check_names((*document.fixes, *(document.residual.prisms if document.residual else ())), rig.prism_names, "prism")
    ranges = (*document.ranges.items(), *document.loads.items())
    reversed_ranges = [name for name, (low, high) in ranges if low > high]
    if reversed_ranges:
        raise ModelError(f"a range of joint {reversed_ranges[0]!r} in model.json ends before it starts")


def _read_effect(part: _Effect, chain: Chain) -> FittedEffect:
    """Read an effect; raise ModelError if this program's family of that name is not compatible with it."""
    family = library().get(part.family)
    if family is None or part.where not in family.places(chain.rig):
        raise ModelError(f"model.json has effect {part.family}@{part.where}, which this program does not have there")
    coefficients = tuple(FittedCoefficient(**dict(c)) for c in part.coefficients)
    try:
        names = family.names(part.settings)
    except ValueError as error:
        raise ModelError(f"model.json has effect {part.family}@{part.where} in an invalid form: {error}") from error
    if tuple(c.name for c in coefficients) != names:
        raise ModelError(f"effect {part.family}@{part.where} of model.json needs the coefficients {', '.join(names)}")
    regime = None if part.regime is None else Regime(**dict(part.regime))
    if regime is not None and not regime.is_possible(chain.rig):
        raise ModelError(
            f"effect {part.family}@{part.where} of model.json depends on {regime.variable}, which does not exist"
        )
    return FittedEffect(part.family, part.where, coefficients, part.settings, regime)


def _first(error: ValidationError) -> str:
    first = error.errors()[0]
    return f"{'.'.join(str(p) for p in first['loc'])}: {first['msg']}"
