"""The answer of `find_gap`, as reports, the command line and the daemon take it."""

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
        family, where: which.
        posterior: probability that it is the one, among all of the library and nothing.
        log_bayes_factor: of it against nothing, natural logarithm.
        coefficients: as the linearised fit has them.
        bounds: name of a coefficient -> its hard limits.
        reason: why it was not named, a clause; empty where it was.
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
        variable: on what the disagreement depends there: `direction`, `torque`, `sin 2 theta4`, `time` ...
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
    """The evidence of an effect that is named, given all others.

    Attributes:
        log_bayes_factor: against the model without it.
        posterior: probability of its family.
        places: place -> probability that it is there, given the family; those that the data do not exclude.
        certificate_p: p-value on data that had no part in choosing it; NaN for a map, which no half could choose.
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
    """An instant after which the machine is another.

    Attributes:
        variable: `time_s`, or `row` where the data have no time.
        border: the last instant or row of the machine as it was is at or below it.
        before, after: number of samples.
        log_bayes_factor: of two machines against one, the instant chosen among all.
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
        """A sentence: when, and what to do."""
        when = f"row {math.floor(self.border)} (from 0)" if self.variable == ROW else f"time_s = {self.border:.6g}"
        fewer = "before" if self.before < self.after else "after"
        return (
            f"after {when} the machine is another than before ({self.before} samples before, {self.after} after): give "
            f"the rows {fewer} it a name of their own in the column setup if the station or the base moved, or leave "
            f"them out if the machine was repaired"
        )


@dataclass(frozen=True)
class Experiment:
    """A proposal for what to measure next.

    Attributes:
        kind: `poses`, `approach`, `dwell`, `payload`, `prism`, `control_points`, `motion` ...
        text: what to do, a sentence.
        poses: a plan's rows as `rigcal plan` prints them, where it is poses.
        stands_out_sigma: `family@where` of what the poses are to tell apart -> by how many sigma it is expected to
            stand out from the others in them, if it is there.
    """

    kind: str
    text: str
    poses: tuple[Mapping[str, object], ...] = ()
    stands_out_sigma: Mapping[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, object]:
        """Return the JSON object (docs/reference/formats.md, gap), with poses and their promise, if any."""
        told: dict[str, object] = {"kind": self.kind, "text": self.text}
        if self.poses:
            told |= {"poses": list(self.poses), "stands_out_sigma": dict(self.stands_out_sigma)}
        return told


@dataclass(frozen=True)
class Forecast:
    """The visibility of one effect in these data.

    Attributes:
        family, where: which.
        unit: of its first coefficient.
        visible: share of what it moves, RMS, that refitted kinematics cannot absorb.
        visible_mm: RMS of that at the plausible size.
        nameable: smallest value of the first coefficient that this data could name; infinity for none within bounds.
        alternative: `family@where` of the effect most like it; empty for none.
        separation: share of what is visible that the alternative cannot imitate either.
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
        held_out_mm: RMS of held-out groups before anything of this round was adopted.
        adopted: `family@where` of the effects that this round adopted; none in the last.
        candidates: scored in this round, the most probable first.
    """

    held_out_mm: float
    adopted: tuple[str, ...]
    candidates: tuple[Candidate, ...]


@dataclass(frozen=True)
class GapResult:
    """Answer of the gap workflow: a verdict, the effects it names, their evidence, and what to measure next.

    Attributes:
        verdict: `named`, `none`, `indistinguishable` or `unidentified`.
        effects: all that were adopted, with their coefficients from the joint refit.
        posterior: `family@where` of each adopted one -> probability of its family, when it was adopted.
        evidence: `family@where` of each adopted one -> its evidence given all others, and where else it may be.
        indistinguishable: the set that is pending, at most three families.
        description: on what the structure depends that no effect of the library explains.
        remaining_significant, remaining_mm: whether structure is left over, and the RMS of what is.
        disabled: family -> what this data lacks for it.
        before_mm, after_mm: RMS over the rows of calibrated kinematics, and with the effects.
        noise_mm: the noise floor; `noise_source` says where it is from, a clause.
        held_out: RMS before and after on held-out rows, mm; None where none were given.
        disagreements: most significant first.
        experiments: what would tell more.
        rounds: steps of the search, in their order.
        forecasts: of every effect that this data has the columns for.
        model: kinematics and adopted effects, no residual.
        observations, error_before_mm, error_after_mm: the rows with (n, 3) errors, station's frame.
        warnings: sentences.
        machine_break: an instant after which the machine is another; None for none.
        shared: how many of the held-out rows are rows that were fitted.
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
