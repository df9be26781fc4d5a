"""Use of a calibrated model at a new set-up: the rigid base transform is refitted, everything else is kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.effects.columns import EffectColumns
from calibration.effects.context import EffectContext
from calibration.effects.fitted import FittedEffect, coefficient_values, fitted_columns
from calibration.effects.library import library
from calibration.identification.checks import refuse_turning
from calibration.identification.linear_model import information
from calibration.identification.refinement import Fit, refine
from calibration.identification.samples import Samples, averaged
from calibration.identification.start import rough_start
from calibration.kinematics.chain import Chain, Placement
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Floats, Observations

_REACHED = 0.5  # weight of the residual in a row, above which the row counts as inside its region
_ROUNDS = 2  # the residual turns with the base: a few mrad after the first round, then negligibly


def with_refitted_base(model: CalibratedModel, observations: Observations) -> CalibratedModel:
    """Refit the base transform of a model at the set-ups of some observations.

    The base is fitted with the whole model, including its residual. A base fitted without the residual would absorb the
    residual's estimate at these few places, and a prediction would add it a second time. The residual is removed from
    the model if no more than half of these fixes lie inside its region, or if the fixes fit better without it. In these
    cases it is not valid at these set-ups, and the few rows that it affects would distort the base for all.

    Args:
        model: the model.
        observations: n rows with positions, at one or more set-ups.

    Returns:
        The model with these set-ups instead of its own. If the residual was removed, it contains the reason. Its
        intervals are those from its training, averaged over x and y; `SetupErrors` widens them by the errors seen here.

    Raises:
        DataError: a prism that the rig lacks.
        UnsafeError: a set-up has fewer than three fixes, all on a line or in one place, or mirrored.
    """
    setups = sorted(set(observations.setup.tolist()))
    blank = Chain(model.rig, {setup: Placement.identity() for setup in setups})
    samples = averaged(blank, observations)
    body = model.chain.base_start

    def extended(values: Floats) -> Floats:
        return np.concatenate([values[:body], np.zeros(6 * len(setups))])

    start = rough_start(blank, samples, extended(model.values), offsets=False)
    chain = Chain(model.rig, start.placements)
    free = np.arange(len(chain)) >= body
    context = EffectContext(chain, extended(model.values), observations)
    model = replace(model, effects=tuple(_at_new_setups(effect, context) for effect in model.effects))
    effect_columns = fitted_columns(model.effects, context)
    effect_columns = effect_columns.over(samples.average)
    moves = np.concatenate([free, np.zeros(len(effect_columns), dtype=bool)])
    begun = np.concatenate([extended(model.values), coefficient_values(model.effects)])
    # First with the noise of a rough start; with the model's noise all fixes would look like outliers.
    near = refine(chain, samples, begun, free=moves, additions=effect_columns)
    fit = refine(chain, samples, near.x, free=moves, excess_variance=model.excess_sigma_mm**2, additions=effect_columns)
    effects_values = fit.x[: len(chain)]
    refuse_turning(chain, samples, effects_values)
    left, without = samples, fit
    for _ in range(_ROUNDS if model.residual is not None else 0):
        here = replace(model, placements=start.placements, values=fit.x[: len(chain)], covariance=fit.covariance)
        correction, lacking = Predictor.of(here).correction(observations)
        left = replace(
            samples,
            position_mm=samples.position_mm - samples.average(correction),
            station_covariance=samples.station_covariance + samples.average(lacking),
        )
        fit = refine(chain, left, fit.x, free=moves, excess_variance=0.0, additions=effect_columns)
    if model.residual is not None:
        placed = replace(model, placements=start.placements)
        reason = _why_left_out(
            replace(placed, values=without.x[: len(chain)], residual=None, covariance=without.covariance),
            replace(placed, values=fit.x[: len(chain)], covariance=fit.covariance),
            observations,
        )
        if reason:
            model = replace(model, residual=None, residual_reason=reason)
            left, fit = samples, without
    geometric = effects_values
    if model.effects:
        geometric = refine(chain, samples, extended(model.geometric_values), free=free).x
    nominal = refine(chain, samples, extended(model.nominal_values), free=free)
    known = np.ones(len(model.covariance), dtype=bool)
    known[body : len(model.values)] = False
    return replace(
        model,
        placements=start.placements,
        values=fit.x[: len(chain)],
        covariance=_covariance(chain, left, fit, effect_columns, model.covariance[np.ix_(known, known)]),
        base_covariance=fit.covariance[body : len(chain), body : len(chain)],
        geometric_values=geometric,
        nominal_values=nominal.x,
        intervals=model.intervals.at_other_setups(),
    )


def _at_new_setups(effect: FittedEffect, context: EffectContext) -> FittedEffect:
    """Return an effect for new set-ups, whose bases are fitted to the observations of a context."""
    settings = library()[effect.family].at_new_setups(context, effect.where, effect.settings)
    return replace(effect, settings=settings)


def _why_left_out(without: CalibratedModel, whole: CalibratedModel, observations: Observations) -> str:
    """Return the reason for leaving out the residual at these set-ups; empty if it helps there."""
    prediction = Predictor.of(whole).predict(observations)
    assert prediction.weight is not None
    reached = prediction.weight > _REACHED
    if 2 * int(reached.sum()) <= len(reached):
        return (
            f"{int((~reached).sum())} of {len(reached)} fixes lie outside the region in which the residual was trained"
        )
    before, after = (
        float(np.median(np.linalg.norm(observations.position_mm - position_mm, axis=1)))
        for position_mm in (Predictor.of(without).effects_mm(observations), prediction.position_mm)
    )
    if after > before:
        return f"the median error of the fixes is {after:.3g} mm with the residual and {before:.3g} mm without it"
    return ""


def _covariance(
    chain: Chain, samples: Samples, fit: Fit, effect_columns: EffectColumns, known_covariance: Floats
) -> Floats:
    """Return the (p + k, p + k) covariance when the base is fitted with all other parameters and coefficients known.

    Much of the uncertainty of the other parameters is in directions that a base transform compensates. The new base
    compensates them as the old one did, so its estimate is correlated with them: d base / d known = -H_bb^-1 H_bk.
    """
    base = np.zeros(len(fit.x), dtype=bool)
    base[chain.base_start : len(chain)] = True
    seen = information(
        chain, samples, fit.x, excess_variance=fit.excess_variance, weight=fit.weight, additions=effect_columns
    )
    own = fit.covariance[np.ix_(base, base)]
    follows = -own @ seen[np.ix_(base, ~base)]
    covariance = np.zeros_like(fit.covariance)
    covariance[np.ix_(~base, ~base)] = known_covariance
    covariance[np.ix_(base, ~base)] = follows @ known_covariance
    covariance[np.ix_(~base, base)] = covariance[np.ix_(base, ~base)].T
    covariance[np.ix_(base, base)] = own + follows @ known_covariance @ follows.T
    return covariance
