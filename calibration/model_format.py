"""A calibrated model as files: TOML, JSON, LightGBM's text and npz without pickle, under a SHA-256 manifest.

Nothing is parsed before its hash has been compared: LightGBM dies of a truncated file.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calibration.effects.fitted import FittedCoefficient, FittedEffect
from calibration.effects.library import library
from calibration.errors import ModelError, RigError
from calibration.identification.identifiability import Identifiability
from calibration.identification.refinement import Prior
from calibration.kinematics import Chain, Placement
from calibration.model import CalibratedModel, Coverage, LearnedResidual, Outlier
from calibration.residual.features import feature_names
from calibration.residual.hybrid import LOADERS, Trial
from calibration.rig import parse_rig

MANIFEST = "manifest.json"
FORMAT = "rigcal model"
VERSION = 2

Finite = Annotated[float, Field(allow_inf_nan=False)]
Variance = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Triple = tuple[Finite, Finite, Finite]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


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
    value: Finite
    standard_error: Finite
    geometric_stage_value: Finite
    nominal_stage_value: Finite


class _Coefficient(_Part):
    name: str
    unit: str
    value: Finite
    standard_error: Variance
    prior_sigma: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class _Effect(_Part):
    family: str
    where: str
    settings: dict[str, Finite]
    coefficients: tuple[_Coefficient, ...]


class _Outlier(_Part):
    row: int
    sigma: Finite


class _Trial(_Part):
    kind: str
    before_mm: Finite
    after_mm: Finite
    p: Finite
    kept: bool


class _Residual(_Part):
    kind: str
    signals: tuple[str, ...]
    prisms: tuple[str, ...]
    excess_variance_mm2: tuple[Variance, Variance, Variance]
    files: tuple[str, ...]


class _Identifiability(_Part):
    parameters: int
    rank: int
    unidentifiable: tuple[str, ...]
    marked: tuple[str, ...]
    observability: dict[str, Finite]


class _Document(_Part):
    rig: str
    placements: dict[str, _Placement]
    parameters: tuple[_Parameter, ...]
    prior: Prior
    prior_scale: Finite
    excess_sigma_mm: Finite
    repeat_sigma_mm: Finite
    effects_noise_mm: Finite
    effects: tuple[_Effect, ...]
    effects_reason: str
    joint_error_scale: Variance
    identifiability: _Identifiability
    fixes: dict[str, int]
    ranges: dict[str, tuple[Finite, Finite]]
    torques: tuple[str, ...]
    outliers: tuple[_Outlier, ...]
    residual: _Residual | None
    trials: tuple[_Trial, ...]
    residual_reason: str
    warnings: tuple[str, ...]
    provenance: dict[str, str | int | Finite]


def write_model(model: CalibratedModel) -> dict[str, bytes]:
    """All files of a model."""
    learned = model.residual.learner.to_files() if model.residual else {}
    document = _Document(
        rig=model.rig.name,
        placements={
            setup: _Placement.model_validate(
                {"rotation": p.rotation.tolist(), "translation_mm": p.translation_mm.tolist()}
            )
            for setup, p in model.placements.items()
        },
        parameters=tuple(
            _Parameter(
                name=p.name,
                unit=p.unit,
                value=p.value,
                standard_error=p.standard_error,
                geometric_stage_value=float(geometric),
                nominal_stage_value=float(nominal),
            )
            for p, geometric, nominal in zip(
                model.parameters, model.geometric_values, model.nominal_values, strict=True
            )
        ),
        prior=model.prior,
        prior_scale=model.prior_scale,
        excess_sigma_mm=model.excess_sigma_mm,
        repeat_sigma_mm=model.repeat_sigma_mm,
        effects_noise_mm=model.effects_noise_mm,
        effects=tuple(_effect(e) for e in model.effects),
        effects_reason=model.effects_reason,
        joint_error_scale=model.joint_error_scale,
        identifiability=_Identifiability(
            parameters=model.identifiability.parameters,
            rank=model.identifiability.rank,
            unidentifiable=model.identifiability.unidentifiable,
            marked=model.identifiability.marked,
            observability=dict(model.identifiability.observability),
        ),
        fixes=dict(model.coverage.fixes),
        ranges=dict(model.coverage.ranges),
        torques=model.coverage.torques,
        outliers=tuple(_Outlier(row=o.row, sigma=o.sigma) for o in model.outliers),
        residual=model.residual
        and _Residual(
            kind=model.residual.learner.kind,
            signals=model.residual.signals,
            prisms=model.residual.prisms,
            excess_variance_mm2=tuple(model.residual.excess_variance_mm2.tolist()),
            files=tuple(sorted(learned)),
        ),
        trials=tuple(
            _Trial(kind=t.kind, before_mm=t.before_mm, after_mm=t.after_mm, p=t.p, kept=t.kept) for t in model.trials
        ),
        residual_reason=model.residual_reason,
        warnings=model.warnings,
        provenance=dict(model.provenance),
    )
    arrays = io.BytesIO()
    np.savez(arrays, covariance=model.covariance)
    files = {
        "rig.toml": model.rig_text.encode(),
        "model.json": (document.model_dump_json(indent=1) + "\n").encode(),
        "covariance.npz": arrays.getvalue(),
        **learned,
    }
    listed = {name: {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)} for name, data in files.items()}
    manifest = {"format": FORMAT, "version": VERSION, "files": listed}
    return files | {MANIFEST: (json.dumps(manifest, indent=1) + "\n").encode()}


def _effect(effect: FittedEffect) -> _Effect:
    return _Effect(
        family=effect.family,
        where=effect.where,
        settings=dict(effect.settings),
        coefficients=tuple(
            _Coefficient(
                name=c.name, unit=c.unit, value=c.value, standard_error=c.standard_error, prior_sigma=c.prior_sigma
            )
            for c in effect.coefficients
        ),
    )


def check_manifest(files: Mapping[str, bytes]) -> dict[str, bytes]:
    """The files that the manifest lists, each as it was written; other files are left aside.

    Raises:
        ModelError: no manifest, another version, a file missing, truncated or edited.
    """
    if MANIFEST not in files:
        raise ModelError(f"{MANIFEST} is missing: this is not a rigcal model")
    try:
        manifest = _Manifest.model_validate_json(files[MANIFEST])
    except ValidationError as error:
        raise ModelError(f"{MANIFEST} is damaged ({_first(error)}); calibrate again or restore the model") from error
    if manifest.version != VERSION:
        raise ModelError(
            f"the model has format version {manifest.version}, this program reads version {VERSION}; calibrate again"
        )
    checked: dict[str, bytes] = {}
    for name, listed in manifest.files.items():
        data = files.get(name)
        if data is None:
            raise ModelError(f"{name} is missing; calibrate again or restore the model")
        if len(data) < listed.bytes:
            raise ModelError(f"{name} is truncated ({len(data)} of {listed.bytes} bytes); restore the model")
        if hashlib.sha256(data).hexdigest() != listed.sha256:
            raise ModelError(f"{name} is not as it was written (SHA-256 differs); restore the model")
        checked[name] = data
    return checked


def read_model(files: Mapping[str, bytes]) -> CalibratedModel:
    """Read a model; ModelError in one sentence for anything that is wrong with it."""
    checked = check_manifest(files)
    try:
        document = _Document.model_validate_json(checked["model.json"])
        rig_text = checked["rig.toml"].decode()
        rig = parse_rig(rig_text, "rig.toml of the model")
        with np.load(io.BytesIO(checked["covariance.npz"]), allow_pickle=False) as arrays:
            covariance = np.asarray(arrays["covariance"], dtype=np.float64)
        residual = None
        if document.residual is not None:
            part = document.residual
            learner = LOADERS[part.kind]({name: checked[name] for name in part.files})
            residual = LearnedResidual(learner, part.signals, part.prisms, np.array(part.excess_variance_mm2))
    except KeyError as error:
        raise ModelError(f"the model lacks {error.args[0]}; calibrate again") from error
    except ValidationError as error:
        raise ModelError(f"model.json is malformed ({_first(error)}); calibrate again") from error
    except (RigError, TypeError, ValueError, zipfile.BadZipFile, EOFError, OSError) as error:
        raise ModelError(f"the model cannot be read ({error}); calibrate again") from error
    placements = {
        setup: Placement(np.array(p.rotation), np.array(p.translation_mm)) for setup, p in document.placements.items()
    }
    chain = Chain(rig, placements)
    _check_parts(document, chain, covariance)
    effects = tuple(_read_effect(part, chain) for part in document.effects)
    if residual is not None:
        names = feature_names(rig, residual.signals)
        if not residual.learner.fits(names, len(names) - len(residual.signals)):
            raise ModelError("the residual was trained on other features than the model's rig has; calibrate again")
    return CalibratedModel(
        rig=rig,
        rig_text=rig_text,
        placements=placements,
        values=np.array([p.value for p in document.parameters]),
        covariance=covariance,
        geometric_values=np.array([p.geometric_stage_value for p in document.parameters]),
        nominal_values=np.array([p.nominal_stage_value for p in document.parameters]),
        prior=document.prior,
        prior_scale=document.prior_scale,
        excess_sigma_mm=document.excess_sigma_mm,
        repeat_sigma_mm=document.repeat_sigma_mm,
        effects_noise_mm=document.effects_noise_mm,
        identifiability=Identifiability(
            document.identifiability.parameters,
            document.identifiability.rank,
            document.identifiability.unidentifiable,
            document.identifiability.marked,
            document.identifiability.observability,
        ),
        coverage=Coverage(document.fixes, document.ranges, document.torques),
        effects=effects,
        effects_reason=document.effects_reason,
        joint_error_scale=document.joint_error_scale,
        outliers=tuple(Outlier(o.row, o.sigma) for o in document.outliers),
        residual=residual,
        trials=tuple(Trial(t.kind, t.before_mm, t.after_mm, t.p, t.kept) for t in document.trials),
        residual_reason=document.residual_reason,
        warnings=document.warnings,
        provenance=document.provenance,
    )


def _check_parts(document: _Document, chain: Chain, covariance: np.ndarray) -> None:
    expected = [p.name for p in chain.parameters]
    if [p.name for p in document.parameters] != expected:
        raise ModelError("the parameters of model.json are not those of its rig; calibrate again")
    size = len(expected) + sum(len(effect.coefficients) for effect in document.effects)
    if covariance.shape != (size, size) or not np.isfinite(covariance).all():
        raise ModelError("covariance.npz does not fit the parameters and effects of model.json; calibrate again")
    for setup, placement in document.placements.items():
        rotation = np.array(placement.rotation)
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6:
            raise ModelError(f"the base of set-up {setup!r} is no rotation; calibrate again")
    strange = [name for name in document.ranges if name not in chain.rig.joint_names]
    if strange:
        raise ModelError(f"model.json speaks of joint {strange[0]!r}, which its rig lacks; calibrate again")


def _read_effect(part: _Effect, chain: Chain) -> FittedEffect:
    """The effect; ModelError where this program's family of that name computes something else from it."""
    family = library().get(part.family)
    if family is None or part.where not in family.places(chain.rig):
        raise ModelError(f"model.json has effect {part.family}@{part.where}, which this program cannot place")
    coefficients = tuple(
        FittedCoefficient(c.name, c.unit, c.value, c.standard_error, c.prior_sigma) for c in part.coefficients
    )
    try:
        names = family.names(part.settings)
    except ValueError as error:
        raise ModelError(f"model.json has effect {part.family}@{part.where} in no form it takes: {error}") from error
    if tuple(c.name for c in coefficients) != names:
        raise ModelError(f"effect {part.family}@{part.where} of model.json needs the coefficients {', '.join(names)}")
    return FittedEffect(part.family, part.where, coefficients, part.settings)


def _first(error: ValidationError) -> str:
    first = error.errors()[0]
    return f"{'.'.join(str(p) for p in first['loc'])}: {first['msg']}"
