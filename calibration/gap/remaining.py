"""What the data show beside all that was named: a set that is pending, or what no effect of the library explains."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from calibration.gap.adopt import Adopted
from calibration.gap.decide import beyond
from calibration.gap.detect import Detection, detect
from calibration.gap.found import Found
from calibration.gap.grammar import Found as Formula
from calibration.gap.grammar import describe
from calibration.gap.rivals import explains, stands_for
from calibration.gap.screen import Screen

_WEIGHED = 12  # effects that are held against a formula
_ANY_SIZE = 1e3  # of the plausible sizes of an effect


@dataclass(frozen=True)
class Remaining:
    """What is left in the end of a search.

    Attributes:
        found: the search.
        detection: on what the errors still depend beyond chance.
        description: the same as a formula, and what the library has to say to it; None where there is nothing to say.
    """

    found: Found
    detection: Detection
    description: str | None

    @property
    def significant(self) -> bool:
        """Whether there is anything that has no name."""
        return bool(self.detection.significant or self.found.rivals or self.found.formulas)

    @property
    def adopted(self) -> Adopted:
        """What the search adopted, with what is known of the rest."""
        return replace(self.found.adopted, structured=self.significant)

    def doubts(self) -> Iterator[str]:
        """What people should know of a model that goes without it, one sentence."""
        if self.found.rivals:
            names = " or ".join(str(weighed.place) for weighed in self.found.rivals)
            yield (
                f"the data ask for {names} and cannot tell which, so none of them is in the model; `rigcal gap` "
                f"proposes the poses that tell"
            )
        elif self.significant:
            what = "kinematics and effects" if self.found.adopted.effects else "the kinematics"
            said = f": {self.description}" if self.description else ""
            yield f"{what} leave more than noise, so the model lacks what could not be named{said}"


def remaining(found: Found, rng: np.random.Generator) -> Remaining:
    """Look at what a search has left.

    Args:
        found: the search.
        rng: draws what chance would leave.
    """
    left, detection = found.left, detect(found.left, rng)
    formulas = found.formulas or (left.found() if detection.significant and not found.rivals else ())
    description = describe(formulas, _of_library(found, formulas[0])) if formulas else None
    if detection.significant and not (formulas or found.rivals or found.adopted.effects):
        on = [f"{d.variable} ({d.where})" for d in detection.disagreements[:1]] or ["something"]
        description = f"the errors depend on {on[0]} in a way that no formula of the grammar says"
    return Remaining(found, detection, description)


def _of_library(found: Found, formula: Formula) -> str:
    """Whether an effect that was not named does what a formula says, a clause."""
    turn, projection = found.turns[-1], found.left.projection
    for weighed in () if found.formulas else turn.weighed[:_WEIGHED]:
        if weighed.log_bayes_factor > 0.0 and explains(weighed, formula, projection):
            reason = turn.reasons.get(str(weighed.place), "it does not stand out enough to be named")
            return f"{weighed.place} would do this, but {reason}"
    for weighed in Screen(projection, found.possible.places).weigh()[:_WEIGHED]:
        names = beyond(projection.situation, weighed)
        if names and stands_for(replace(weighed, scale=_ANY_SIZE), formula, projection):
            return f"{weighed.place} would do this, but {', '.join(names)} would be beyond what is physical"
    return "not in the library"
