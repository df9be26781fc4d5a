"""The steps that the command line and the daemon's jobs share: identify, train the residual, evaluate, predict."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import metadata

import numpy as np
from threadpoolctl import threadpool_limits

from calibration.errors import DataError
from calibration.identification.samples import reading_covariance, station_covariance
from calibration.identification.solve import Solution, solve
from calibration.model import CalibratedModel, Coverage, LearnedResidual, Outlier, Prediction, Prior
from calibration.observations import Floats, Observations, Strings, format_observations
from calibration.rebase import with_refitted_base
from calibration.residual.features import features, usable_signals
from calibration.residual.folds import group_labels
from calibration.residual.hybrid import Kind, decide
from calibration.rig import Rig

Progress = Callable[[float, str], None]

STAGES = ("nominal", "geometric", "effects", "hybrid")
METHODS = ("default",)
EFFECTS = ("auto", "none")
_MOST_WORKERS = 4
_LISTED = 10
_BADLY = 0.3  # of what build tolerances explain
_FAR_RAD = math.radians(10.0)
_PULLED = 4.0  # build tolerances
_IMMOBILE = 0.01  # of the span between a joint's limits
_BEYOND_LIMITS = 0.05


@dataclass(frozen=True)
class Evaluation:
    """A model on observations.

    Attributes:
        model: what was evaluated, with the base refitted where that was asked for.
        observations: the rows.
        errors_mm: stage -> (n, 3) measured minus modelled, in the station's frame.
        sigma_mm: (n, 3) standard deviation that the model expects of the hybrid stage's errors.
        outliers: rows farther off than noise explains.
        warnings: about model and data.
    """

    model: CalibratedModel
    observations: Observations
    errors_mm: Mapping[str, Floats]
    sigma_mm: Floats
    outliers: tuple[Outlier, ...]
    warnings: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.observations)

    def stages(self, prism: str | None = None) -> list[dict[str, str | float]]:
        """Mean, RMS, greatest and standard deviation of the 3-D error of every stage, over all rows or one prism's."""
        rows = np.ones(len(self), dtype=bool) if prism is None else self.observations.prism == prism
        return [{"stage": stage, **_statistics(self.errors_mm[stage][rows])} for stage in STAGES]

    def as_dict(self, seconds: float) -> dict[str, object]:
        """The contract's JSON object of `calibrate` and `evaluate`; `seconds` is what the caller's clock says."""
        return {
            "rig": self.model.rig.name,
            "n": len(self),
            "seconds": seconds,
            "stages": self.stages(),
            "per_prism": {prism: self.stages(prism) for prism in _present(self.observations.prism)},
            "effects": [],
            "residual": self.model.residual.learner.kind if self.model.residual else None,
            "noise_mm": self.model.noise_mm,
            "identifiability": self.model.identifiability.as_dict(),
            "warnings": list(self.warnings),
            "ignored_columns": list(self.observations.ignored_columns),
        }


