"""The result of `find_gap`, for reports, the command line and the daemon."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from calibration.effects.base import FittedCoefficient
from calibration.effects.fitted import FittedEffect
from calibration.model.model import CalibratedModel
from calibration.observations import ROW, Floats, Observations

Verdict = Literal["named", "none", "indistinguishable", "unidentified"]


@dataclass(frozen=True)
class Candidate:
    """One effect at one place, scored against the others of its round.

    Attributes:
        family, where: family and place of the effect.
        posterior: posterior probability among all effects of the library and no effect.
        log_bayes_factor: natural logarithm of the Bayes factor against no effect.
        coefficients: coefficients of the linearised fit.
        bounds: name of a coefficient -> its hard limits.
        reason: clause that explains why it was not named; empty if it was named.
    """

    family: str
    where: str
    posterior: float
    log_bayes_factor: float
    coefficients: tuple[FittedCoefficient, ...]
    bounds: Mapping[str, tuple[float, float]]
    reason: str = ""

    def as_dict(self) -> dict[str, object]:
        """Return the JSON object of a candidate in a set (docs/reference/formats.md, gap)."""
        return {"family": self.family, "where": self.where, "posterior": self.posterior}


@dataclass(frozen=True)
class Disagreement:
    """A place and a variable in which simulation and measurement disagree beyond chance.

    Attributes:
        where: joint, prism, `boom`, `base`, `station`, `clock`.
        variable: the variable on which the disagreement depends: `direction`, `torque`, `sin 2 theta4`, `time` ...
        p: p-value, corrected for all tests.
    """

    where: str
    variable: str
    p: float

    def as_dict(self) -> dict[str, object]:
        """Return the JSON object (docs/reference/formats.md, gap)."""
        return {"where": self.where, "variable": self.variable, "p": self.p}


@dataclass(frozen=True)
class Evidence:
    """The evidence of a named effect, given all others.

    Attributes:
        log_bayes_factor: log Bayes factor against the model without the effect.
        posterior: posterior probability of the family.
        places: place that the data do not exclude -> its posterior probability, given the family.
        certificate_p: p-value on data that were not used to select the effect; NaN for a joint error map, which has no
            such test.
    """

    log_bayes_factor: float
    posterior: float
    places: Mapping[str, float]
    certificate_p: float

    def as_dict(self) -> dict[str, object]:
        """Return the members of the JSON object of an effect (docs/reference/formats.md, gap)."""
        p = self.certificate_p
        return {
            "log_bayes_factor": self.log_bayes_factor,
            "places": dict(self.places),
            "certificate_p": None if math.isnan(p) else p,
        }


@dataclass(frozen=True)
class Break:
    """An instant after which the machine is different.

    Attributes:
        variable: `time_s`, or `row` where the data have no time.
        border: value of the variable; rows at or below it belong to the machine before the break.
        before, after: number of samples before and after the break.
        log_bayes_factor: log Bayes factor of two machines against one, including the choice of the instant.
    """

    variable: str
    border: float
    before: int
    after: int
    log_bayes_factor: float

    def as_dict(self) -> dict[str, object]:
        """Return the JSON object `break` (docs/reference/formats.md, gap)."""
        return {
            "variable": self.variable,
            "border": self.border,
            "samples_before": self.before,
            "samples_after": self.after,
            "log_bayes_factor": self.log_bayes_factor,
        }

    @property
    def text(self) -> str:
        """Sentence that states when the break was, and what to do."""
        when = f"row {math.floor(self.border)} (from 0)" if self.variable == ROW else f"time_s = {self.border:.6g}"
        fewer = "before" if self.before < self.after else "after"
        return (
            f"after {when} the machine differs from before ({self.before} samples before, {self.after} after): give "
            f"the rows {fewer} it a separate name in the column setup if the station or the base moved, or leave them "
            f"out if the machine was repaired"
        )


@dataclass(frozen=True)
class Experiment:
    """A proposal for what to measure next.

    Attributes:
        kind: `poses`, `approach`, `dwell`, `payload`, `prism`, `control_points`, `motion` ...
        text: sentence with instructions.
        poses: rows of a plan as printed by `rigcal plan`, if `kind` is `poses`.
        stands_out_sigma: `family@where` of each effect that the poses are to distinguish -> number of sigma by which it
            is expected to stand out from the others, if it exists.
    """

    kind: str
    text: str
    poses: tuple[Mapping[str, object], ...] = ()
    stands_out_sigma: Mapping[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, object]:
        """Return the JSON object (docs/reference/formats.md, gap), with poses and expected sigmas, if any."""
        members: dict[str, object] = {"kind": self.kind, "text": self.text}
        if self.poses:
            members |= {"poses": list(self.poses), "stands_out_sigma": dict(self.stands_out_sigma)}
        return members


@dataclass(frozen=True)
class Forecast:
    """The visibility of one effect in these data.

    Attributes:
        family, where: family and place of the effect.
        unit: unit of the first coefficient.
        visible: RMS share of the displacements that refitted kinematics cannot absorb.
        visible_mm: RMS of this part at the plausible size.
        nameable: smallest value of the first coefficient that could be named from the data; infinity if beyond limits.
        alternative: `family@where` of the most similar effect; empty for none.
        separation: share of the visible part that the alternative cannot imitate.
    """

    family: str
    where: str
    unit: str
    visible: float
    visible_mm: float
    nameable: float
    alternative: str
    separation: float


@dataclass(frozen=True)
class Round:
    """One step of the search.

    Attributes:
        held_out_mm: RMS error of held-out groups before the effects of this round were adopted.
        adopted: `family@where` of the effects adopted in this round; empty in the last round.
        candidates: candidates scored in this round, the most probable first.
    """

    held_out_mm: float
    adopted: tuple[str, ...]
    candidates: tuple[Candidate, ...]


@dataclass(frozen=True)
class GapResult:
    """Result of the gap workflow: a verdict, the named effects, their evidence, and what to measure next.

    Attributes:
        verdict: `named`, `none`, `indistinguishable` or `unidentified`.
        effects: the adopted effects, with coefficients from the joint refit.
        posterior: `family@where` of each adopted effect -> posterior of its family when it was adopted.
        evidence: `family@where` of each adopted effect -> its evidence given all others, and other possible places.
        indistinguishable: the set of effects that cannot be distinguished, of at most three families.
        description: clause about the structure that no effect of the library explains; None for none.
        remaining_significant, remaining_mm: whether structure remains, and the RMS of the remaining errors.
        disabled: family -> reason for its exclusion.
        before_mm, after_mm: RMS errors of the rows with calibrated kinematics only, and with the effects.
        noise_mm: the noise floor; `noise_source` is a clause with its origin.
        held_out: RMS errors of held-out rows before and after, mm; None without held-out rows.
        disagreements: disagreements, most significant first.
        experiments: proposals for what to measure next.
        rounds: steps of the search, in order.
        forecasts: forecasts of all effects for which the data have the columns.
        model: kinematics and adopted effects, without a residual.
        observations, error_before_mm, error_after_mm: the rows, and their errors (n, 3) in the station's frame.
        warnings: sentences.
        machine_break: an instant after which the machine is different; None for none.
        shared: number of held-out rows that are also in the fitted rows.
    """

    verdict: Verdict
    effects: tuple[FittedEffect, ...]
    posterior: Mapping[str, float]
    evidence: Mapping[str, Evidence]
    indistinguishable: tuple[Candidate, ...]
    description: str | None
    remaining_significant: bool
    remaining_mm: float
    disabled: Mapping[str, str]
    before_mm: float
    after_mm: float
    noise_mm: float
    noise_source: str
    held_out: tuple[float, float] | None
    disagreements: tuple[Disagreement, ...]
    experiments: tuple[Experiment, ...]
    rounds: tuple[Round, ...]
    forecasts: tuple[Forecast, ...]
    model: CalibratedModel
    observations: Observations
    error_before_mm: Floats
    error_after_mm: Floats
    warnings: tuple[str, ...] = ()
    machine_break: Break | None = None
    shared: int = 0

    @property
    def raises_held_out(self) -> bool:
        """True if held-out rows fit worse with the effects than without."""
        return bool(self.effects) and self.held_out is not None and self.held_out[1] > self.held_out[0]

    def _effect(self, effect: FittedEffect) -> dict[str, object]:
        """Return the JSON object of one effect, with its evidence."""
        name = str(effect)
        return {**effect.as_dict(), "posterior": self.posterior[name], **self.evidence[name].as_dict()}

    def as_dict(self) -> dict[str, object]:
        """Return the JSON object of `gap` (docs/reference/formats.md), without `seconds`."""
        return {
            "verdict": self.verdict,
            "effects": [self._effect(e) for e in self.effects],
            "indistinguishable": [c.as_dict() for c in self.indistinguishable],
            "description": self.description,
            "remaining": {"significant": self.remaining_significant, "rms_mm": self.remaining_mm},
            "disabled": dict(self.disabled),
            "rms_before_mm": self.before_mm,
            "rms_after_mm": self.after_mm,
            "noise_mm": self.noise_mm,
            "noise_source": self.noise_source,
            "holdout": None
            if self.held_out is None
            else {
                "rms_before_mm": self.held_out[0],
                "rms_after_mm": self.held_out[1],
                "is_worse": self.raises_held_out,
            },
            "break": None if self.machine_break is None else self.machine_break.as_dict(),
            "disagreements": [d.as_dict() for d in self.disagreements],
            "experiments": [e.as_dict() for e in self.experiments],
            "warnings": list(self.warnings),
        }
