"""Calibrate a rig: identify kinematics and effects, train a learner of the residual, evaluate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.errors import UnsafeError
from calibration.evaluation.evaluation import Evaluation, evaluate, require_positions
from calibration.identification.refinement import Prior
from calibration.model.intervals import with_intervals
from calibration.model.model import CalibratedModel, LearnedResidual
from calibration.model.prediction import OUTLIER_SIGMA, Predictor
from calibration.numerics.single_thread import one_blas_thread
from calibration.observations import Observations, is_original
from calibration.pipeline.build_model import build_model
from calibration.pipeline.methods import METHODS, Task, identify_by
from calibration.residual.features import Features, usable_loads, usable_signals, usable_torques
from calibration.residual.folds import group_labels, standstill_labels
from calibration.residual.region import fit_region
from calibration.residual.selection import Kind, Selection, select_residual, torque_compensation
from calibration.rig.description import Rig
from calibration.rig.limits import turns_deg
from calibration.run_settings import DEFAULT_RUN, Run

Flags = NDArray[np.bool_]

_MEDIAN_LENGTH = 1.538  # of three standard normal numbers


def calibrate(
    rig: Rig,
    rig_text: str,
    observations: Observations,
    *,
    prior: Prior = "recalibration",
    method: str = "default",
    effects: str = "auto",
    residual: Kind = "default",
    run: Run = DEFAULT_RUN,
) -> tuple[CalibratedModel, Evaluation]:
    """Calibrate a rig from observations: identify, train the residual learner, evaluate.

    Args:
        rig: the rig description.
        rig_text: TOML text of the rig file, which is stored in the model.
        observations: n training rows, all with positions, mm in the station's frame.
        prior: `recalibration` trusts the rig file's build tolerances, `as-built` estimates their scale.
        method: a name in `methods.METHODS`.
        effects: `auto` for effects with evidence in the data, `none`, or FAMILY@WHERE,... by name.
        residual: `kind` of `train_residual`; by default the second paper's methods use their own network or none.
        run: seed, workers, progress and checkpoint.

    Returns:
        The model, and its errors on the training rows.

    Raises:
        DataError: rows without positions, prisms that the rig lacks, data that the method or an effect cannot use.
        UnsafeError: too few fixes, a base that cannot be placed, mirrored coordinates, a different rig's data.
        CalibrationError: LightGBM's system library is missing.
        ValueError: the method or an effect is unknown.
    """
    observations = observations.numbered()
    model = identify(rig, rig_text, observations, prior=prior, method=method, effects=effects, run=run.part(0.0, 0.4))
    kind = METHODS[method].residual if residual == "default" else residual
    if kind == "torque network":
        model = compensate_torques(model, observations, seed=run.seed)
    else:
        model = train_residual(model, observations, kind=kind, run=run.part(0.4, 0.95))
    evaluation = evaluate(model, observations)
    run.progress(1.0, "done")
    return model, evaluation


def identify(
    rig: Rig,
    rig_text: str,
    observations: Observations,
    *,
    prior: Prior = "recalibration",
    method: str = "default",
    effects: str = "auto",
    run: Run = DEFAULT_RUN,
) -> CalibratedModel:
    """Identify the kinematics, and the effects that have evidence in the data or are requested.

    Arguments as `calibrate`.

    Returns:
        The model without a residual.

    Raises:
        DataError, UnsafeError, ValueError: as `calibrate`.
    """
    require_positions(observations)
    observations = observations.numbered()
    with run.workers() as pool:
        adopted = identify_by(method, Task(rig, observations, prior, effects, replace(run, executor=pool)))
        return build_model(rig, rig_text, observations, adopted, prior, {"seed": run.seed, "method": method})


def train_residual(
    model: CalibratedModel,
    observations: Observations,
    *,
    kind: Kind = "default",
    run: Run = DEFAULT_RUN,
) -> CalibratedModel:
    """Train a learner of the residual, and keep it only if it helps on held-out groups.

    Args:
        model: identified on the same rows.
        observations: training rows.
        kind: one learner, `none`, or `default` for the best.
        run: seed of folds and learners, workers, progress.

    Returns:
        The model with the residual, or with the reason why it has none.

    Raises:
        UnsafeError: a set-up that the model does not know.
        CalibrationError: LightGBM's system library is missing.
    """
    run.progress(0.0, "learning the residual")
    good = rows_to_learn_from(model, observations)
    rows, predictor = observations.select(good), Predictor.of(model)
    signals = (*usable_signals(rows), *usable_loads(model.chain, model.values, predictor.corrected(rows)))
    seen = predictor.features(rows, signals)
    with run.workers() as pool:
        decision = select_residual(
            seen,
            predictor.to_base(rows, rows.position_mm - predictor.effects_mm(rows)),
            group_labels(rows),
            standstill_labels(rows),
            kind=kind,
            seed=run.seed,
            executor=pool,
            progress=lambda share: run.progress(share, "learning the residual"),
        )
    return _with_residual(model, observations, good, seen, decision, signals, run.seed)


@one_blas_thread()
def compensate_torques(model: CalibratedModel, observations: Observations, *, seed: int = 0) -> CalibratedModel:
    """Add the second paper's network on the joint torques (RBF-TCM); as in the paper, it is always kept.

    Args:
        model: identified on the same rows.
        observations: training rows.
        seed: seed of folds.

    Raises:
        UnsafeError: a set-up that the model does not know.
    """
    good = rows_to_learn_from(model, observations)
    rows, predictor = observations.select(good), Predictor.of(model)
    torques = usable_torques(model.chain, model.values, rows)
    seen = predictor.features(rows, torques)
    decision = torque_compensation(
        seen,
        predictor.to_base(rows, rows.position_mm - predictor.effects_mm(rows)),
        group_labels(rows),
        standstill_labels(rows),
        torques,
        seed=seed,
    )
    return _with_residual(model, observations, good, seen, decision, torques, seed)


def rows_to_learn_from(model: CalibratedModel, observations: Observations) -> Flags:
    """Return an (n,) mask of the rows from which to learn a residual: neither outliers nor copies of earlier rows.

    If the kinematics leave large errors, which is when there is most to learn, many errors exceed the noise. Therefore
    the threshold for outliers here is relative to the median error.
    """
    require_positions(observations)
    size = Predictor.of(model).deviations(observations)
    usual = max(1.0, float(np.median(size)) / _MEDIAN_LENGTH)
    return is_original(observations) & (size <= OUTLIER_SIGMA * usual)


def _with_residual(
    model: CalibratedModel,
    observations: Observations,
    good: Flags,
    seen: Features,
    decision: Selection,
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
    distinct = is_original(observations)
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
    excess = Predictor.of(model).unexplained_mm2(rows, decision.variance_mm2)
    prisms = tuple(np.unique(rows.prism).tolist())
    learned = LearnedResidual(decision.residual, signals, prisms, excess, region)
    # The errors of the learner trained on all rows are smaller than those of the folds' learners.
    less = np.sqrt(decision.variance_mm2.sum() / (decision.left_mm**2).mean(axis=0).sum())
    return with_intervals(
        replace(told, residual=learned),
        observations.select(distinct),
        good[distinct],
        Predictor.of(model).to_station(rows, less * decision.left_mm),
    )


def require_known_setups(training: Observations, held_out: Observations, remedy: str) -> None:
    """Raise UnsafeError for held-out rows from a set-up without training rows, as its base is not known.

    Args:
        training: rows of the fit.
        held_out: rows for testing the fit.
        remedy: what to do about such a set-up, for the end of the message.

    Raises:
        UnsafeError: there is such a set-up.
    """
    known = set(training.setup.tolist())
    unknown = sorted(set(held_out.setup.tolist()) - known)
    if unknown:
        raise UnsafeError(
            f"set-up {unknown[0]!r} of the held-out rows is not among those of the training rows "
            f"({', '.join(map(repr, sorted(known)))}); {remedy}"
        )
