"""Judging data and fit: whether they are what they seem, in refusals and in warnings."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from calibration.errors import UnsafeError
from calibration.identification.refinement import Fit, Prior, information, prior_precision
from calibration.identification.samples import Samples
from calibration.identification.standing import standing_spread
from calibration.identification.start import rough_start
from calibration.kinematics import Chain, Placement
from calibration.limits import never_moved
from calibration.observations import Floats, Observations, originals
from calibration.rig import Rig
from calibration.row_doubts import row_doubts

_NOISE = 2.0  # times the sigma of instruments and repeats: what is left is theirs
_CHANCE = 4.0  # standard deviations of the chi-square of the corrections
_GOOD = 2  # fixes a parameter, from which on build tolerances matter little
_FEW = 0.02  # share of the fixes left out
_FAR_RAD = math.radians(75.0)  # from the rig file: no assembly is off so much, a reading may be
_TILTED_DEG = 30.0  # no carrier works on such a slope
_FAR_TOLERANCES = 100.0  # likewise of lengths
_TURNING_DEG = 3.0  # standard error of a base's attitude beneath a known machine; 2 mm over a metre leave a tenth
_DISCARDED = 1.0 / 3.0  # share of the fixes
_DISCARDED_OF_ONE = 0.8  # of a set-up or a prism
_LEAST_DISCARDED = 5
_FOREIGN = 2.0  # misfit after the fit over what build tolerances explain before it


def refuse_mirrored(chain: Chain, samples: Samples) -> None:
    """UnsafeError where the coordinates are mirrored: no method can know it from a bad fit."""
    blank = Chain(chain.rig, {setup: Placement.identity() for setup in chain.setups})
    rough_start(blank, samples, np.zeros(len(blank)), mirrored="refuse")


def rms_left_mm(chain: Chain, samples: Samples, x: Floats) -> float:
    """RMS 3-D error of all samples."""
    error = samples.position_mm - chain.positions_mm(x[: len(chain)], samples.data)
    return math.sqrt(float((error**2).sum(axis=1).mean()))


def different_fixes(chain: Chain, samples: Samples) -> int:
    """How many samples differ in prism, set-up or, by more than readings of a standing joint do, in readings.

    The same pose again lowers the noise and shows no more. Nobody asks for more than there are parameters: the count
    ends there.
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
    """How many fixes to measure: a sentence's last clause, the same wherever there are too few."""
    return (
        f"measure {_GOOD * parameters} or more in different poses all over the work volume (fewer than "
        f"{math.ceil(parameters / 3)} are refused)"
    )


def doubts(observations: Observations, chain: Chain, different: int) -> Iterator[str]:
    """What about the data, of so many different fixes, weakens the result without preventing it."""
    copied = np.flatnonzero(originals(observations) != np.arange(len(observations)))
    if len(copied):
        yield (
            f"{len(copied)} of {len(observations)} rows are copies of earlier ones in every digit, the first in row "
            f"{copied[0] + 1}, and count once"
        )
    yield from row_doubts(chain.rig, observations)
    if different < len(chain):
        yield (
            f"{different} different fixes are few for {len(chain)} parameters: much of the model rests on build "
            f"tolerances alone; {_how_many(len(chain))}"
        )


def tilts(chain: Chain, fit: Fit) -> Iterator[str]:
    """Set-ups where up at the rig is not up at the station, which a rigid placement hides from the fit."""
    gravity = np.array(chain.rig.gravity) / np.linalg.norm(chain.rig.gravity)
    for number, setup in enumerate(chain.setups):
        up = -chain.base(fit.x, number).rotation @ gravity
        tilt_deg = math.degrees(math.acos(float(np.clip(up[2], -1.0, 1.0))))
        if tilt_deg > _TILTED_DEG:
            name = f"set-up {setup!r}" if setup else "the base"
            yield (
                f"{name}: what the rig file calls up is {tilt_deg:.0f} deg from the station's z; check the order of "
                f"x, y, z, that the station is levelled, and gravity in the rig file (positions are right all the "
                f"same; loads of gravity would not be)"
            )


def known_variance(chain: Chain, samples: Samples, fit: Fit) -> float:
    """What station, readings and repeats account for on the average, mm^2 per axis."""
    lin = chain.linearise(fit.x, samples.data)
    return samples.variance(chain.rig, lin.joint_jacobian)


def at_the_noise(chain: Chain, samples: Samples, fit: Fit) -> bool:
    """Whether nothing is left for another optimum to explain.

    Errors at the size that station, readings and repeats account for are as good as any model's, and the corrections
    that led there are as large as the prior expects (its scale included): another optimum could only tie.
    """
    tolerated = np.isfinite(chain.prior_sigma)
    pull = fit.x[tolerated] / (fit.prior_scale * chain.prior_sigma[tolerated])
    ordinary = float(pull @ pull) < len(pull) + _CHANCE * math.sqrt(2.0 * len(pull))
    explained = fit.excess_variance < _NOISE**2 * known_variance(chain, samples, fit)
    discarded = float((fit.weight < 0.5).mean())
    return ordinary and explained and discarded < _FEW and fit.settled


