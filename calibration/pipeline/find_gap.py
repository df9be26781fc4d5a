"""Find effects missing in a simulation: calibrate, and return evidence, forecasts and proposals of the search."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace

import numpy as np

from calibration.effects.fitted import AppliedEffects
from calibration.effects.library import library
from calibration.evaluation.evaluation import require_positions
from calibration.gap.candidates import partly_known
from calibration.gap.detection import detect
from calibration.gap.discrimination import propose_experiments
from calibration.gap.forecast import forecasts
from calibration.gap.formulas.grammar import Grammar
from calibration.gap.joint_fit import JointFit
from calibration.gap.result import Candidate, GapResult, Round, Verdict
from calibration.gap.screening import ScoredEffect, Screen
from calibration.gap.search_result import Remaining, SearchResult, SelectionStep
from calibration.identification.noise import reading_covariance, station_covariance
from calibration.identification.refinement import Prior
from calibration.identification.samples import Samples
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.model.warnings import model_warnings
from calibration.observations import Floats, Observations, are_among
from calibration.pipeline.build_model import build_model
from calibration.pipeline.calibrate import require_known_setups
from calibration.pipeline.methods import effects_rng, find_effects
from calibration.residual.folds import folds
from calibration.rig.description import Rig
from calibration.run_settings import DEFAULT_RUN, Run

_FOLDS = 10
_LISTED = 12  # candidates of a round
_EXCESS_SEEN = 0.2  # of the known noise's standard deviation; less is not mentioned


def find_gap(
    rig: Rig,
    rig_text: str,
    observations: Observations,
    *,
    holdout: Observations | None = None,
    prior: Prior = "recalibration",
    families: Collection[str] | None = None,
    run: Run = DEFAULT_RUN,
) -> GapResult:
    """Find where simulation and measurement disagree, name the missing effects, and add them.

    This is `calibrate` without a residual, but it also returns all intermediate results of the search.

    Args:
        rig: the rig description.
        rig_text: TOML text of the rig file, which is stored in the model.
        observations: n training rows, all with positions, mm in the station's frame.
        holdout: further rows, at set-ups of the training rows, that are not used in any fit.
        prior: `recalibration` trusts the rig file's build tolerances, `as-built` estimates their scale.
        families: families of effects that may be named; the whole library by default.
        run: seed, workers, progress and checkpoint.

    Returns:
        The verdict with its evidence, the model with the named effects, and what to measure next.

    Raises:
        DataError: rows without positions, prisms that the rig lacks.
        UnsafeError: too few fixes, a base that cannot be placed, mirrored coordinates, a different rig's data, held-out
            rows of a set-up that the training rows lack.
    """
    require_positions(observations)
    if holdout is not None:
        require_positions(holdout)
        remedy = (
            "hold out rows of these set-ups, or test the model at the new one afterwards with evaluate --refit-base"
        )
        require_known_setups(observations, holdout, remedy)
    observations = observations.numbered()
    families = library() if families is None else families
    with run.workers() as pool:
        run = replace(run, executor=pool)
        rng = effects_rng(run.seed)
        rest = find_effects(rig, observations, families, prior, run.part(0.0, 0.9), rng)
        run.progress(0.9, "building the model")
        model = build_model(rig, rig_text, observations, rest.adopted, prior, {"seed": run.seed, "method": "gap"})
        return _answer(rest, model, families, observations, holdout, run.seed, rng)


def _answer(
    rest: Remaining,
    model: CalibratedModel,
    families: Collection[str],
    observations: Observations,
    holdout: Observations | None,
    seed: int,
    rng: np.random.Generator,
) -> GapResult:
    """Return the result of the search: errors, evidence, forecasts and proposals."""
    found, samples = rest.found, rest.adopted.solution.samples
    before = detect(Grammar(found.initial), rng) if found.joint.choices else rest.detection
    effects = found.adopted.effects
    verdict: Verdict = "none"
    if found.alternatives:
        verdict = "indistinguishable"
    elif effects:
        verdict = "named"
    elif rest.significant:
        verdict = "unidentified"
    predictor = Predictor.of(model)
    error_before = observations.position_mm - predictor.geometric_mm(observations)
    error_after = observations.position_mm - predictor.effects_mm(observations)
    is_counted = found.joint.fit.weight[samples.of_row] > 0.5  # gross outliers do not count
    noise_mm, source = _noise(samples, found, observations, scatter_is_noise=not rest.significant)
    held_out = None
    if holdout is not None:
        measured = holdout.position_mm
        held_out = rms(measured - predictor.geometric_mm(holdout)), rms(measured - predictor.effects_mm(holdout))
    candidates = tuple(_candidate(found.steps[-1], w) for w in found.alternatives)
    context = found.joint.context
    alternatives = [
        [w.fitted(context) for w in (alternative, *alternative.same_family)] for alternative in found.alternatives
    ]
    proposed = propose_experiments(model, observations, alternatives, rng) if alternatives else ()
    return GapResult(
        verdict=verdict,
        effects=effects,
        posterior=found.posterior,
        evidence=found.evidence,
        indistinguishable=candidates,
        description=rest.description,
        remaining_significant=rest.significant,
        remaining_mm=float(np.sqrt(max(rms(error_after[is_counted]) ** 2 - noise_mm**2, 0.0))),
        disabled=found.candidates.disabled,
        before_mm=rms(error_before),
        after_mm=rms(error_after),
        noise_mm=noise_mm,
        noise_source=source,
        held_out=held_out,
        machine_break=found.machine_break,
        disagreements=before.disagreements,
        experiments=proposed,
        rounds=tuple(_rounds(found, observations, holdout, seed)),
        forecasts=forecasts(Screen(found.initial, found.candidates.candidates)),
        model=model,
        observations=observations,
        error_before_mm=error_before,
        error_after_mm=error_after,
        warnings=tuple(_warnings(rest, model, families, holdout)),
        shared=0 if holdout is None else int(are_among(holdout, model.fitted_rows).sum()),
    )


def rms(error_mm: Floats) -> float:
    """Return the RMS 3-D length of errors (n, 3)."""
    return float(np.sqrt((error_mm**2).sum(axis=1).mean()))


def _rounds(
    found: SearchResult, observations: Observations, holdout: Observations | None, seed: int
) -> Iterator[Round]:
    """Yield the steps of the search for output, each with its error on held-out groups or rows."""
    fold, samples = folds(found.initial.groups, _FOLDS, seed), found.initial.samples
    # Repeats of a standstill are one sample of a fit, but the noise to report is that of a single fix.
    from_mean = observations.position_mm - samples.position_mm[samples.of_row]
    for step in found.refitted_steps():
        if holdout is None:
            error = step.projection.held_out_mm(fold)[samples.of_row] + from_mean
            counts = step.fit.fit.weight[samples.of_row, None] ** 0.5
            held_out = rms(error * counts) / float(np.sqrt(np.mean(counts**2)))
        else:
            held_out = rms(holdout.position_mm - _positions(step.fit, holdout))
        taken = tuple(str(c) for c in step.adopted)
        listed = step.scored[:_LISTED]
        yield Round(held_out, taken, tuple(_candidate(step, w) for w in listed))


def _positions(joint: JointFit, observations: Observations) -> Floats:
    """Return (n, 3) positions of other rows predicted by kinematics and effects of a fit."""
    chain = joint.context.chain
    x = joint.fit.x[: len(chain)]
    context = replace(joint.context, x=x, observations=observations)
    applied = AppliedEffects(joint.effects, chain)
    data, shift_mm = applied.columns(context).apply(chain.bind(observations), applied.values)
    return chain.positions_mm(x, data) + shift_mm


def _candidate(step: SelectionStep, scored: ScoredEffect) -> Candidate:
    """Return one candidate of a step for output."""
    context, choice = step.fit.context, scored.choice
    family = library()[choice.family]
    coefficients = family.coefficients(context, choice.where, choice.settings)
    named = any((choice.family, choice.where) == (c.family, c.where) for c in step.adopted)
    return Candidate(
        choice.family,
        choice.where,
        scored.posterior,
        scored.log_bayes_factor,
        scored.fitted(context).reported,
        {c.name: (c.lower, c.upper) for c in coefficients} | dict(family.reported_limits()),
        "" if named else step.reasons.get(str(scored.candidate), "no further evidence for it, given the others"),
    )


def _noise(
    samples: Samples, found: SearchResult, observations: Observations, *, scatter_is_noise: bool
) -> tuple[float, str]:
    """Return the RMS 3-D noise of one fix, and a clause about its source.

    Scatter in excess of the known noise counts as noise, unless it is systematic.
    """
    rig, fit = found.joint.context.rig, found.joint.fit
    station = station_covariance(rig, observations.position_mm, observations.sigma_mm)
    readings = reading_covariance(rig, found.final.projection.joint_jacobian, samples.rates)
    known = sum(float(np.trace(c, axis1=1, axis2=2).mean()) for c in (station, readings))
    given = np.isfinite(observations.sigma_mm).all(axis=1).mean() > 0.5
    source = "the sigma columns of the data" if given else "the station's and the readings' noise in the rig file"
    if samples.repeat_variance > 0.0:
        known += 3.0 * samples.repeat_variance
        source += ", raised to the scatter of repeats"
    excess = 3.0 * fit.excess_variance if scatter_is_noise else 0.0
    if excess > _EXCESS_SEEN**2 * known:
        source += f", and {np.sqrt(excess):.2g} mm of excess scatter in the data"
    return float(np.sqrt(known + excess)), source


def _warnings(
    rest: Remaining,
    model: CalibratedModel,
    families: Collection[str],
    holdout: Observations | None,
) -> Iterator[str]:
    found = rest.found
    yield from model.warnings
    yield from rest.ambiguous_places()
    if holdout is not None:
        yield from (f"in the held-out rows: {warning}" for warning in model_warnings(model, holdout))
    if found.formulas and found.adopted.effects:
        yield "the remaining errors depend on something that no effect of the library explains"
    yield from partly_known(found.joint.context, families)
