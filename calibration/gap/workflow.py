"""The gap workflow, from observations to the answer: calibrate, detect, forecast, name, adopt, plan what tells more."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from calibration.effects.base import FittedCoefficient
from calibration.effects.fitted import AppliedEffects
from calibration.effects.library import library
from calibration.errors import UnsafeError
from calibration.evaluation import require_positions
from calibration.gap.adopt import JointFit
from calibration.gap.detect import detect
from calibration.gap.discriminate import experiments
from calibration.gap.forecast import forecasts
from calibration.gap.found import Found, Turn
from calibration.gap.grammar import Grammar
from calibration.gap.remaining import Remaining, remaining
from calibration.gap.result import Candidate, Gap, Round, Verdict
from calibration.gap.screen import Screen, Weighed
from calibration.gap.search import search
from calibration.identification.refinement import Prior
from calibration.identification.samples import Samples, reading_covariance, station_covariance
from calibration.identification.search.checkpoint import Checkpoint
from calibration.identification.solve import Solution, solve
from calibration.kinematics import ChainData
from calibration.model import CalibratedModel
from calibration.observations import Floats, Observations
from calibration.pipeline import executor_or_threads, model_of
from calibration.residual.folds import folds
from calibration.rig import Rig

Progress = Callable[[float, str], None]

_FOLDS = 10
_LISTED = 12  # candidates of a round
_EXCESS_SEEN = 0.2  # of the known noise's standard deviation; less is none


def find_gap(
    rig: Rig,
    rig_text: str,
    observations: Observations,
    *,
    holdout: Observations | None = None,
    prior: Prior = "recalibration",
    seed: int = 0,
    executor: Executor | None = None,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
    families: Collection[str] | None = None,
) -> Gap:
    """Find where simulation and measurement disagree, name the effect that is missing, and add it.

    Args:
        rig, rig_text: the rig description and the TOML it was read from, which travels in the model.
        observations: training rows, all with positions.
        holdout: further rows, at set-ups of the training rows, that no fit sees.
        prior: trust the build tolerances, or estimate their scale.
        seed: of everything random.
        executor: runs the global search; threads of its own by default.
        progress: told (share done, what is going on); what it raises ends the work.
        checkpoint: where the global search keeps its state, and goes on from.
        families: that may be named; the whole library by default.

    Raises:
        DataError: rows without positions, prisms the rig lacks.
        UnsafeError: too few fixes, a base that cannot be placed, mirrored coordinates, another rig's data, a set-up of
            the held-out rows that the training rows lack.
    """
    report = progress or _silent
    require_positions(observations)
    if holdout is not None:
        require_positions(holdout)
        _require_setups(holdout, observations)
    with executor_or_threads(executor) as pool:
        report(0.0, "calibrating the kinematics")
        solution = solve(
            rig,
            observations,
            prior=prior,
            seed=seed,
            executor=pool,
            progress=lambda share, what: report(0.3 * share, what),
            checkpoint=checkpoint,
        )
        report(0.3, "looking for missing effects")
        found = search(solution, observations, library() if families is None else families, prior=prior, seed=seed)
        report(0.8, "weighing what is left")
        rng = np.random.default_rng([seed, 1])
        rest = remaining(found, rng)
        report(0.9, "building the model")
        model = model_of(rig, rig_text, observations, rest.adopted, prior, {"seed": seed, "method": "gap"})
        return _answer(solution, rest, model, observations, holdout, seed, rng)


def _require_setups(holdout: Observations, observations: Observations) -> None:
    """Raise UnsafeError where held-out rows come from a set-up without training rows."""
    known = set(observations.setup.tolist())
    unknown = sorted(set(holdout.setup.tolist()) - known)
    if unknown:
        raise UnsafeError(
            f"the held-out rows have set-up {unknown[0]!r}, the training rows only "
            f"{', '.join(repr(setup) for setup in sorted(known))}; hold out rows of those, or leave these out and "
            "judge the model on them afterwards with evaluate --refit-base"
        )


def _answer(
    solution: Solution,
    rest: Remaining,
    model: CalibratedModel,
    observations: Observations,
    holdout: Observations | None,
    seed: int,
    rng: np.random.Generator,
) -> Gap:
    found = rest.found
    before = detect(Grammar(found.first), rng) if found.joint.choices else rest.detection
    effects = found.adopted.effects
    verdict: Verdict = "none"
    if found.rivals:
        verdict = "indistinguishable"
    elif effects:
        verdict = "named"
    elif rest.significant:
        verdict = "unidentified"
    error_before = observations.position_mm - model.geometric_mm(observations)
    error_after = observations.position_mm - model.effects_mm(observations)
    is_counted = found.joint.fit.weight[solution.samples.of_row] > 0.5  # gross outliers are no structure
    noise_mm, source = _noise(solution.samples, found, observations, scatter_is_noise=not rest.significant)
    held_out = None
    if holdout is not None:
        measured = holdout.position_mm
        held_out = rms(measured - model.geometric_mm(holdout)), rms(measured - model.effects_mm(holdout))
    candidates = tuple(_candidate(found.turns[-1], w) for w in found.rivals)
    situation = found.joint.situation
    rivals = [[w.fitted(situation) for w in (rival, *rival.instead)] for rival in found.rivals]
    proposed = experiments(model, observations, rivals, rng) if rivals else ()
    return Gap(
        verdict=verdict,
        effects=effects,
        posterior=found.certain,
        indistinguishable=candidates,
        description=rest.description,
        remaining_significant=rest.significant,
        remaining_mm=float(np.sqrt(max(rms(error_after[is_counted]) ** 2 - noise_mm**2, 0.0))),
        disabled=found.possible.disabled,
        before_mm=rms(error_before),
        after_mm=rms(error_after),
        noise_mm=noise_mm,
        noise_source=source,
        held_out=held_out,
        disagreements=before.disagreements,
        experiments=proposed,
        rounds=tuple(_rounds(found, observations, holdout, seed)),
        forecasts=forecasts(Screen(found.first, found.possible.places)),
        model=model,
        observations=observations,
        error_before_mm=error_before,
        error_after_mm=error_after,
        warnings=tuple(_warnings(found, model, holdout)),
    )


def rms(error_mm: Floats) -> float:
    """RMS 3-D length of errors (n, 3)."""
    return float(np.sqrt((error_mm**2).sum(axis=1).mean()))


def _rounds(found: Found, observations: Observations, holdout: Observations | None, seed: int) -> Iterator[Round]:
    fold, samples = folds(found.first.groups, _FOLDS, seed), found.first.samples
    # Repeats of a standstill are one sample of a fit; the noise is that of a fix.
    from_mean = observations.position_mm - samples.position_mm[samples.of_row]
    for turn in found.turns:
        if holdout is None:
            error = turn.projection.held_out_mm(fold)[samples.of_row] + from_mean
            counts = turn.fit.fit.weight[samples.of_row, None] ** 0.5
            held_out = rms(error * counts) / float(np.sqrt(np.mean(counts**2)))
        else:
            held_out = rms(holdout.position_mm - _positions(turn.fit, holdout))
        taken = tuple(str(c) for c in turn.taken)
        listed = turn.weighed[:_LISTED]
        yield Round(held_out, taken, tuple(_candidate(turn, w) for w in listed))


def _positions(joint: JointFit, observations: Observations) -> Floats:
    """(n, 3) positions of other rows by kinematics and effects of a fit."""
    chain = joint.situation.chain
    x = joint.fit.x[: len(chain)]
    situation = replace(joint.situation, x=x, observations=observations)
    applied = AppliedEffects(joint.effects, chain)
    columns = applied.columns(situation)
    data = chain.bind(observations)
    moved = ChainData(data.readings + applied.change(columns), data.prism, data.setup)
    position = chain.positions_mm(x, moved)
    shift = applied.shifted_mm(columns)
    return position if shift is None else position + shift


def _candidate(turn: Turn, weighed: Weighed) -> Candidate:
    """One of a turn's candidates, for outputs."""
    situation, choice = turn.fit.situation, weighed.choice
    family = library()[choice.family]
    found = family.coefficients(situation, choice.where, choice.settings)
    coefficients = tuple(
        FittedCoefficient(c.name, c.unit, float(value), float(error), c.sigma)
        for c, value, error in zip(found, weighed.estimate, weighed.standard_error, strict=True)
    )
    named = any((choice.family, choice.where) == (c.family, c.where) for c in turn.taken)
    return Candidate(
        choice.family,
        choice.where,
        weighed.posterior,
        weighed.log_bayes_factor,
        family.reported(choice.settings, coefficients),
        {c.name: (c.lower, c.upper) for c in found} | dict(family.reported_limits()),
        "" if named else turn.reasons.get(str(weighed.place), "nothing asks for it beside the others"),
    )


