"""A two-sided cumulative sum after Page (Biometrika 41, 1954): whether a run of scores has left where it should be.

The scores are of standstills: the cube root of a mean squared standardised error, which for a chi-square of three
degrees of freedom is close to normal (Wilson and Hilferty, PNAS 17, 1931). In control they are about N(0, 1). Each is
cut at `CLIP`, so that one wrong shot never decides (a winsorised chart).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Alarm = Literal["none", "worse", "better"]

# A standstill of three coordinates. More fixes of it share the errors of its readings, and scatter less than this.
_FREEDOM = 3.0
_MIDDLE = 1.0 - 2.0 / (9.0 * _FREEDOM)
_SPREAD = math.sqrt(2.0 / (9.0 * _FREEDOM))
REFERENCE = 1.0  # what is this far off in the mean is let pass: errors of 1.3 times the predicted RMS
DECISION = 5.0  # of independent N(0, 1) scores, one false alarm in some 100,000 (Siegmund 1985)
CLIP = 3.0


def score(mean_square: float) -> float:
    """About N(0, 1) for the mean square of the standardised errors of a standstill where the model is right."""
    normal = (math.cbrt(mean_square) - _MIDDLE) / _SPREAD
    return min(max(normal, -CLIP), CLIP)


@dataclass(frozen=True)
class Cusum:
    """Where both sums stand.

    Attributes:
        upper: rises with errors larger than the model predicts.
        lower: rises with errors smaller than it predicts.
    """

    upper: float = 0.0
    lower: float = 0.0

    def after(self, scores: Iterable[float]) -> Cusum:
        """The sums after further scores, in their order."""
        upper, lower = self.upper, self.lower
        for value in scores:
            upper = max(0.0, upper + value - REFERENCE)
            lower = max(0.0, lower - value - REFERENCE)
        return Cusum(upper, lower)

    @property
    def alarm(self) -> Alarm:
        """`worse`: the machine is no longer what the model describes; `better`: the model's sigma is too large."""
        if self.upper > DECISION:
            return "worse"
        return "better" if self.lower > DECISION else "none"
