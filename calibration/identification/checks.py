"""Checks of data and fit: refusals of what is not what it seems, and warnings of what weakens the result."""

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
_GOOD = 2  # fixes a parameter, from which on build tolerances matter little
_FAR_MM = 5e5  # from the instrument: nobody measures a boom from there
_LIGHT, _HEAVY = 1e-3, 10.0  # of the machine, between which its payload is
_TOO_FAST = 3.0  # times the fastest motion of a joint
_LISTED = 5  # columns
_FEW_TIMES = 10
_SLOW_S = 3600.0  # between fixes: nobody measures so slowly
_UNORDERED = 0.25  # of the rows; a clock is not set as often

# Of a fit.
_NOISE = 2.0  # times the sigma of instruments and repeats: what is left is theirs
_CHANCE = 4.0  # standard deviations of the chi-square of the corrections
_FEW = 0.02  # share of the fixes left out
_FAR_RAD = math.radians(75.0)  # from the rig file: no assembly is off so much, a reading may be
_FAR_TOLERANCES = 100.0  # likewise of lengths
_TILTED_DEG = 30.0  # no carrier works on such a slope
_TURNING_DEG = 3.0  # standard error of a base's attitude beneath a known machine; 2 mm over a metre leave a tenth
_LEFT_OUT = "the fit had to leave out"
_DISCARDED = 1.0 / 3.0  # share of the fixes
_DISCARDED_OF_ONE = 0.8  # of a set-up or a prism
_LEAST_DISCARDED = 5
_FOREIGN = 2.0  # misfit after the fit over what build tolerances explain before it

# Of constants that the rig file holds fixed.
_NOTABLE = 0.1  # of the sigma that instruments account for: what is left beyond it
_BETTER = 10.0  # in log evidence
_LESS = 0.5  # of what is left beyond the noise
_SIGNIFICANT = 4.0  # standard errors


# -- observations ------------------------------------------------------------------------------------------------------