def _noise(samples: Samples, found: Found, observations: Observations, *, scatter_is_noise: bool) -> tuple[float, str]:
    """RMS 3-D noise of one fix, and where it is known from, a clause.

    What the data scatter beyond what is known is noise only where nothing says that it depends on anything.
    """
    rig, fit = found.joint.situation.rig, found.joint.fit
    station = station_covariance(rig, observations.position_mm, observations.sigma_mm)
    readings = reading_covariance(rig, found.left.projection.joint_jacobian, samples.rates)
    known = sum(float(np.trace(c, axis1=1, axis2=2).mean()) for c in (station, readings))
    given = np.isfinite(observations.sigma_mm).all(axis=1).mean() > 0.5
    source = "the sigma columns of the data" if given else "the station's and the readings' noise in the rig file"
    if samples.repeat_variance > 0.0:
        known += 3.0 * samples.repeat_variance
        source += ", raised to the scatter of repeats"
    excess = 3.0 * fit.excess_variance if scatter_is_noise else 0.0
    if excess > _EXCESS_SEEN**2 * known:
        source += f", and {np.sqrt(excess):.2g} mm that the data scatter beyond it"
    return float(np.sqrt(known + excess)), source


def _warnings(found: Found, model: CalibratedModel, holdout: Observations | None) -> Iterator[str]:
    yield from model.warnings
    if holdout is not None:
        yield from (f"in the held-out rows: {doubt}" for doubt in model.doubts(holdout))
    if found.formulas and found.adopted.effects:
        yield "what is left over depends on what no effect of the library explains"


def _silent(share: float, what: str) -> None:
    """Progress that nobody watches."""