def identify(
    rig: Rig,
    rig_text: str,
    observations: Observations,
    *,
    seed: int = 0,
    prior: Prior = "recalibration",
    method: str = "default",
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> CalibratedModel:
    """Identify the kinematics.

    Args:
        rig, rig_text: the rig description and the TOML it was read from, which travels in the model.
        observations: training rows, all with positions.
        seed: of everything random; the same seed gives the same model on every executor.
        prior: trust the build tolerances, or estimate their scale.
        method: `default`.
        executor: runs the search; threads of its own by default.
        progress: told (share done, what is going on); what it raises ends the work.

    Raises:
        DataError: rows without positions, prisms the rig lacks.
        UnsafeError: too few fixes, a base that cannot be placed, mirrored coordinates, another rig's data.
        ValueError: an unknown method.
    """
    if method not in METHODS:
        raise ValueError(f"method {method!r} is not available; available: {', '.join(METHODS)}")
    _require_positions(observations)
    with _executor(executor) as pool:
        solution = solve(rig, observations, prior=prior, seed=seed, executor=pool, progress=progress or _silent)
    fit, samples = solution.fit, solution.samples
    model = CalibratedModel(
        rig=rig,
        rig_text=rig_text,
        placements=solution.chain.placements,
        values=fit.x,
        covariance=fit.covariance,
        nominal_values=solution.nominal.x,
        prior=prior,
        prior_scale=fit.prior_scale,
        excess_sigma_mm=float(np.sqrt(fit.excess_variance)),
        repeat_sigma_mm=float(np.sqrt(samples.repeat_variance)),
        geometric_noise_mm=_noise_mm(solution, observations),
        identifiability=solution.identifiability,
        coverage=Coverage(
            {prism: int((observations.prism == prism).sum()) for prism in rig.prism_names},
            {name: (float(v.min()), float(v.max())) for name, v in observations.joints.items()},
        ),
        provenance={
            "data_sha256": data_sha256(observations, rig),
            "rig_sha256": hashlib.sha256(rig_text.encode()).hexdigest(),
            "fixes": len(observations),
            "seed": seed,
            "method": method,
            "search": solution.search,
            **_versions(),
        },
    )
    model = replace(model, outliers=model.find_outliers(observations))
    return replace(model, warnings=tuple(_training_warnings(model, observations, solution)))


def train_residual(
    model: CalibratedModel,
    observations: Observations,
    *,
    kind: Kind = "default",
    seed: int = 0,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> CalibratedModel:
    """Learn what the kinematics leave over, and keep it only where it helps on held-out groups.

    Args:
        model: identified on the same rows.
        observations: training rows.
        kind: one learner, `none`, or `default` for whichever is best.
        seed: of folds and learners.
        executor: runs what is independent, threads of its own by default; the result does not depend on it.
        progress: told (share done, what is going on).

    Raises:
        UnsafeError: a set-up that the model does not know.
        CalibrationError: LightGBM's system library is missing.
    """
    report = progress or _silent
    report(0.0, "learning the residual")
    _require_positions(observations)
    good = np.ones(len(observations), dtype=bool)
    good[[o.row for o in model.find_outliers(observations)]] = False
    rows = observations.select(good)
    signals = usable_signals(rows)
    with _executor(executor) as pool:
        decision = decide(
            features(model.chain, model.values, rows, signals),
            model.to_base(rows, rows.position_mm - model.geometric_mm(rows)),
            group_labels(rows),
            rows.cells(),
            kind=kind,
            seed=seed,
            executor=pool,
            progress=lambda share: report(share, "learning the residual"),
        )
    learned = None
    if decision.residual is not None:
        excess = model.unexplained_mm2(rows, decision.variance_mm2)
        learned = LearnedResidual(decision.residual, signals, tuple(_present(rows.prism)), excess)
    return replace(
        model,
        residual=learned,
        trials=decision.trials,
        residual_reason=decision.reason,
        provenance={**model.provenance, "residual_seed": seed},
    )


def calibrate(
    rig: Rig,
    rig_text: str,
    observations: Observations,
    *,
    seed: int = 0,
    prior: Prior = "recalibration",
    method: str = "default",
    effects: str = "auto",
    residual: Kind = "default",
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> tuple[CalibratedModel, Evaluation]:
    """Identify, train the residual, and evaluate on the training rows themselves.

    Args:
        effects: `none`, or `auto`, which has no effects to choose from yet and does the same.
        residual: as `train_residual`'s `kind`; the rest as `identify`.

    Raises:
        ValueError: an unknown method or effect; all else as `identify` and `train_residual`.
    """
    if effects not in EFFECTS:
        raise ValueError(f"effects {effects!r} are not available; available: {', '.join(EFFECTS)}")
    report = progress or _silent
    model = identify(
        rig,
        rig_text,
        observations,
        seed=seed,
        prior=prior,
        method=method,
        executor=executor,
        progress=lambda share, what: report(0.4 * share, what),
    )
    model = train_residual(
        model,
        observations,
        kind=residual,
        seed=seed,
        executor=executor,
        progress=lambda share, what: report(0.4 + 0.55 * share, what),
    )
    evaluation = evaluate(model, observations)
    report(1.0, "done")
    return model, evaluation


def evaluate(model: CalibratedModel, observations: Observations, *, refit_base: bool = False) -> Evaluation:
    """Errors of every stage on observations.

    Args:
        model: the model.
        observations: rows with positions.
        refit_base: fit the base transform of every set-up, and nothing else, on these rows.

    Raises:
        UnsafeError: a set-up that the model does not know, or whose base cannot be placed with these rows.
    """
    _require_positions(observations)
    warnings = list(model.warnings)
    if refit_base:
        model = with_refitted_base(model, observations)
        names = ", ".join(repr(s) for s in model.placements)
        warnings.append(f"the base transform of set-up {names} was fitted on these {len(observations)} fixes")
    warnings += [w for w in model.doubts(observations) if w not in warnings]
    prediction = model.predict(observations)
    geometric = observations.position_mm - model.geometric_mm(observations)
    errors = {
        "nominal": observations.position_mm - model.nominal_mm(observations),
        "geometric": geometric,
        "effects": geometric,
        "hybrid": observations.position_mm - prediction.position_mm,
    }
    return Evaluation(
        model, observations, errors, prediction.sigma_mm, model.find_outliers(observations), tuple(warnings)
    )


def predict(model: CalibratedModel, observations: Observations) -> Prediction:
    """Positions with standard deviations.

    Raises:
        UnsafeError: a set-up that the model does not know.
    """
    return model.predict(observations)


def data_sha256(observations: Observations, rig: Rig) -> str:
    """SHA-256 of the observations in canonical form: the same for a file, a stored session and a replay of it."""
    return hashlib.sha256(format_observations(observations, rig).encode()).hexdigest()


def _noise_mm(solution: Solution, observations: Observations) -> float:
    """RMS 3-D noise of one fix: station, readings, timing, repeats and what the kinematics lack."""
    chain, fit, samples = solution.chain, solution.fit, solution.samples
    lin = chain.linearise(fit.x, samples.data)
    station = station_covariance(chain.rig, observations.position_mm, observations.sigma_mm)
    readings = reading_covariance(chain.rig, lin.joint_jacobian, samples.rates)
    mean = sum(float(np.trace(c, axis1=1, axis2=2).mean()) for c in (station, readings))
    return float(np.sqrt(mean + 3.0 * (fit.excess_variance + samples.repeat_variance)))


def _training_warnings(model: CalibratedModel, observations: Observations, solution: Solution) -> Iterator[str]:
    if not solution.fit.settled:
        yield "the fit had not come to rest when it ended; treat the result with care"
    if model.geometric_noise_mm > _BADLY * solution.tolerated_mm:
        hint = "; try --prior as-built" if model.prior == "recalibration" else ""
        yield (
            f"the kinematics fit badly: {model.geometric_noise_mm:.1f} mm RMS are left where build tolerances explain "
            f"{solution.tolerated_mm:.0f} mm before the fit; check zeros and signs of the joints and the rig file{hint}"
        )
    for parameter in model.parameters:
        if parameter.kind == "row" and parameter.unit == "rad" and abs(parameter.value) > _FAR_RAD:
            yield (
                f"{parameter.name} came out {math.degrees(parameter.value):+.1f} deg from the rig file; "
                f"check how the joint and its encoder are mounted, and correct the file"
            )
    for prism, fixes in model.coverage.fixes.items():
        if fixes == 0:
            yield f"prism {prism!r} has no fixes; its offset stays at its nominal value"
    for joint in model.rig.joints:
        low, high = model.coverage.ranges[joint.name]
        if high - low < _IMMOBILE * (joint.limits[1] - joint.limits[0]):
            yield (
                f"{joint.name} never moved ({low:.2f} .. {high:.2f} {joint.unit}); "
                f"what only its motion shows stays at its prior"
            )
        margin = _BEYOND_LIMITS * (joint.limits[1] - joint.limits[0])
        values = observations.joints[joint.name]
        beyond = int(((values < joint.limits[0] - margin) | (values > joint.limits[1] + margin)).sum())
        if beyond:
            yield (
                f"{joint.name}: {beyond} of {len(values)} readings are beyond its limits {joint.limits[0]:g} .. "
                f"{joint.limits[1]:g} {joint.unit}; check column and unit"
            )
    if model.outliers:
        worst = sorted(model.outliers, key=lambda o: -o.sigma)
        rows = ", ".join(str(o.row + 1) for o in worst[:_LISTED])
        more = f" and {len(worst) - _LISTED} more" if len(worst) > _LISTED else ""
        yield (
            f"{len(worst)} of {len(observations)} training fixes are outliers and were weighted out (row {rows}{more}; "
            f"up to {worst[0].sigma:.0f} sigma)"
        )
    pulled = sorted((p for p in model.parameters if abs(p.pull) > _PULLED), key=lambda p: -abs(p.pull))
    if pulled and model.prior == "recalibration":
        names = ", ".join(f"{p.name} ({p.pull:+.1f})" for p in pulled[:_LISTED])
        yield f"corrected by more than {_PULLED:g} build tolerances: {names}; an unmodelled effect may hide there"


def _statistics(error_mm: Floats) -> dict[str, float]:
    norm = np.linalg.norm(error_mm, axis=1)
    return {
        "mean_mm": float(norm.mean()),
        "rms_mm": float(np.sqrt((norm**2).mean())),
        "max_mm": float(norm.max()),
        "std_mm": float(norm.std()),
    }


def _present(prisms: Strings) -> list[str]:
    return sorted(set(prisms.tolist()))


def _require_positions(observations: Observations) -> None:
    if len(observations) == 0:
        raise DataError("observations", "there are none")
    if not np.isfinite(observations.position_mm).all():
        raise DataError("observations", "every row needs a measured position", column="x_mm")


@contextmanager
def _executor(executor: Executor | None) -> Iterator[Executor]:
    """The executor, or threads of our own; meanwhile each call into BLAS keeps to its thread.

    BLAS threads under worker threads wait for each other in busy loops (several times slower on two cores), and other
    numbers of them make other sums.
    """
    with threadpool_limits(1, user_api="blas"):
        if executor is not None:
            yield executor
            return
        with ThreadPoolExecutor(max_workers=min(_MOST_WORKERS, os.cpu_count() or 1)) as pool:
            yield pool


def _versions() -> dict[str, str]:
    return {name: metadata.version(name) for name in ("rigcal", "numpy", "scipy", "numba", "lightgbm")}


def _silent(share: float, what: str) -> None:
    """Progress that nobody watches."""