def different_fixes(chain: Chain, samples: Samples) -> int:
    """Count the samples that differ in prism, set-up or readings, up to the number of parameters.

    Readings differ by more than those of a standing joint do: the same pose again lowers the noise and shows no more.
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
    """UnsafeError if there are fewer fixes, or fewer `different` ones, than could determine the parameters."""
    parameters = len(Chain(rig, {})) + 6 * len(set(observations.setup.tolist()))
    fixes = len(observations)
    different = fixes if different is None else different
    if 3 * different < parameters:
        repeats = f", repeats counted once of {fixes}," if different < fixes else ""
        there_are = f"1 different fix{repeats} is" if different == 1 else f"{different} different fixes{repeats} are"
        raise UnsafeError(
            f"{there_are} {3 * different} coordinates, which cannot determine {parameters} parameters; "
            f"{_how_many(parameters)}"
        )


def _how_many(parameters: int) -> str:
    return (
        f"measure {_GOOD * parameters} or more in different poses all over the work volume (fewer than "
        f"{math.ceil(parameters / 3)} are refused)"
    )


def data_warnings(observations: Observations, chain: Chain, different: int) -> Iterator[str]:
    """Warn of data, of so many different fixes, that weaken the result without preventing it."""
    copied = np.flatnonzero(originals(observations) != np.arange(len(observations)))
    if len(copied):
        yield (
            f"{len(copied)} of {len(observations)} rows are copies of earlier ones in every digit, the first in "
            f"{observations.row_name(copied[0])}, and count once"
        )
    yield from row_warnings(chain.rig, observations)
    yield from _warn_of_ignored(chain.rig, observations)
    if different < len(chain):
        yield (
            f"{different} different fixes are few for {len(chain)} parameters: much of the model rests on build "
            f"tolerances alone; {_how_many(len(chain))}"
        )


def row_warnings(rig: Rig, observations: Observations) -> Iterator[str]:
    """Warn of set-ups, clock, origin, payload and rates that seem wrong; no model is needed."""
    yield from _warn_of_setups(observations)
    yield from _warn_of_clock(observations)
    distance_mm = float(np.median(np.linalg.norm(observations.position_mm, axis=1)))
    if distance_mm > _FAR_MM:
        yield (
            f"the fixes are {distance_mm / 1e6:.3g} km from the origin of x, y, z, where the instrument should be: of "
            f"map coordinates, subtract the instrument's; the noise of a fix goes with its distance from there"
        )
    machine_kg = sum(mass.kg for mass in rig.masses)
    most_kg = float(np.nanmax(observations.extra.get("payload_kg", np.zeros(0)), initial=0.0))
    if min(machine_kg, most_kg) > 0.0 and not _LIGHT < most_kg / machine_kg < _HEAVY:
        yield (
            f"payload_kg is {most_kg:.3g} at most, on a machine of {machine_kg:.0f} kg by the rig file: is it in "
            f"{'t' if most_kg < machine_kg else 'g'}? convert it to kg"
        )
    for joint in rig.joints:
        rate = observations.extra.get(f"{joint.name}_rate", np.zeros(0))
        beyond = int((np.abs(rate) > _TOO_FAST * joint.max_rate).sum())
        if beyond:
            yield (
                f"{joint.name}_rate: {beyond} of {len(rate)} are more than {_TOO_FAST:g} times its max_rate, "
                f"{joint.max_rate:g} {joint.unit}/s; check column and unit, for the noise of a fix goes with its rates"
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
            f"{observations.row_name(int(blank.argmax()))}, beside those of {named}: they are taken for another set-up "
            f"with a base of its own; fill in the column"
        )


def _warn_of_clock(observations: Observations) -> Iterator[str]:
    """Warn of a clock that was set back or began anew, or that counts other than seconds.

    A table sorted by something else is no sign of the first.
    """
    time_s = observations.extra.get("time_s", np.full(len(observations), np.nan))
    known = np.flatnonzero(np.isfinite(time_s))
    apart_s = np.diff(np.unique(time_s[known]))
    if len(apart_s) >= _FEW_TIMES and np.median(apart_s) > _SLOW_S:
        yield (
            f"time_s: half of the fixes are more than {np.median(apart_s) / 3600.0:.2g} h apart, as if it were in "
            f"milliseconds; what depends on time takes it as seconds, so divide it by 1000 if so"
        )
    # By prism and set-up tables are often sorted.
    order = known[np.lexsort((observations.prism[known], observations.setup[known]))]
    same = (observations.prism[order][1:] == observations.prism[order][:-1]) & (
        observations.setup[order][1:] == observations.setup[order][:-1]
    )
    back = order[1:][same & (np.diff(time_s[order]) < 0.0)]
    if 0 < len(back) <= _UNORDERED * len(known):
        yield (
            f"time_s runs backward, first in {observations.row_name(int(back.min()))}: what depends on time takes the "
            f"rows in the order of time_s; was the clock set, or does every session count from zero? correct the column"
        )


# -- sizes of errors ---------------------------------------------------------------------------------------------------


def rms_left_mm(chain: Chain, samples: Samples, x: Floats) -> float:
    """RMS 3-D error of all samples."""
    return math.sqrt(float((_errors_mm(chain, samples, x[: len(chain)]) ** 2).sum(axis=1).mean()))


def mean_error_mm(chain: Chain, samples: Samples, fit: Fit) -> float:
    """Mean 3-D error of all samples, discarded ones too."""
    return float(np.linalg.norm(_errors_mm(chain, samples, fit.x), axis=1).mean())


def rms_tolerated_mm(chain: Chain, samples: Samples, nominal: Fit) -> float:
    """RMS 3-D error of the nominal model that build tolerances explain."""
    lin = chain.linearise(nominal.x, samples.data)
    sigma = np.where(np.isinf(chain.prior_sigma), 0.0, chain.prior_sigma)
    return math.sqrt(float(((lin.jacobian * sigma) ** 2).sum() / len(samples)))


def _errors_mm(chain: Chain, samples: Samples, x: Floats) -> Floats:
    return samples.position_mm - chain.positions_mm(x, samples.data)


def _known_variance(chain: Chain, samples: Samples, fit: Fit) -> float:
    """Mean variance by station, readings and repeats, mm^2 per axis."""
    return samples.variance(chain.rig, chain.linearise(fit.x, samples.data).joint_jacobian)


# -- fit ---------------------------------------------------------------------------------------------------------------


def at_the_noise(chain: Chain, samples: Samples, fit: Fit) -> bool:
    """True if nothing is left for another optimum to explain.

    Errors at the size that station, readings and repeats account for are as good as any model's, and the corrections
    that led there are as large as the prior expects (its scale included): another optimum could only tie.
    """
    tolerated = np.isfinite(chain.prior_sigma)
    pull = fit.x[tolerated] / (fit.prior_scale * chain.prior_sigma[tolerated])
    ordinary = float(pull @ pull) < len(pull) + _CHANCE * math.sqrt(2.0 * len(pull))
    explained = fit.excess_variance < _NOISE**2 * _known_variance(chain, samples, fit)
    discarded = float((fit.weight < 0.5).mean())
    return ordinary and explained and discarded < _FEW and fit.converged


def beyond_assembly(chain: Chain, fit: Fit) -> bool:
    """True if a fit is so far from the rig file that it stands for a reading that means something else."""
    tolerated = np.isfinite(chain.prior_sigma)
    angle = tolerated & np.array([p.unit == "rad" for p in chain.parameters])
    length = tolerated & ~angle
    far_angle = np.abs(fit.x[angle]) > _FAR_RAD
    far_length = np.abs(fit.x[length]) > _FAR_TOLERANCES * chain.prior_sigma[length]
    return bool(far_angle.any() or far_length.any())


def tilt_warnings(chain: Chain, fit: Fit) -> Iterator[str]:
    """Warn of set-ups where up at the rig is not up at the station, which a rigid placement hides from the fit."""
    gravity = np.array(chain.rig.gravity) / np.linalg.norm(chain.rig.gravity)
    for number, setup in enumerate(chain.setups):
        up = -chain.base(fit.x, number).rotation @ gravity
        tilt_deg = math.degrees(math.acos(float(np.clip(up[2], -1.0, 1.0))))
        if tilt_deg > _TILTED_DEG:
            yield (
                f"{in_words(setup, 'the base')}: what the rig file calls up is {tilt_deg:.0f} deg from the station's "
                f"z; check the order of x, y, z, that the station is levelled, and gravity in the rig file (positions "
                f"are right all the same; loads of gravity would not be)"
            )


def fixed_constant_warnings(chain: Chain, samples: Samples, fit: Fit, prior: Prior) -> Iterator[str]:
    """Warn of constants that a rig file holds fixed although the data show them off, such as a tilt of parallel axes.

    Args:
        chain: kinematics with what the rig file identifies.
        samples: rows of the fit.
        fit: of them.
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
            f"identify, or leave it out at their rows"
        )


