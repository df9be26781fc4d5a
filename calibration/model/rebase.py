"""A calibrated model at another set-up: the rigid base transform refitted, all else kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.effects.columns import EffectColumns
from calibration.effects.context import EffectContext
from calibration.effects.fitted import coefficient_values, fitted_columns
from calibration.identification.checks import refuse_turning
from calibration.identification.linear_model import information
from calibration.identification.refinement import Fit, refine
from calibration.identification.samples import Samples, averaged
from calibration.identification.start import rough_start
from calibration.kinematics.chain import Chain, Placement
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Floats, Observations

_REACHED = 0.5  # weight of the residual in a row, beyond which the row lies in its region
_ROUNDS = 2  # the residual turns with the base: after the first by a few mrad, then by nothing that is seen


def with_refitted_base(model: CalibratedModel, observations: Observations) -> CalibratedModel:
    """Refit the base transform of a model at the set-ups of some observations.

    A base is fitted to the errors of the whole model, its residual included: one fitted without would take up the
    residual's estimate at these few places, and a prediction would add that a second time. The residual is left out of
    the model where at most half of these fixes lie in the region it was trained on, or where they fit better without
    it: what was learned at home is then not true here, and the few rows that it reaches would bend the base for all.

    Args:
        model: the model.
        observations: n rows with positions, at one or more set-ups.

    Returns:
        The model with these set-ups in place of its own; without its residual, and with the reason, where that is left
        out. Its intervals are those of its training, x and y alike: `SetupErrors` widens them by what is seen here.

    Raises:
        DataError: a prism that the rig lacks.
        UnsafeError: fewer than three fixes of a set-up, all on a line or in one place, or mirrored.
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
    model = replace(model, effects=tuple(effect.at_new_setups(context) for effect in model.effects))
    additions = fitted_columns(model.effects, context)
    additions = additions.over(samples.average)
    moves = np.concatenate([free, np.zeros(len(additions), dtype=bool)])
    begun = np.concatenate([extended(model.values), coefficient_values(model.effects)])
    # First with the noise of a rough start: beside that of the model, all fixes would look like outliers.
    near = refine(chain, samples, begun, free=moves, additions=additions)
    fit = refine(chain, samples, near.x, free=moves, excess_variance=model.excess_sigma_mm**2, additions=additions)
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
        fit = refine(chain, left, fit.x, free=moves, excess_variance=0.0, additions=additions)
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
        covariance=_covariance(chain, left, fit, additions, model.covariance[np.ix_(known, known)]),
        base_covariance=fit.covariance[body : len(chain), body : len(chain)],
        geometric_values=geometric,
        nominal_values=nominal.x,
        intervals=model.intervals.at_other_setups(),
    )


def _why_left_out(without: CalibratedModel, whole: CalibratedModel, observations: Observations) -> str:
    """Return why the residual is left out at these set-ups; empty where it is of use."""
    prediction = Predictor.of(whole).predict(observations)
    assert prediction.weight is not None
    reached = prediction.weight > _REACHED
    if 2 * int(reached.sum()) <= len(reached):
        return (
            f"{int((~reached).sum())} of {len(reached)} fixes lie outside the region that the residual was trained on"
        )
    before, after = (
        float(np.median(np.linalg.norm(observations.position_mm - position_mm, axis=1)))
        for position_mm in (Predictor.of(without).effects_mm(observations), prediction.position_mm)
    )
    if after > before:
        return f"the fixes are {after:.3g} mm off with the residual and {before:.3g} mm without, in the median"
    return ""


def _covariance(chain: Chain, samples: Samples, fit: Fit, additions: EffectColumns, known_covariance: Floats) -> Floats:
    """(p + k, p + k) covariance when the base is fitted for given parameters of the body and coefficients.

    Much of their uncertainty is of directions that a base transform undoes; the new base undoes them as the old one
    did, so its estimate is correlated with them: d base / d known = -H_bb^-1 H_bk.
    """
    base = np.zeros(len(fit.x), dtype=bool)
    base[chain.base_start : len(chain)] = True
    seen = information(
        chain, samples, fit.x, excess_variance=fit.excess_variance, weight=fit.weight, additions=additions
    )
    own = fit.covariance[np.ix_(base, base)]
    follows = -own @ seen[np.ix_(base, ~base)]
    covariance = np.zeros_like(fit.covariance)
    covariance[np.ix_(~base, ~base)] = known_covariance
    covariance[np.ix_(base, ~base)] = follows @ known_covariance
    covariance[np.ix_(~base, base)] = covariance[np.ix_(base, ~base)].T
    covariance[np.ix_(base, base)] = own + follows @ known_covariance @ follows.T
    return covariance
