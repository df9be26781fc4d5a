"""The work on one rig of a fleet: calibrate it, find effects that its model lacks, and test whether it has changed.

A task holds all input of the work, and the answer is text and numbers, so any process on any computer can do it. The
same task gives the same answer.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from daemon.warm_up import prepare

if TYPE_CHECKING:
    from calibration.model.model import CalibratedModel
    from calibration.observations import Observations
    from calibration.rig.description import Rig
    from calibration.run_settings import Run

_WIDER = 10.0  # width of the prior for comparing rigs, as a multiple of the build tolerances
FORM = 1  # version of the answer's format; answers of other versions are not reused


@dataclass(frozen=True)
class FleetSettings:
    """Settings of the work on each rig.

    Attributes:
        gap: whether to search for missing effects; if False only the kinematics are identified.
        prior: how the build tolerances are used.
        seed: of all random choices.
    """

    gap: bool = True
    prior: str = "recalibration"
    seed: int = 0


@dataclass(frozen=True)
class RigTask:
    """A rig with its data.

    Attributes:
        name: of the rig in the fleet.
        source: where it was found, for people.
        rig_text: its rig file.
        data: observations CSV of the training sessions.
        checks: observations CSV of check sessions, which are never trained on; None if there are none.
        settings: of the work.
        files: CSV files that `data` consists of, each with the line in `data` of its first row.
    """

    name: str
    source: str
    rig_text: str
    data: bytes
    checks: bytes | None
    settings: FleetSettings
    files: tuple[tuple[str, int], ...] = ()

    def place(self, line: int) -> tuple[str, int]:
        """Return the file that a line of `data` comes from, and its line number there."""
        return next(
            ((name, line - first + 2) for name, first in reversed(self.files) if first <= line),
            (self.files[0][0] if self.files else self.name, line),
        )

    @property
    def sha256(self) -> str:
        """SHA-256 of all input that determines the answer."""
        told = [str(FORM), self.rig_text, json.dumps(asdict(self.settings), sort_keys=True)]
        parts = [*(text.encode() for text in told), self.data, self.checks or b""]
        return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()


def assess(task: RigTask) -> dict[str, Any]:
    """Calibrate a rig and return the input for a comparison of rigs.

    Returns:
        JSON: `name`, `source`, `sha256`, `rig`, and either `error` and `kind`, or `fixes`, `sessions`, `noise_mm`,
        `stages` (stage -> RMS, mm), `expected_rms_mm`, `verdict`, `effects`, `parameters` (`name`, `unit`, `value`,
        `sigma`, and `prior_sigma` of the widened prior), `unidentifiable`, `drift` (`session`, `ratio`, `alarm`,
        `reason`) or None, and `warnings`.
    """
    prepare()
    from calibration.errors import CalibrationError, DataError
    from calibration.rig.description import parse_rig

    answer: dict[str, Any] = {"name": task.name, "source": task.source, "sha256": task.sha256}
    try:
        rig = parse_rig(task.rig_text, f"the rig file of {task.name}")
        with ThreadPoolExecutor(1) as pool:
            return answer | {"rig": rig.name} | _assessed(task, rig, pool)
    except CalibrationError as error:
        told = str(error)
        if isinstance(error, DataError) and error.source == task.name and error.line is not None:
            told = str(DataError(task.place(error.line)[0], error.reason, task.place(error.line)[1], error.column))
        return answer | {"error": told, "kind": type(error).__name__}


def _assessed(task: RigTask, rig: Rig, pool: Executor) -> dict[str, Any]:
    from calibration.evaluation.evaluation import evaluate
    from calibration.observations import parse_observations
    from calibration.pipeline.calibrate import identify
    from calibration.pipeline.find_gap import find_gap
    from calibration.run_settings import Run

    settings = task.settings
    prior: Any = settings.prior
    run = Run(settings.seed, pool)
    observations = parse_observations(task.data, rig, task.name)
    verdict = None
    if settings.gap:
        found = find_gap(rig, task.rig_text, observations, prior=prior, run=run)
        model, verdict = found.model, found.verdict
    else:
        model = identify(rig, task.rig_text, observations, prior=prior, effects="none", run=run)
    evaluation = evaluate(model, observations)
    sessions = list(dict.fromkeys(observations.session.tolist()))
    return {
        "fixes": len(observations),
        "sessions": [name for name in sessions if name],
        "noise_mm": model.noise_mm,
        "stages": {str(stage["stage"]): stage["rms_mm"] for stage in evaluation.stages()},
        "expected_rms_mm": None if evaluation.expected is None else evaluation.expected.as_dict()["rms_mm"],
        "verdict": verdict,
        "effects": [effect.as_dict() for effect in model.effects],
        "parameters": _parameters(model),
        "unidentifiable": len(model.identifiability.as_dict()["unidentifiable"]),  # type: ignore[arg-type]  # a list
        "drift": _drift(task, rig, model, observations, run),
        "warnings": list(evaluation.warnings),
    }


def _parameters(model: CalibratedModel) -> list[dict[str, Any]]:
    """Return the constants of the machine under a wide prior, without the base, which differs from rig to rig."""
    from calibration.fleet.hierarchical import widened_prior

    known = model.parameters
    prior = np.array([parameter.prior_sigma for parameter in known])
    covariance = model.covariance[: len(known), : len(known)]
    value, sigma = widened_prior(model.values, covariance, prior, _WIDER)
    return [
        {
            "name": parameter.name,
            "unit": parameter.unit,
            "value": float(value[n]),
            "sigma": float(sigma[n]),
            "prior_sigma": _WIDER * parameter.prior_sigma if np.isfinite(parameter.prior_sigma) else None,
        }
        for n, parameter in enumerate(known)
        if parameter.kind != "base"
    ]


def _drift(
    task: RigTask, rig: Rig, model: CalibratedModel, observations: Observations, run: Run
) -> Mapping[str, Any] | None:
    """Test the newest data, check sessions or the last of several sessions, with a model not trained on them."""
    from calibration.errors import CalibrationError
    from calibration.evaluation.drift import check
    from calibration.numerics.statistics import Cusum
    from calibration.observations import parse_observations
    from calibration.pipeline.calibrate import identify

    try:
        if task.checks is not None:
            newest = parse_observations(task.checks, rig, f"checks of {task.name}")
            name = str(newest.session[-1]) or "checks"
        else:
            name = str(observations.session[-1])
            is_newest = observations.session == name
            if not name or is_newest.all():
                return None
            effects = ",".join(map(str, model.effects)) or "none"
            earlier = observations.select(~is_newest)
            prior: Any = task.settings.prior
            model = identify(rig, task.rig_text, earlier, prior=prior, effects=effects, run=run.quiet())
            newest = observations.select(is_newest)
        found = check(model, newest)
    except CalibrationError as error:
        return {"session": None, "ratio": None, "alarm": None, "reason": str(error)}
    return {"session": name, "ratio": found.ratio, "alarm": Cusum().after(found.scores).alarm, "reason": ""}