def refuse_foreign(chain: Chain, samples: Samples, fit: Fit, tolerated_mm: float, prior: Prior) -> None:
    """UnsafeError for errors that build tolerances do not explain even before calibration: another machine's data."""
    square = (_errors_mm(chain, samples, fit.x) ** 2).sum(axis=1)
    left = math.sqrt(float(fit.weight @ square / fit.weight.sum()))
    if left > _FOREIGN * tolerated_mm:
        hint = "" if prior == "as-built" else "; if the nominal model is that far off, use --prior as-built"
        hint += _encoders_that_stood_still(chain.rig, samples)
        raise UnsafeError(
            f"after the fit the fixes are still {left:.0f} mm RMS off, outliers aside, where this rig's build "
            f"tolerances explain {tolerated_mm:.0f} mm even before it: another rig's data, exchanged columns, a "
            f"station that moved, or units, zeros of joints or a convention of rows other than the rig file has{hint}"
        )


def refuse_turning(chain: Chain, samples: Samples, x: Floats) -> None:
    """UnsafeError where the fixes of a set-up lie in one place, or on a line, but for their noise.

    The base may turn about that, and noise alone would decide how: any pose but those measured would be metres off.

    Args:
        chain: kinematics.
        samples: rows.
        x: (p,) parameters, about as they are.
    """
    known = information(chain, samples, x, excess_variance=0.0) + np.diag(prior_precision(chain, 1.0))
    for number, setup in enumerate(chain.setups):
        place, turn = np.split(np.arange(len(chain))[chain.base_index(number)], 2)
        both = known[np.ix_(turn, place)]
        attitude = known[np.ix_(turn, turn)] - both @ np.linalg.solve(known[np.ix_(place, place)], both.T)
        sigma_deg = math.degrees(float(np.linalg.eigvalsh(attitude)[0]) ** -0.5)
        if sigma_deg > _TURNING_DEG:
            raise UnsafeError(
                f"{in_words(setup)}: all fixes lie in one place or on a line, but for their noise, so the base may "
                f"turn about it (1 sigma: {sigma_deg:.0f} deg); measure other poses, and check the sigma columns where "
                f"there are any"
            )


