"""The whole identification: start in closed form, descend, search globally, judge, say what stays unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.effects.columns import EffectColumns
from calibration.errors import UnsafeError
from calibration.identification.checks import (
    at_the_noise,
    beyond_assembly,
    data_warnings,
    different_fixes,
    fixed_constant_warnings,
    mean_error_mm,
    refuse_discarded,
    refuse_foreign,
    refuse_turning,
    require_enough,
    rms_tolerated_mm,
    tilt_warnings,
)
from calibration.identification.diagnosis import Quality, diagnose
from calibration.identification.identifiability import Identifiability, identifiability
from calibration.identification.linear_model import prior_precision
from calibration.identification.refinement import Fit, Prior, refine
from calibration.identification.samples import Samples, averaged
from calibration.identification.search.global_search import search_globally
from calibration.identification.start import PRIOR_SCALE, Start, approach, rough_start
from calibration.identification.sweeps.axis_start import start_from_axes
from calibration.identification.sweeps.circles import find_axes
from calibration.kinematics.chain import Chain, Placement
from calibration.observations import Floats, Observations
from calibration.rig.description import ANOTHER_VALUE, Rig
from calibration.run_settings import Run

_BETTER = 1.0  # in log evidence; less is rounding
_MISTAKES = 3  # supposed together where nothing else explains the data
_SUSPICIOUS = 0.3  # mean error after the fit over what build tolerances explain before it


@dataclass(frozen=True)
class Solution:
    """Result of `solve`.

    Attributes:
        chain: kinematics with the bases placed.
        samples: what was fitted.
        nominal: base and unknown prism offsets alone.
        fit: everything.
        identifiability: what the data see.
        search: how the global search and the local one from the nominal model compare, in words.
        tolerated_mm: RMS 3-D error that build tolerances explain before any fit.
        warnings: about the data and what was made of them.
        additions: coefficients of effects that were fitted along; they follow the parameters in `fit.x`.
        has_priors: whether the rig file's build tolerances held the parameters.
    """

    chain: Chain
    samples: Samples
    nominal: Fit
    fit: Fit
    identifiability: Identifiability
    search: str
    tolerated_mm: float
    warnings: tuple[str, ...] = ()
    additions: EffectColumns | None = None
    has_priors: bool = True


def place(rig: Rig, observations: Observations) -> tuple[Chain, Samples, Start]:
    """Place the base of every set-up; return the chain, the rows to fit and the rough start.

    Raises:
        DataError, UnsafeError: as `averaged` and `rough_start`, which lets mirrored coordinates pass here.
    """
    setups = sorted(set(observations.setup.tolist()))
    blank = Chain(rig, {setup: Placement.identity() for setup in setups})
    samples = averaged(blank, observations)
    start = rough_start(blank, samples, np.zeros(len(blank)), mirrored="let pass")
    return Chain(rig, start.placements), samples, start


def solve(rig: Rig, observations: Observations, *, prior: Prior, run: Run) -> Solution:
    """Identify all parameters of a rig: place the base, fit from the nominal model, search, judge.

    Args:
        rig: the rig description.
        observations: rows with positions.
        prior: trust the build tolerances, or estimate their scale.
        run: of the global search, whose best candidate so far is refined where it is stopped.

    Raises:
        DataError: a prism that the rig lacks.
        UnsafeError: too few fixes, a set-up whose base cannot be placed, mirrored coordinates, another rig's data, a
            joint's sign or unit that the rig file has otherwise, exchanged columns.
    """
    run.progress(0.0, "placing the base")
    require_enough(rig, observations)
    chain, samples, start = place(rig, observations)
    different = different_fixes(chain, samples)
    require_enough(rig, observations, different)
    warnings = list(data_warnings(observations, chain, different))
    nominal = refine(chain, samples, start.x, free=np.isinf(chain.prior_sigma))
    run.progress(0.1, "refining")
    fit = _descend(chain, samples, nominal.x, prior)
    run.progress(0.3, "searching globally")
    if at_the_noise(chain, samples, fit):
        search = "no global search: what is left from the nominal model on is what instruments and repeats explain"
    else:
        fit, search, trouble = _searched(chain, samples, nominal, fit, start.scale_mm, prior, run)
        warnings += trouble
    tolerated_mm = rms_tolerated_mm(chain, samples, nominal)
    misfits = mean_error_mm(chain, samples, fit) > _SUSPICIOUS * tolerated_mm
    if misfits or beyond_assembly(chain, fit):
        run.progress(0.8, "looking for signs, units and zeros that are otherwise")
        found = diagnose(
            chain,
            samples,
            precision=prior_precision(chain, PRIOR_SCALE[prior]),
            before=Quality.of(chain, samples, fit.x),
            tolerated_mm=_SUSPICIOUS * tolerated_mm,
            at_once=_MISTAKES if misfits else 1,
        )
        if found is not None and (prior != "as-built" or found.x is None):
            raise UnsafeError(f"data and rig file do not fit each other: {found}")
        if found is not None and found.x is not None:
            other = refine(found.chain, samples, found.x, prior=prior)
            if other.cost < fit.cost - _BETTER:
                warnings.append(f"{found.what}: the model makes that good; correct the rig file")
                chain, fit, search = found.chain, other, f"{found.what}: a start that knows led to a better optimum"
                flat = np.isinf(chain.prior_sigma)
                nominal = refine(chain, samples, np.where(flat, found.x, 0.0), free=flat)
    chain, fit = _without_wrong_tolerances(chain, samples, fit, prior)
    warnings += tilt_warnings(chain, fit)
    refuse_foreign(chain, samples, fit, tolerated_mm, prior)
    refuse_discarded(chain, samples, fit, prior)
    refuse_turning(chain, samples, fit.x)
    warnings += fixed_constant_warnings(chain, samples, fit, prior)
    run.progress(0.9, "checking what the data determine")
    seen = identifiability(chain, samples, fit.x, fit.excess_variance)
    return Solution(chain, samples, nominal, fit, seen, search, tolerated_mm, tuple(warnings))


def _without_wrong_tolerances(chain: Chain, samples: Samples, fit: Fit, prior: Prior) -> tuple[Chain, Fit]:
    """Refit without holding to the rig file the values that it has wrong, such as zeros set anew.

    A tolerance that pulls by so much bends all the others, and what it is off would pass for an effect. The new one is
    the distance itself, which makes the fit most probable.
    """
    if prior == "as-built":
        return chain, fit
    far = np.abs(fit.x) > ANOTHER_VALUE * chain.prior_sigma
    if not far.any():
        return chain, fit
    off = {p.name: abs(float(x)) for p, x, is_far in zip(chain.parameters, fit.x, far, strict=True) if is_far}
    chain = chain.with_tolerances(off)
    return chain, refine(chain, samples, fit.x)


def _descend(chain: Chain, samples: Samples, start: Floats, prior: Prior) -> Fit:
    """Descend to the optimum that a start leads to: roughly with no row left out, then exactly."""
    near = approach(chain, samples, start, precision=prior_precision(chain, PRIOR_SCALE[prior]))
    return refine(chain, samples, near, prior=prior)


def _searched(
    chain: Chain,
    samples: Samples,
    nominal: Fit,
    local: Fit,
    scale_mm: float,
    prior: Prior,
    run: Run,
) -> tuple[Fit, str, tuple[str, ...]]:
    """Take the best of the local fit and those that single-joint sweeps and the global search lead to.

    Returns:
        The fit; words for which it is; warnings of the checkpoint.
    """
    origin = "the nominal model leads"
    # Their start takes seconds; where the local fit explains the data, it would only lead there again.
    misfits = mean_error_mm(chain, samples, local) > _SUSPICIOUS * rms_tolerated_mm(chain, samples, nominal)
    axes = find_axes(chain, samples) if misfits or beyond_assembly(chain, local) else ()
    if axes:
        swept = _descend(chain, samples, start_from_axes(chain, samples, axes), prior)
        if swept.cost < local.cost - _BETTER:
            local, origin = swept, "the axes of single-joint sweeps lead"
    x, search = search_globally(chain, samples, nominal.x, local.x, scale_mm, prior, run.part(0.3, 0.75))
    ended = "" if search.complete else ", which was stopped before its end,"
    if x is not None:
        run.progress(0.75, "refining")
        distant = _descend(chain, samples, x, prior)
        if distant.cost < local.cost - _BETTER:
            return distant, f"the global search{ended} found a better optimum than where {origin}", search.warnings
    return local, f"the global search{ended} found nothing better than where {origin}", search.warnings
