"""Comparison of a candidate with the live model, on observations that neither was trained on."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from calibration.errors import UnsafeError
from calibration.evaluation.evaluation import require_positions
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.model.rebase import with_refitted_base
from calibration.numerics.single_thread import one_blas_thread
from calibration.numerics.statistics import WORTHWHILE, paired_test
from calibration.observations import Floats, Observations, Strings
from calibration.residual.folds import standstill_labels

_LEAST_STANDSTILLS = 2  # one is not enough: its fixes share their errors


@dataclass(frozen=True)
class HeldOutComparison:
    """Comparison of a candidate with the model that it would replace, on held-out observations.

    Attributes:
        against: the live model, or the candidate's own nominal stage if there is no live model.
        is_better: True if the candidate may go live. Compared with a live model, it must reduce the error by more than
            chance. Compared with its own nominal stage, it must have two or more standstills and increase the error
            neither overall nor at most standstills.
        before_mm, after_mm: RMS 3-D error without and with the candidate.
        p: probability of such a gain by chance.
        fixes, standstills: numbers used. The groups of the test are standstills, and 100 mm cells for moving fixes.
        refitted: set-ups unknown to one of the models, whose base transform was fitted on these same fixes for both.
        left_out: unknown set-ups whose fixes cannot determine a base.
    """

    against: Literal["live", "nominal"]
    is_better: bool
    before_mm: float
    after_mm: float
    p: float
    fixes: int
    standstills: int
    refitted: tuple[str, ...]
    left_out: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """The verdict as a sentence."""
        other = "the live model" if self.against == "live" else "its own nominal stage"
        where = (
            f"on {self.fixes} held-out fixes of {self.standstills} standstills its error is {self.after_mm:.3g} mm "
            f"RMS, compared with {self.before_mm:.3g} mm of {other}"
        )
        if self.against == "nominal":
            if self.is_better:
                return f"{where}: enough, as there is no live model to beat"
            few = self.standstills < _LEAST_STANDSTILLS
            shown = "larger, overall or at most standstills" if not few else "too few standstills to decide"
            return f"{where}: {shown}; more check fixes must show that it is not larger"
        where += f" (a gain by chance: p = {self.p:.2g})"
        if self.is_better:
            return f"{where}: better beyond chance"
        more = "; more check sessions may show one" if self.after_mm < (1.0 - WORTHWHILE) * self.before_mm else ""
        return f"{where}: no gain beyond chance{more}"

    def as_dict(self) -> dict[str, object]:
        """Return all attributes and the sentence as a JSON object for the store."""
        return asdict(self) | {"sentence": self.sentence}


@one_blas_thread()
def compare_held_out(
    candidate: CalibratedModel, live: CalibratedModel | None, observations: Observations
) -> HeldOutComparison:
    """Compare a candidate with the live model.

    Args:
        candidate: the model that would go live.
        live: the live model, or None. It is ignored if its rig has other joints, or lacks a prism of the observations.
        observations: rows with positions that neither model was trained on.

    Raises:
        DataError: no rows, or rows without positions.
        UnsafeError: there is no set-up where the base of both models is known or can be determined.
    """
    require_positions(observations)
    if live is not None and not _describes(live, observations):
        live = None
    before: list[Floats] = []
    after: list[Floats] = []
    labels: list[Strings] = []
    refitted: list[str] = []
    left_out: list[str] = []
    for setup in sorted(set(observations.setup.tolist())):
        rows = observations.select(observations.setup == setup)
        ours, theirs = candidate, live
        if any(model is not None and setup not in model.placements for model in (candidate, live)):
            try:
                ours = with_refitted_base(candidate, rows)
                theirs = live and with_refitted_base(live, rows)
            except UnsafeError:
                left_out.append(setup)
                continue
            refitted.append(setup)
        old_mm = (
            Predictor.of(ours).nominal_mm(rows) if theirs is None else Predictor.of(theirs).predict(rows).position_mm
        )
        before.append(((rows.position_mm - old_mm) ** 2).sum(axis=1))
        after.append(((rows.position_mm - Predictor.of(ours).predict(rows).position_mm) ** 2).sum(axis=1))
        labels.append(standstill_labels(rows))
    if not before:
        raise UnsafeError(
            f"the held-out fixes cannot determine the base transform: at set-up {left_out[0]!r}, which a model does "
            "not know, measure at least three fixes that are not on a line"
        )
    gain = paired_test(np.concatenate(before), np.concatenate(after), np.concatenate(labels))
    # Gross outliers dominate the RMS and are nearly equal for any two models: so RMS and standstills must both agree.
    no_worse = gain.groups >= _LEAST_STANDSTILLS and gain.after_mm <= gain.before_mm and gain.no_worse >= 0.5
    return HeldOutComparison(
        against="nominal" if live is None else "live",
        is_better=no_worse if live is None else gain.is_better,
        before_mm=gain.before_mm,
        after_mm=gain.after_mm,
        p=gain.p,
        fixes=gain.rows,
        standstills=gain.groups,
        refitted=tuple(refitted),
        left_out=tuple(left_out),
    )


def _describes(model: CalibratedModel, observations: Observations) -> bool:
    """Return True if the model's rig has the joints and prisms of the observations."""
    prisms = set(observations.prism.tolist())
    return set(model.rig.joint_names) == set(observations.joints) and prisms <= set(model.rig.prism_names)