def rms_tolerated_mm(chain: Chain, samples: Samples, nominal: Fit) -> float:
    """RMS 3-D error of the nominal model that build tolerances explain."""
    lin = chain.linearise(nominal.x, samples.data)
    sigma = np.where(np.isinf(chain.prior_sigma), 0.0, chain.prior_sigma)
    return math.sqrt(float(((lin.jacobian * sigma) ** 2).sum() / len(samples)))


def mean_error_mm(chain: Chain, samples: Samples, fit: Fit) -> float:
    """Mean 3-D error of all samples, discarded ones too."""
    error = samples.position_mm - chain.positions_mm(fit.x, samples.data)
    return float(np.linalg.norm(error, axis=1).mean())


def beyond_assembly(chain: Chain, fit: Fit) -> bool:
    """Whether a fit is so far from the rig file that it stands for a reading that means something else."""
    tolerated = np.isfinite(chain.prior_sigma)
    angle = tolerated & np.array([p.unit == "rad" for p in chain.parameters])
    length = tolerated & ~angle
    far_angle = np.abs(fit.x[angle]) > _FAR_RAD
    far_length = np.abs(fit.x[length]) > _FAR_TOLERANCES * chain.prior_sigma[length]
    return bool(far_angle.any() or far_length.any())


def refuse_foreign(chain: Chain, samples: Samples, fit: Fit, tolerated_mm: float, prior: Prior) -> None:
    """Errors that build tolerances cannot explain even before calibration mean another machine or wrong columns."""
    error = samples.position_mm - chain.positions_mm(fit.x, samples.data)
    left = math.sqrt(float(fit.weight @ (error**2).sum(axis=1) / fit.weight.sum()))
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
        chain, samples: kinematics and rows.
        x: (p,) parameters, about as they are.
    """
    known = information(chain, samples, x, excess_variance=0.0) + np.diag(prior_precision(chain, 1.0))
    for number, setup in enumerate(chain.setups):
        place, turn = np.split(np.arange(len(chain))[chain.base_index(number)], 2)
        both = known[np.ix_(turn, place)]
        attitude = known[np.ix_(turn, turn)] - both @ np.linalg.solve(known[np.ix_(place, place)], both.T)
        sigma_deg = math.degrees(float(np.linalg.eigvalsh(attitude)[0]) ** -0.5)
        if sigma_deg > _TURNING_DEG:
            name = f"set-up {setup!r}" if setup else "the data"
            raise UnsafeError(
                f"{name}: all fixes lie in one place or on a line, but for their noise, so the base may turn about it "
                f"(1 sigma: {sigma_deg:.0f} deg); measure other poses, and check the sigma columns where there are any"
            )


def _encoders_that_stood_still(rig: Rig, samples: Samples) -> str:
    """What a refusal says of them: nothing where there are none."""
    still = [
        joint.name
        for joint, readings in zip(rig.joints, samples.data.readings.T, strict=True)
        if never_moved(joint, float(readings.min()), float(readings.max()))
    ]
    if not still:
        return ""
    return f"; {', '.join(still)} never moved in these data: if the machine did, its encoder does not read"


def refuse_discarded(chain: Chain, samples: Samples, fit: Fit, prior: Prior) -> None:
    """A fit that left out much of the data, or nearly all of a set-up or a prism, is no fit of the data."""
    discarded = fit.weight < 0.5
    still = _encoders_that_stood_still(chain.rig, samples)
    left_out = "the fit had to leave out"
    for setup, name in enumerate(chain.setups):
        own = discarded[samples.data.setup == setup]
        if len(chain.setups) > 1 and own.sum() >= _LEAST_DISCARDED and own.mean() > _DISCARDED_OF_ONE:
            raise UnsafeError(
                f"{left_out} {own.sum()} of the {len(own)} fixes of set-up {name!r}: check unit, order and sign of its "
                f"x, y, z, whether the station stood still, and whether the joints were read as at the other set-ups"
            )
    for prism, name in enumerate(chain.rig.prism_names):
        own = discarded[samples.data.prism == prism]
        if own.sum() >= _LEAST_DISCARDED and own.mean() > _DISCARDED_OF_ONE:
            hint = "" if prior == "as-built" else "; --prior as-built also tries joints that are mounted turned"
            raise UnsafeError(
                f"{left_out} {own.sum()} of the {len(own)} fixes of prism {name!r}, so it would be wrong "
                f"there: check which prism was measured, its offset, and zero and sign of the joints before it{hint}"
                f"{still}"
            )
    if discarded.mean() > _DISCARDED:
        raise UnsafeError(
            f"{left_out} {discarded.sum()} of {len(discarded)} fixes, so it describes a part of the data "
            f"only: check columns, units and zeros of the joints, and the station's set-up{still}"
        )
