"""The steps that the command line and the daemon's jobs share: identify, train the residual, evaluate, predict."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from importlib import metadata

import numpy as np
from numpy.typing import NDArray

from calibration.accuracy import joint_error_scale
from calibration.effects.base import Situation
from calibration.effects.library import library
from calibration.evaluation import Evaluation, evaluate, require_positions
from calibration.gap.adopt import Adopted, with_effects
from calibration.identification.refinement import Prior
from calibration.identification.samples import reading_covariance, station_covariance
from calibration.identification.search.checkpoint import Checkpoint
from calibration.identification.solve import Solution
from calibration.intervals import with_intervals
from calibration.limits import turns_deg
from calibration.methods import OWN_LEARNERS, TORQUE_NETWORK, Options, identify_by
from calibration.model import OUTLIER_SIGMA, CalibratedModel, Coverage, LearnedResidual
from calibration.observations import Observations, data_sha256, originals
from calibration.residual.features import Features, usable_loads, usable_signals, usable_torques
from calibration.residual.folds import group_labels, standstill_labels
from calibration.residual.hybrid import Decision, Kind, decide, torque_compensation
from calibration.residual.region import fit_region
from calibration.rig import Rig
from calibration.single_thread import SingleThreaded, one_blas_thread
from calibration.training_warnings import training_warnings

Flags = NDArray[np.bool_]
Progress = Callable[[float, str], None]

_MEDIAN_LENGTH = 1.538  # of three standard normal numbers

__all__ = [
    "Evaluation",
    "calibrate",
    "compensate_torques",
    "evaluate",
    "identify",
    "rows_to_learn_from",
    "train_residual",
]

_MOST_WORKERS = 4


def identify(
    rig: Rig,
    rig_text: str,
    observations: Observations,
    *,
    seed: int = 0,
    prior: Prior = "recalibration",
    method: str = "default",
    effects: str = "auto",
    executor: Executor | None = None,
    progress: Progress | None = None,
    should_stop: Callable[[], bool] | None = None,
    checkpoint: Checkpoint | None = None,
) -> CalibratedModel:
    """Identify the kinematics, and the effects that the data or the caller ask for.

    Args:
        rig, rig_text: the rig description and the TOML it was read from, which travels in the model.
        observations: training rows, all with positions.
        seed: of everything random; the same seed gives the same model on every executor.
        prior: trust the build tolerances, or estimate their scale.
        method: one of `methods.METHODS`.
        effects: `auto`, `none` or FAMILY@WHERE,...
        executor: runs the search; threads of its own by default.
        progress: told (share done, what is going on); what it raises ends the work.
        should_stop: asked during a global search; once it says so, the best so far is taken.
        checkpoint: where a global search keeps its state, and goes on from.

    Raises:
        DataError: rows without positions, prisms the rig lacks, data that the method or an effect cannot use.
        UnsafeError: too few fixes, a base that cannot be placed, mirrored coordinates, another rig's data.
        ValueError: an unknown method or effect.
    """
    require_positions(observations)
    with executor_or_threads(executor) as pool:
        options = Options(prior, effects, seed, pool, progress or _silent, should_stop, checkpoint)
        adopted = identify_by(method, rig, observations, options)
        model = model_of(rig, rig_text, observations, adopted, prior, {"seed": seed, "method": method})
    return model


def model_of(
    rig: Rig,
    rig_text: str,
    observations: Observations,
    adopted: Adopted,
    prior: Prior,
    provenance: Mapping[str, str | int | float],
) -> CalibratedModel:
    """The model that kinematics and effects make, before any residual is learned.

    Args:
        rig, rig_text: the rig description and the TOML it was read from.
        observations: training rows.
        adopted: what was fitted to them.
        prior: how the build tolerances were used.
        provenance: of the fit, beside what is known here.
    """
    # What the kinematics alone found stays in the model; effects are put on top.
    kinematics = replace(adopted.solution, fit=adopted.geometric, additions=None)
    fit, samples = kinematics.fit, kinematics.samples
    original = _is_original(observations)
    distinct = observations.select(original)
    situation = Situation(kinematics.chain, fit.x, observations)
    model = CalibratedModel(
        rig=rig,
        rig_text=rig_text,
        placements=kinematics.chain.placements,
        values=fit.x,
        covariance=fit.covariance,
        geometric_values=fit.x,
        nominal_values=kinematics.nominal.x,
        prior=prior,
        prior_scale=fit.prior_scale,
        excess_sigma_mm=float(np.sqrt(fit.excess_variance)),
        repeat_sigma_mm=float(np.sqrt(samples.repeat_variance)),
        effects_noise_mm=_noise_mm(kinematics, distinct),
        identifiability=kinematics.identifiability,
        coverage=Coverage(
            {prism: int((distinct.prism == prism).sum()) for prism in rig.prism_names},
            {name: (float(v.min()), float(v.max())) for name, v in observations.joints.items()},
            tuple(name for name in rig.joint_names if situation.is_torque_measured(name)),
            _payload(observations),
            _loads(adopted, situation),
        ),
        provenance={
            "data_sha256": data_sha256(observations, rig),
            "rig_sha256": hashlib.sha256(rig_text.encode()).hexdigest(),
            "fixes": len(distinct),
            **provenance,
            "search": kinematics.search,
            **_versions(),
        },
    )
    model = with_effects(model, adopted)
    model = replace(model, outliers=tuple(o for o in model.find_outliers(observations) if original[o.row]))
    lacking = joint_error_scale(model, distinct, structured=adopted.structured)
    model = replace(model, joint_error_scale=lacking)
    model = with_intervals(model, distinct)
    doubts = (*adopted.warnings, *training_warnings(model, distinct, adopted.solution))
    return replace(model, warnings=doubts)


def _payload(observations: Observations) -> tuple[float, float] | None:
    """The lowest and highest `payload_kg`; None where no row has it."""
    payload = observations.extra.get("payload_kg", np.empty(0))
    measured = payload[np.isfinite(payload)]
    return (float(measured.min()), float(measured.max())) if len(measured) else None


def _loads(adopted: Adopted, situation: Situation) -> dict[str, tuple[float, float]]:
    """The lowest and highest load on every joint that has an effect of it."""
    loaded = {effect.where for effect in adopted.effects if library()[effect.family].goes_with == "torque"}
    loads = {name: situation.torque(name) for name in sorted(loaded)}
    known = {name: load[np.isfinite(load)] for name, load in loads.items()}
    return {name: (float(load.min()), float(load.max())) for name, load in known.items() if len(load)}


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
    good = rows_to_learn_from(model, observations)
    rows = observations.select(good)
    signals = (*usable_signals(rows), *usable_loads(model.chain, model.values, model.corrected(rows)))
    seen = model.residual_features(rows, signals)
    with executor_or_threads(executor) as pool:
        decision = decide(
            seen,
            model.to_base(rows, rows.position_mm - model.effects_mm(rows)),
            group_labels(rows),
            standstill_labels(rows),
            kind=kind,
            seed=seed,
            executor=pool,
            progress=lambda share: report(share, "learning the residual"),
        )
    return _with_residual(model, observations, good, seen, decision, signals, seed)


@one_blas_thread()
def compensate_torques(model: CalibratedModel, observations: Observations, *, seed: int = 0) -> CalibratedModel:
    """Add the second paper's network on the joint torques (RBF-TCM), as the paper has it: always kept.

    Args:
        model: identified on the same rows.
        observations: training rows.
        seed: of folds.

    Raises:
        UnsafeError: a set-up that the model does not know.
    """
    good = rows_to_learn_from(model, observations)
    rows = observations.select(good)
    torques = usable_torques(model.chain, model.values, rows)
    seen = model.residual_features(rows, torques)
    decision = torque_compensation(
        seen,
        model.to_base(rows, rows.position_mm - model.effects_mm(rows)),
        group_labels(rows),
        standstill_labels(rows),
        torques,
        seed=seed,
    )
    return _with_residual(model, observations, good, seen, decision, torques, seed)


def rows_to_learn_from(model: CalibratedModel, observations: Observations) -> Flags:
    """(n,) which rows a residual is learned from: neither outliers nor copies of an earlier row.

    Where the kinematics leave much, and that is when there is most to learn, many rows are farther off than noise
    explains; here an outlier is farther off than the other rows.
    """
    require_positions(observations)
    size = model.deviations(observations)
    usual = max(1.0, float(np.median(size)) / _MEDIAN_LENGTH)
    return _is_original(observations) & (size <= OUTLIER_SIGMA * usual)


def _is_original(observations: Observations) -> Flags:
    """(n,) False for copies of an earlier row, which are no further measurement."""
    return np.asarray(originals(observations) == np.arange(len(observations)))


def _with_residual(
    model: CalibratedModel,
    observations: Observations,
    good: Flags,
    seen: Features,
    decision: Decision,
    signals: tuple[str, ...],
    seed: int,
) -> CalibratedModel:
    told = replace(
        model,
        residual=None,
        trials=decision.trials,
        residual_reason=decision.reason,
        provenance={**model.provenance, "residual_seed": seed},
    )
    distinct = _is_original(observations)
    if decision.residual is None:
        return with_intervals(told, observations.select(distinct))
    rows = observations.select(good)
    region = fit_region(
        seen,
        model.rig.joints,
        turns_deg(model.rig),
        signals,
        decision.split,
        decision.residual.predict,
        next(t.before_mm**2 - t.after_mm**2 for t in decision.trials if t.kind == decision.residual.kind),
    )
    excess = model.unexplained_mm2(rows, decision.variance_mm2)
    prisms = tuple(np.unique(rows.prism).tolist())
    learned = LearnedResidual(decision.residual, signals, prisms, excess, region)
    # Trained on all rows, the learner leaves less than those of the folds did.
    less = np.sqrt(decision.variance_mm2.sum() / (decision.left_mm**2).mean(axis=0).sum())
    return with_intervals(
        replace(told, residual=learned),
        observations.select(distinct),
        good[distinct],
        model.to_station(rows, less * decision.left_mm),
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
    should_stop: Callable[[], bool] | None = None,
    checkpoint: Checkpoint | None = None,
) -> tuple[CalibratedModel, Evaluation]:
    """Identify, train the residual, and evaluate on the training rows themselves.

    Args:
        residual: as `train_residual`'s `kind`; by `default` the second paper's methods have their own network or none.
        others: as `identify`.

    Raises:
        ValueError: an unknown method or effect; all else as `identify` and `train_residual`.
    """
    report = progress or _silent
    model = identify(
        rig,
        rig_text,
        observations,
        seed=seed,
        prior=prior,
        method=method,
        effects=effects,
        executor=executor,
        progress=lambda share, what: report(0.4 * share, what),
        should_stop=should_stop,
        checkpoint=checkpoint,
    )
    if method == TORQUE_NETWORK and residual == "default":
        model = compensate_torques(model, observations, seed=seed)
    else:
        model = train_residual(
            model,
            observations,
            kind=OWN_LEARNERS.get(method, residual) if residual == "default" else residual,
            seed=seed,
            executor=executor,
            progress=lambda share, what: report(0.4 + 0.55 * share, what),
        )
    evaluation = evaluate(model, observations)
    report(1.0, "done")
    return model, evaluation


def _noise_mm(solution: Solution, observations: Observations) -> float:
    """RMS 3-D noise of one fix: station, readings, timing, repeats and what the kinematics lack."""
    chain, fit, samples = solution.chain, solution.fit, solution.samples
    lin = chain.linearise(fit.x, samples.data)
    station = station_covariance(chain.rig, observations.position_mm, observations.sigma_mm)
    readings = reading_covariance(chain.rig, lin.joint_jacobian, samples.rates)
    mean = sum(float(np.trace(c, axis1=1, axis2=2).mean()) for c in (station, readings))
    return float(np.sqrt(mean + 3.0 * (fit.excess_variance + samples.repeat_variance)))


@contextmanager
def executor_or_threads(executor: Executor | None) -> Iterator[Executor]:
    """The executor, or threads of our own; here and in the workers each call into BLAS keeps to its thread."""
    with one_blas_thread():
        if executor is not None:
            yield SingleThreaded(executor)
            return
        with ThreadPoolExecutor(max_workers=min(_MOST_WORKERS, os.cpu_count() or 1)) as pool:
            yield SingleThreaded(pool)


def _versions() -> dict[str, str]:
    return {name: metadata.version(name) for name in ("rigcal", "numpy", "scipy", "numba", "lightgbm")}


def _silent(share: float, what: str) -> None:
    """Progress that nobody watches."""