def refuse_discarded(chain: Chain, samples: Samples, fit: Fit, prior: Prior) -> None:
    """UnsafeError for a fit that left out nearly all of a set-up or a prism."""
    discarded = fit.weight < 0.5
    still = _encoders_that_stood_still(chain.rig, samples)
    for setup, name in enumerate(chain.setups):
        own = discarded[samples.data.setup == setup]
        if len(chain.setups) > 1 and own.sum() >= _LEAST_DISCARDED and own.mean() > _DISCARDED_OF_ONE:
            raise UnsafeError(
                f"{_LEFT_OUT} {own.sum()} of the {len(own)} fixes of set-up {name!r}: check unit, order and sign of "
                f"its x, y, z, whether the station stood still, and whether the joints were read as elsewhere"
            )
    for prism, name in enumerate(chain.rig.prism_names):
        own = discarded[samples.data.prism == prism]
        if own.sum() >= _LEAST_DISCARDED and own.mean() > _DISCARDED_OF_ONE:
            hint = "" if prior == "as-built" else "; --prior as-built also tries joints that are mounted turned"
            raise UnsafeError(
                f"{_LEFT_OUT} {own.sum()} of the {len(own)} fixes of prism {name!r}, so it would be wrong "
                f"there: check which prism was measured, its offset, and zero and sign of the joints before it{hint}"
                f"{still}"
            )


def refuse_much_discarded(chain: Chain, samples: Samples, fit: Fit) -> None:
    """UnsafeError for a fit, with effects where there are any, that left out much of the data."""
    discarded = fit.weight < 0.5
    if discarded.mean() > _DISCARDED:
        raise UnsafeError(
            f"{_LEFT_OUT} {discarded.sum()} of {len(discarded)} fixes, so it describes a part of the data only: check "
            f"columns, units and zeros of the joints, and the station's set-up"
            f"{_encoders_that_stood_still(chain.rig, samples)}"
        )


def _encoders_that_stood_still(rig: Rig, samples: Samples) -> str:
    """Last clause of a refusal that names them; empty where there are none."""
    still = [
        joint.name
        for joint, readings in zip(rig.joints, samples.data.readings.T, strict=True)
        if never_moved(joint, float(readings.min()), float(readings.max()))
    ]
    if not still:
        return ""
    return f"; {', '.join(still)} never moved in these data: if the machine did, its encoder does not read"
