"""The complete identification: closed-form start, local and global search, checks, and identifiability."""

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
_MISTAKES = 3  # most simultaneous faults to try when the fit does not explain the data
_SUSPICIOUS = 0.3  # mean error after the fit, divided by what build tolerances explain before it


@dataclass(frozen=True)
class Solution:
    """Result of `solve`.

    Attributes:
        chain: kinematics with the bases placed.
        samples: rows of the fit.
        nominal: fit of the bases and unknown prism offsets alone.
        fit: fit of all parameters.
        identifiability: which parameters the data determine.
        search: comparison of the global search with the local one from the nominal model, in words.
        tolerated_mm: RMS 3-D error that build tolerances explain before any fit.
        warnings: warnings about the data and the fit.
        additions: coefficients of effects in the same fit; they follow the parameters in `fit.x`.
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
    """Place the base of every set-up; return the chain, the samples to fit and the rough start.

    Raises:
        DataError, UnsafeError: as `averaged` and `rough_start`, but mirrored coordinates are accepted here.
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
        run: settings of the global search. If it is stopped, its best candidate so far is refined.

    Raises:
        DataError: a prism that the rig lacks.
        UnsafeError: too few fixes, a set-up whose base cannot be placed, mirrored coordinates, another rig's data, a
            joint's sign or unit that differs from the rig file, exchanged columns.
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
        search = "no global search: instruments and repeats explain what the fit from the nominal model leaves"
    else:
        fit, search, trouble = _searched(chain, samples, nominal, fit, start.scale_mm, prior, run)
        warnings += trouble
    tolerated_mm = rms_tolerated_mm(chain, samples, nominal)
    misfits = mean_error_mm(chain, samples, fit) > _SUSPICIOUS * tolerated_mm
    if misfits or beyond_assembly(chain, fit):
        run.progress(0.8, "looking for wrong signs, units and zeros")
        found = diagnose(
            chain,
            samples,
            precision=prior_precision(chain, PRIOR_SCALE[prior]),
            before=Quality.of(chain, samples, fit.x),
            tolerated_mm=_SUSPICIOUS * tolerated_mm,
            at_once=_MISTAKES if misfits else 1,
        )
        if found is not None and (prior != "as-built" or found.x is None):
            raise UnsafeError(f"data and rig file do not match: {found}")
        if found is not None and found.x is not None:
            other = refine(found.chain, samples, found.x, prior=prior)
            if other.cost < fit.cost - _BETTER:
                warnings.append(f"{found.what}: the model corrects that; correct the rig file")
                chain, fit = found.chain, other
                search = f"{found.what}: a start corrected for that led to a better optimum"
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
    """Refit with wider tolerances of values that are wrong in the rig file, such as zeros that have been set again.

    A tolerance that is exceeded by so much distorts all other parameters, and the error left would pass for an effect.
    The new tolerance is the distance from the rig file itself, which makes the fit most probable.
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
    """Descend from a start to its optimum: roughly without leaving out any rows, then exactly."""
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
    """Return the best of the local fit and the fits that start from single-joint sweeps and from the global search.

    Returns:
        The fit, a description of where it came from, and warnings about the checkpoint.
    """
    origin = "the fit from the nominal model"
    # A start from sweeps takes seconds, and where the local fit explains the data it leads to the same optimum.
    misfits = mean_error_mm(chain, samples, local) > _SUSPICIOUS * rms_tolerated_mm(chain, samples, nominal)
    axes = find_axes(chain, samples) if misfits or beyond_assembly(chain, local) else ()
    if axes:
        swept = _descend(chain, samples, start_from_axes(chain, samples, axes), prior)
        if swept.cost < local.cost - _BETTER:
            local, origin = swept, "the fit from the axes of single-joint sweeps"
    x, search = search_globally(chain, samples, nominal.x, local.x, scale_mm, prior, run.part(0.3, 0.75))
    ended = "" if search.complete else ", which was stopped before its end,"
    if x is not None:
        run.progress(0.75, "refining")
        distant = _descend(chain, samples, x, prior)
        if distant.cost < local.cost - _BETTER:
            return distant, f"the global search{ended} found a better optimum than {origin}", search.warnings
    return local, f"the global search{ended} found nothing better than {origin}", search.warnings
