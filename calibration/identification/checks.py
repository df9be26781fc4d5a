"""Checks of data and fit: errors for data that cannot give a valid model, warnings for data that weaken it."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from calibration.errors import UnsafeError
from calibration.identification.linear_model import information, prior_precision
from calibration.identification.refinement import Fit, Prior, refine
from calibration.identification.samples import Samples, standing_spread
from calibration.identification.start import in_words
from calibration.kinematics.chain import ROW_ORDER, Chain
from calibration.observations import Floats, Observations, originals
from calibration.rig.description import Rig
from calibration.rig.limits import never_moved
from calibration.rig.signals import how_to_use

# Of observations.
_GOOD = 2  # fixes per parameter; with more, build tolerances matter little
_COUNTED = "(a pose counts once for each prism)"
_FAR_MM = 5e5  # from the instrument; no boom is measured from farther away
_LIGHT, _HEAVY = 1e-3, 10.0  # plausible range of the payload, as a factor of the machine's mass
_TOO_FAST = 3.0  # times the fastest motion of a joint
_LISTED = 5  # columns named one by one
_FEW_TIMES = 10  # fewest distinct timestamps to judge their unit by
_SLOW_S = 3600.0  # between fixes; slower measurements are implausible
_UNORDERED = 0.25  # share of the rows; a clock is not set back more often

# Of a fit.
_NOISE = 2.0  # times the sigma of instruments and repeats; smaller residuals count as noise
_CHANCE = 4.0  # standard deviations of the chi-square of the corrections
_FEW = 0.02  # share of the fixes that the fit may leave out
_FAR_RAD = math.radians(75.0)  # from the rig file; only a wrong reading is off by more, no assembly is
_FAR_TOLERANCES = 100.0  # the same for lengths, in build tolerances
_TILTED_DEG = 30.0  # no carrier works on a steeper slope
_TURNING_DEG = 3.0  # standard error of a base's attitude under a known machine; 2 mm over 1 m give a tenth of a degree
_LEFT_OUT = "the fit had to leave out"
_DISCARDED = 1.0 / 3.0  # share of the fixes
_DISCARDED_OF_ONE = 0.8  # share of the fixes of a set-up or a prism
_LEAST_DISCARDED = 5  # fixes
_FOREIGN = 2.0  # misfit after the fit, divided by what build tolerances explain before it

# Of constants that the rig file holds fixed.
_NOTABLE = 0.1  # least excess sigma, as a share of the sigma that instruments account for
_BETTER = 10.0  # in log evidence
_LESS = 0.5  # greatest excess sigma with the constants corrected, as a share of that without
_SIGNIFICANT = 4.0  # standard errors


# -- observations ------------------------------------------------------------------------------------------------------


def different_fixes(chain: Chain, samples: Samples) -> int:
    """Count the samples that differ in prism, set-up or readings, up to the number of parameters.

    Readings count as different if they are farther apart than those of a joint at standstill: repeating a pose lowers
    the noise but adds no information on other parameters.
    """
    data = samples.data
    left = np.column_stack([data.prism, data.setup, data.readings])
    same = np.concatenate([[0.5, 0.5], standing_spread(chain.rig)])
    count = 0
    while len(left) and count < len(chain):
        left = left[(np.abs(left - left[0]) > same).any(axis=1)]
        count += 1
    return count


def require_enough(rig: Rig, observations: Observations, different: int | None = None) -> None:
    """Raise UnsafeError if there are too few fixes to determine the parameters.

    Args:
        rig: gives the parameters, in addition to six for each set-up.
        observations: the fixes.
        different: number of different fixes, from `different_fixes`; all fixes by default.
    """
    parameters = len(Chain(rig, {})) + 6 * len(set(observations.setup.tolist()))
    fixes = len(observations)
    different = fixes if different is None else different
    if 3 * different < parameters:
        if different < fixes:
            counted = f"{different} different pose{'s' * (different != 1)} among {fixes} fixes {_COUNTED}"
        else:
            counted = f"{fixes} fix{'es' * (fixes != 1)}"
        has = "has" if different == 1 else "have"
        raise UnsafeError(
            f"{counted} {has} {3 * different} coordinates, which cannot determine {parameters} parameters; "
            f"{_how_many(parameters)}"
        )


def _how_many(parameters: int) -> str:
    return (
        f"measure {_GOOD * parameters} or more in different poses all over the work volume (fewer than "
        f"{math.ceil(parameters / 3)} are refused)"
    )


def data_warnings(observations: Observations, chain: Chain, different: int) -> Iterator[str]:
    """Yield warnings about data that weaken the result without preventing it.

    Args:
        observations: the data.
        chain: kinematics.
        different: number of different fixes, from `different_fixes`.
    """
    copied = np.flatnonzero(originals(observations) != np.arange(len(observations)))
    if len(copied):
        yield (
            f"{len(copied)} of {len(observations)} rows are exact copies of earlier rows, the first in "
            f"{observations.row_name(copied[0])}; copies are not counted"
        )
    yield from row_warnings(chain.rig, observations)
    yield from _warn_of_ignored(chain.rig, observations)
    if different < len(chain):
        yield (
            f"{different} different poses {_COUNTED} are few for {len(chain)} parameters: much of the model depends on "
            f"build tolerances alone; {_how_many(len(chain))}"
        )


def row_warnings(rig: Rig, observations: Observations) -> Iterator[str]:
    """Yield warnings about set-ups, clock, origin, payload and rates that seem wrong; no model is needed."""
    yield from _warn_of_setups(observations)
    yield from _warn_of_clock(observations)
    distance_mm = float(np.median(np.linalg.norm(observations.position_mm, axis=1)))
    if distance_mm > _FAR_MM:
        yield (
            f"the fixes are {distance_mm / 1e6:.3g} km from the origin of x, y, z, where the instrument should be: if "
            f"these are map coordinates, subtract the instrument's; the noise of a fix depends on its distance from "
            f"there"
        )
    machine_kg = sum(mass.kg for mass in rig.masses)
    most_kg = float(np.nanmax(observations.extra.get("payload_kg", np.zeros(0)), initial=0.0))
    if min(machine_kg, most_kg) > 0.0 and not _LIGHT < most_kg / machine_kg < _HEAVY:
        yield (
            f"payload_kg is {most_kg:.3g} at most, and the machine has {machine_kg:.0f} kg in the rig file: is it in "
            f"{'t' if most_kg < machine_kg else 'g'}? convert it to kg"
        )
    for joint in rig.joints:
        rate = observations.extra.get(f"{joint.name}_rate", np.zeros(0))
        beyond = int((np.abs(rate) > _TOO_FAST * joint.max_rate).sum())
        if beyond:
            yield (
                f"{joint.name}_rate: {beyond} of {len(rate)} are more than {_TOO_FAST:g} times its max_rate, "
                f"{joint.max_rate:g} {joint.unit}/s; check column and unit, as the noise of a fix depends on its rates"
            )


def _warn_of_ignored(rig: Rig, observations: Observations) -> Iterator[str]:
    columns = observations.ignored_numbers
    for column in columns[:_LISTED]:
        yield how_to_use(column, rig.taken)
    more = columns[_LISTED:]
    if more:
        yield f"{len(more)} more columns hold numbers and are not used: {', '.join(ascii(name) for name in more)}"


def _warn_of_setups(observations: Observations) -> Iterator[str]:
    blank = observations.setup == ""
    if blank.any() and not blank.all():
        named = ", ".join(repr(setup) for setup in np.unique(observations.setup[~blank]).tolist())
        yield (
            f"{blank.sum()} of {len(blank)} rows have no setup, the first in "
            f"{observations.row_name(int(blank.argmax()))}, while others have {named}: they are treated as a separate "
            f"set-up with its own base; fill in the column"
        )


def _warn_of_clock(observations: Observations) -> Iterator[str]:
    """Yield warnings about a clock that was set back or restarted, or that does not count seconds.

    A table that is sorted by something other than time is not taken for a clock that was set back.
    """
    time_s = observations.extra.get("time_s", np.full(len(observations), np.nan))
    known = np.flatnonzero(np.isfinite(time_s))
    apart_s = np.diff(np.unique(time_s[known]))
    if len(apart_s) >= _FEW_TIMES and np.median(apart_s) > _SLOW_S:
        yield (
            f"time_s: half of the fixes are more than {np.median(apart_s) / 3600.0:.2g} h apart, as if it were in "
            f"milliseconds; effects of time take it as seconds, so divide it by 1000 if it is in milliseconds"
        )
    # Tables are often sorted by prism and set-up, so only rows with the same of both are compared.
    order = known[np.lexsort((observations.prism[known], observations.setup[known]))]
    same = (observations.prism[order][1:] == observations.prism[order][:-1]) & (
        observations.setup[order][1:] == observations.setup[order][:-1]
    )
    back = order[1:][same & (np.diff(time_s[order]) < 0.0)]
    if 0 < len(back) <= _UNORDERED * len(known):
        yield (
            f"time_s runs backward, first in {observations.row_name(int(back.min()))}: effects of time take the "
            f"rows in the order of time_s; was the clock set, or does every session count from zero? correct the column"
        )


# -- sizes of errors ---------------------------------------------------------------------------------------------------


def rms_left_mm(chain: Chain, samples: Samples, x: Floats) -> float:
    """Return the RMS 3-D error of all samples at `x`, mm; values after the p parameters are ignored."""
    return math.sqrt(float((_errors_mm(chain, samples, x[: len(chain)]) ** 2).sum(axis=1).mean()))


def mean_error_mm(chain: Chain, samples: Samples, fit: Fit) -> float:
    """Return the mean 3-D error of all samples, including discarded ones, mm."""
    return float(np.linalg.norm(_errors_mm(chain, samples, fit.x), axis=1).mean())


def rms_tolerated_mm(chain: Chain, samples: Samples, nominal: Fit) -> float:
    """Return the RMS 3-D error of the nominal model that build tolerances explain, mm.

    Args:
        chain: kinematics with build tolerances.
        samples: the rows.
        nominal: fit of the bases and unknown prism offsets alone.
    """
    lin = chain.linearise(nominal.x, samples.data)
    sigma = np.where(np.isinf(chain.prior_sigma), 0.0, chain.prior_sigma)
    return math.sqrt(float(((lin.jacobian * sigma) ** 2).sum() / len(samples)))


def _errors_mm(chain: Chain, samples: Samples, x: Floats) -> Floats:
    return samples.position_mm - chain.positions_mm(x, samples.data)


def _known_variance(chain: Chain, samples: Samples, fit: Fit) -> float:
    """Return the mean variance due to station, readings and repeats, mm^2 per axis."""
    return samples.variance(chain.rig, chain.linearise(fit.x, samples.data).joint_jacobian)


# -- fit ---------------------------------------------------------------------------------------------------------------


def at_the_noise(chain: Chain, samples: Samples, fit: Fit) -> bool:
    """Return True if a different optimum could not explain the data any better.

    That is so if the errors are as small as station, readings and repeats account for, and the corrections are as
    large as the prior, including its scale, expects: a different optimum could only be as good.
    """
    tolerated = np.isfinite(chain.prior_sigma)
    pull = fit.x[tolerated] / (fit.prior_scale * chain.prior_sigma[tolerated])
    ordinary = float(pull @ pull) < len(pull) + _CHANCE * math.sqrt(2.0 * len(pull))
    explained = fit.excess_variance < _NOISE**2 * _known_variance(chain, samples, fit)
    discarded = float((fit.weight < 0.5).mean())
    return ordinary and explained and discarded < _FEW and fit.converged


def beyond_assembly(chain: Chain, fit: Fit) -> bool:
    """Return True if a fit is so far from the rig file that some reading must mean something else."""
    tolerated = np.isfinite(chain.prior_sigma)
    angle = tolerated & np.array([p.unit == "rad" for p in chain.parameters])
    length = tolerated & ~angle
    far_angle = np.abs(fit.x[angle]) > _FAR_RAD
    far_length = np.abs(fit.x[length]) > _FAR_TOLERANCES * chain.prior_sigma[length]
    return bool(far_angle.any() or far_length.any())


def tilt_warnings(chain: Chain, fit: Fit) -> Iterator[str]:
    """Yield warnings about set-ups where the rig's vertical is not the station's.

    The fit does not show this, as the rigid placement of the base absorbs it.
    """
    gravity = np.array(chain.rig.gravity) / np.linalg.norm(chain.rig.gravity)
    for number, setup in enumerate(chain.setups):
        up = -chain.base(fit.x, number).rotation @ gravity
        tilt_deg = math.degrees(math.acos(float(np.clip(up[2], -1.0, 1.0))))
        if tilt_deg > _TILTED_DEG:
            yield (
                f"{in_words(setup, 'the base')}: the upward direction of the rig file is {tilt_deg:.0f} deg from "
                f"the station's z; check the order of x, y, z, that the station is levelled, and gravity in the rig "
                f"file (positions are right nevertheless, but gravity loads would be wrong)"
            )


def fixed_constant_warnings(chain: Chain, samples: Samples, fit: Fit, prior: Prior) -> Iterator[str]:
    """Yield warnings about constants that a rig file holds fixed although the data show that they are off.

    An example is the tilt between axes that the rig file has as parallel.

    Args:
        chain: kinematics with what the rig file identifies.
        samples: rows of the fit.
        fit: result of fitting `chain` to `samples`.
        prior: how the build tolerances were used.
    """
    if fit.excess_variance < _NOTABLE**2 * _known_variance(chain, samples, fit):
        return
    rig = chain.rig
    constants = tuple(constant for constant, _ in ROW_ORDER[rig.convention])
    rows = tuple(row.model_copy(update={"identify": constants}) for row in rig.rows)
    whole = chain.of(rig.model_copy(update={"rows": rows}))
    found = dict(zip((p.name for p in chain.parameters), fit.x.tolist(), strict=True))
    other = refine(whole, samples, np.array([found.get(p.name, 0.0) for p in whole.parameters]), prior=prior)
    if other.cost > fit.cost - _BETTER or other.excess_variance > _LESS**2 * fit.excess_variance:
        return
    off = np.abs(other.x) > _SIGNIFICANT * np.sqrt(np.diag(other.covariance))
    names = [p.name for p, is_off in zip(whole.parameters, off, strict=True) if is_off and p.name not in found]
    if names:
        left_mm, less_mm = np.sqrt([fit.excess_variance, other.excess_variance])
        yield (
            f"the rig file does not let calibration correct {', '.join(names)}, which the data show to be off: "
            f"{left_mm:.2g} mm per axis are left beyond the noise, and {less_mm:.2g} with them corrected; name them in "
            f"identify of their rows, or remove identify there"
        )


def refuse_foreign(chain: Chain, samples: Samples, fit: Fit, tolerated_mm: float, prior: Prior) -> None:
    """Raise UnsafeError if errors exceed what build tolerances explain before calibration: another rig's data.

    Args:
        chain: kinematics.
        samples: rows of the fit.
        fit: result of fitting `chain` to `samples`.
        tolerated_mm: RMS 3-D error that build tolerances explain before the fit.
        prior: how the build tolerances were used; decides on the advice in the message.
    """
    square = (_errors_mm(chain, samples, fit.x) ** 2).sum(axis=1)
    left = math.sqrt(float(fit.weight @ square / fit.weight.sum()))
    if left > _FOREIGN * tolerated_mm:
        hint = "" if prior == "as-built" else "; if the nominal model is that far off, use --prior as-built"
        hint += _encoders_that_stood_still(chain.rig, samples)
        raise UnsafeError(
            f"after the fit the fixes without outliers are still {left:.0f} mm RMS off, but the build tolerances of "
            f"this rig explain only {tolerated_mm:.0f} mm even before the fit: check for another rig's data, exchanged "
            f"columns, a station that moved, and units, joint zeros or a row convention that differ from the rig "
            f"file{hint}"
        )


def refuse_turning(chain: Chain, samples: Samples, x: Floats) -> None:
    """Raise UnsafeError where the fixes of a set-up lie in one place or on a line, apart from their noise.

    The base could turn about that place or line, and noise alone would decide its attitude: every pose that was not
    measured would be metres off.

    Args:
        chain: kinematics.
        samples: rows.
        x: (p,) approximate parameters.
    """
    known = information(chain, samples, x, excess_variance=0.0) + np.diag(prior_precision(chain, 1.0))
    for number, setup in enumerate(chain.setups):
        place, turn = np.split(np.arange(len(chain))[chain.base_index(number)], 2)
        both = known[np.ix_(turn, place)]
        attitude = known[np.ix_(turn, turn)] - both @ np.linalg.solve(known[np.ix_(place, place)], both.T)
        sigma_deg = math.degrees(float(np.linalg.eigvalsh(attitude)[0]) ** -0.5)
        if sigma_deg > _TURNING_DEG:
            raise UnsafeError(
                f"{in_words(setup)}: all fixes lie in one place or on a line, apart from their noise, so the base "
                f"may turn about it (1 sigma: {sigma_deg:.0f} deg); measure other poses, and check the sigma columns "
                f"if there are any"
            )


def refuse_discarded(chain: Chain, samples: Samples, fit: Fit, prior: Prior) -> None:
    """Raise UnsafeError if a fit left out nearly all fixes of a set-up or a prism.

    Args:
        chain: kinematics.
        samples: rows of the fit.
        fit: result of fitting `chain` to `samples`.
        prior: how the build tolerances were used; decides on the advice in the message.
    """
    discarded = fit.weight < 0.5
    still = _encoders_that_stood_still(chain.rig, samples)
    for setup, name in enumerate(chain.setups):
        own = discarded[samples.data.setup == setup]
        if len(chain.setups) > 1 and own.sum() >= _LEAST_DISCARDED and own.mean() > _DISCARDED_OF_ONE:
            raise UnsafeError(
                f"{_LEFT_OUT} {own.sum()} of the {len(own)} fixes of set-up {name!r}: check unit, order and sign of "
                f"its x, y, z, whether the station stood still, and whether the joints were read as at other set-ups"
            )
    for prism, name in enumerate(chain.rig.prism_names):
        own = discarded[samples.data.prism == prism]
        if own.sum() >= _LEAST_DISCARDED and own.mean() > _DISCARDED_OF_ONE:
            hint = "" if prior == "as-built" else "; --prior as-built also tries joints that are mounted turned"
            raise UnsafeError(
                f"{_LEFT_OUT} {own.sum()} of the {len(own)} fixes of prism {name!r}, so the model would be "
                f"wrong there: check which prism was measured, its offset, and zero and sign of the joints before it"
                f"{hint}{still}"
            )


def refuse_much_discarded(chain: Chain, samples: Samples, fit: Fit) -> None:
    """Raise UnsafeError if a fit, including its effects if any, left out much of the data."""
    discarded = fit.weight < 0.5
    if discarded.mean() > _DISCARDED:
        raise UnsafeError(
            f"{_LEFT_OUT} {discarded.sum()} of {len(discarded)} fixes, so it describes only a part of the data: check "
            f"columns, units and zeros of the joints, and the station's set-up"
            f"{_encoders_that_stood_still(chain.rig, samples)}"
        )


def _encoders_that_stood_still(rig: Rig, samples: Samples) -> str:
    """Return the last clause of an error, naming encoders that never moved; empty if there are none."""
    still = [
        joint.name
        for joint, readings in zip(rig.joints, samples.data.readings.T, strict=True)
        if never_moved(joint, float(readings.min()), float(readings.max()))
    ]
    if not still:
        return ""
    return f"; {', '.join(still)} never moved in these data: if the machine did, the encoder does not work"
