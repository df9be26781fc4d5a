"""Whether named effects explain what was to be explained: a name for a part of something else is a wrong name.

Beside what the noise explains the kinematics alone leave a gap, and effects must close it. What the noise explains is
known from the station and the rig file only as far as both tell the truth: sigmas are rarely right to better than a
tenth.
"""

from __future__ import annotations

import math

import numpy as np

from calibration.gap.adopt import JointFit
from calibration.gap.detect import detect
from calibration.gap.grammar import Grammar
from calibration.gap.problem import OUTLIER
from calibration.gap.projection import Projection
from calibration.gap.terms import modulations
from calibration.gap.variables import Place
from calibration.observations import Floats

_CLOSED = 0.8  # of the gap, at least
_LEFT = 0.05  # of what an effect explains together with what is left of it, at most
_HIGH = 6.0  # standard errors of the variance that the gap must have to be judged
_MISJUDGED = 0.1  # share by which a sigma may be off
_FAR_MISJUDGED = 1.0  # the same where nothing says that it is anything but noise


def closes(first: Projection, last: Projection, weight: Floats, *, is_structured: bool) -> bool:
    """Whether what was adopted between two projections closes the gap, or the gap is too small to tell.

    Fixes that the kinematics alone do not weigh out are part of the gap: where it is closed for most of them and the
    others become outliers, it is not closed.

    Args:
        first: of the kinematics alone.
        last: with all that was adopted.
        weight: (m,) of the samples in the fit of the kinematics alone.
        is_structured: whether what is left depends on anything; if it does not, it may be noise that is far larger
            than it is said to be.
    """
    noise = last.samples.variance(last.situation.rig, last.joint_jacobian)
    misjudged = _MISJUDGED if is_structured else _FAR_MISJUDGED
    allowed = noise * ((1.0 + misjudged) ** 2 - 1.0)
    given_up = (weight >= OUTLIER) & (last.fit.weight < OUTLIER)
    outside = float((last.error_mm[given_up] ** 2).sum()) / (3.0 * len(weight))
    gap, left = first.fit.excess_variance - allowed, last.fit.excess_variance - allowed + outside
    standard_error = (noise + allowed) * math.sqrt(2.0 / (3.0 * float(last.fit.weight.sum())))
    return gap < _HIGH * standard_error or left < (1.0 - _CLOSED) * gap + standard_error


def depends(joint: JointFit, number: int, projection: Projection, rng: np.random.Generator) -> str:
    """What the coefficient of an effect depends on, though it is to be a constant; empty where it is one.

    Something else was taken for an effect where what is left is the same, but larger in some poses or at some times
    than in others: a beam for an elastic joint, friction for play, a knock for a drift.

    Args:
        joint: kinematics and effects.
        number: of the effect.
        projection: about that fit.
        rng: draws signs, as detection does.
    """
    choice, part, own = joint.choices[number], joint.parts[number], joint.own(number)
    value = joint.fit.x[own]
    # Squares that nothing else explains: those of the coefficients in their posterior, less those in their prior.
    explained = float(
        value @ np.linalg.solve(joint.fit.covariance[own, own], value) - ((value / part.prior_sigma) ** 2).sum()
    )
    place = Place(choice.where, str(choice), {}, projection.moved_mm(part) @ value)
    grammar = Grammar(projection, modulations(projection, place))
    left = float((grammar.score**2).max(initial=0.0))
    if left < _LEFT * (explained + left) or not detect(grammar, rng).significant:
        return ""
    return grammar.terms[int(np.abs(grammar.score).argmax())].variable.text
