"""Diagnosis of data that the rig file reads wrongly: find the faults whose correction makes them fit.

A reversed sign, a wrong unit, exchanged columns or an encoder that is mounted turned creates a basin of attraction of
its own, which no search within build tolerances reaches. Where a search does reach one, the result is a wrong model
that looks right on a part of the work volume. So every fault is tried: the readings are corrected for it, the base is
placed again and the parameters are brought near their optimum. Two or three simultaneous faults may show no
improvement until all are corrected; therefore the few best hypotheses are kept and extended (beam search).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.errors import UnsafeError
from calibration.identification.data_faults import Fault, possible_faults
from calibration.identification.samples import Integers, Samples
from calibration.identification.start import approach, draw_rows, rough_start
from calibration.kinematics.chain import Chain, ChainData, Placement
from calibration.observations import Floats
from calibration.rig.description import Rig
from calibration.rig.limits import beyond_limits, on_one_turn

_ROWS = 120
_TRIMMED = 0.75  # share of each prism's errors that count
_APPROACHING = 40  # rounds
_PLACING = 20  # rounds; a rough placement is enough to rank hypotheses
_CARRIED = 6  # hypotheses to extend
_TOGETHER = 32  # hypotheses whose positions are computed at once
_APPROACHED = 10  # of the best roughly placed hypotheses of a round
_MUCH = 0.5  # of the misfit before; a fault that leaves more is no evidence
_EXPLAINS = 0.25  # of the misfit of the given data; faults that leave less explain it
_SETTLES = 0.1  # of the same; if it is also tolerable, no further faults are tried
_SLACK = 0.05  # of a joint's range; its limits are not known more exactly
_ALIKE = 1.5  # times the least misfit; below it, explanations count as equally good

Hypothesis = tuple[Fault, ...]


@dataclass(frozen=True)
class Quality:
    """Quality of a model's fit to data.

    Attributes:
        misfit_mm: mean of the smaller three quarters of every prism's 3-D errors, so that outliers do not count but a
            wrong prism does.
        pull: RMS of the corrections, in build tolerances.
    """

    misfit_mm: float
    pull: float

    @classmethod
    def of(cls, chain: Chain, samples: Samples, x: Floats, misfit_mm: Floats | None = None) -> Quality:
        """Quality of a chain with parameters `x` (p,); 3-D misfits (m,) are computed if not given."""
        if misfit_mm is None:
            misfit_mm = np.linalg.norm(samples.position_mm - chain.positions_mm(x, samples.data), axis=1)
        of_prisms = (np.sort(misfit_mm[samples.data.prism == prism]) for prism in np.unique(samples.data.prism))
        used = np.concatenate([own[: math.ceil(_TRIMMED * len(own))] for own in of_prisms])
        tolerated = np.isfinite(chain.prior_sigma)
        pull = x[tolerated] / chain.prior_sigma[tolerated]
        return cls(float(used.mean()), math.sqrt(float(pull @ pull) / max(1, len(pull))))

    def much_better_than(self, other: Quality) -> bool:
        """Return True for a much smaller misfit, or a similar one with much smaller corrections."""
        alike = self.misfit_mm < _ALIKE * other.misfit_mm
        return self.misfit_mm < _MUCH * other.misfit_mm or (alike and self.pull < _MUCH * other.pull)

    def explains(self, before: Quality, tolerated_mm: float) -> bool:
        """Return True if the misfit became much smaller or, where it was tolerable before, the corrections did."""
        if before.misfit_mm < tolerated_mm:
            return self.pull < _MUCH * before.pull
        return self.misfit_mm < _EXPLAINS * before.misfit_mm


@dataclass(frozen=True)
class Diagnosis:
    """Faults that explain why data do not fit.

    Attributes:
        faults: all of them together.
        others: sets of faults that explain the data about as well.
        chain: kinematics with the bases placed on the corrected data.
        x: (p,) parameters for the data as given, near the optimum; None if no parameters can represent the faults.
        before: fit to the data as given.
        after: fit to the corrected data.
    """

    faults: Hypothesis
    others: tuple[Hypothesis, ...]
    chain: Chain
    x: Floats | None
    before: Quality
    after: Quality

    @property
    def what(self) -> str:
        """The faults, in words."""
        return _in_words(self.faults)

    def __str__(self) -> str:
        doubt = "".join(f"; or {_in_words(other)}, which fits equally well" for other in self.others)
        remedies = ", and ".join(fault.remedy for fault in self.faults)
        gain = f"{_size(self.after.misfit_mm)} mm are left in place of {_size(self.before.misfit_mm)} mm"
        if self.after.misfit_mm > _MUCH * self.before.misfit_mm:
            gain = (
                f"the corrections are {_size(self.after.pull)} build tolerances in place of {_size(self.before.pull)}"
            )
        return f"{self.what}: with that corrected, {gain}{doubt}; {remedies}"


@dataclass(frozen=True)
class _Candidate:
    """A hypothesis with the fit to the data corrected for it."""

    faults: Hypothesis
    placements: Mapping[str, Placement]
    x: Floats
    quality: Quality


def diagnose(
    chain: Chain,
    samples: Samples,
    *,
    precision: Floats,
    before: Quality,
    tolerated_mm: float,
    at_once: int,
) -> Diagnosis | None:
    """Find faults that explain why data do not fit, or fit only with a model far from the rig file.

    Args:
        chain: kinematics.
        samples: the rows.
        precision: (p,) 1 / sigma^2 of the parameters' prior.
        before: the best fit to the samples as given.
        tolerated_mm: misfit that needs no explanation.
        at_once: greatest number of simultaneous faults.

    Returns:
        The diagnosis, or None if no faults explain the data.
    """
    blank = Chain(chain.rig, {setup: Placement.identity() for setup in chain.setups})
    # A part of the samples is enough to rank hypotheses.
    part = draw_rows(samples.data, samples.position_mm, _ROWS, 0)
    possible = list(possible_faults(blank, samples))
    carried: list[Hypothesis] = [()]
    best: list[_Candidate] = []
    least = before
    for number in range(at_once):
        hypotheses = _extended(carried, possible)
        if number == 0 and at_once > 1:
            hypotheses += _reversed_pairs(possible)
        rough: list[_Candidate] = []
        for begin in range(0, len(hypotheses), _TOGETHER):
            rough += _placed(blank, samples, part, hypotheses[begin : begin + _TOGETHER])
        rough.sort(key=lambda c: c.quality.misfit_mm)
        near = [_approached(chain.rig, samples, part, precision, candidate) for candidate in rough[:_APPROACHED]]
        near.sort(key=lambda c: c.quality.misfit_mm)
        as_good = [c for c in near if c.quality.misfit_mm < _ALIKE * near[0].quality.misfit_mm]
        as_good.sort(key=lambda c: c.quality.pull)
        if as_good and as_good[0].quality.much_better_than(least):
            least = as_good[0].quality
            best = [c for c in as_good if c.quality.pull < _ALIKE * least.pull]
        if best and least.misfit_mm < min(_SETTLES * before.misfit_mm, tolerated_mm):
            break
        carried = list(dict.fromkeys(c.faults for c in (*near[: _CARRIED // 2], *rough)))[:_CARRIED]
    if not best or not least.explains(before, tolerated_mm):
        return None
    # Only the smallest sets of faults; the set with the fewest readings beyond joint limits first.
    fewest = min(len(candidate.faults) for candidate in best)
    best = [candidate for candidate in best if len(candidate.faults) == fewest]
    best.sort(key=lambda candidate: _readings_beyond_limits(chain.rig, _corrected(samples, candidate.faults)))
    first, *others = best
    chain = Chain(chain.rig, first.placements)
    return Diagnosis(first.faults, tuple(c.faults for c in others), chain, _for_raw_data(chain, first), before, least)


def _extended(carried: Sequence[Hypothesis], possible: Sequence[Fault]) -> list[Hypothesis]:
    """Return every hypothesis extended by one fault, each set of faults once."""
    seen: dict[frozenset[str], Hypothesis] = {}
    for before in carried:
        for more in possible:
            together = (*before, more)
            if _compatible(before, more):
                seen.setdefault(frozenset(fault.what for fault in together), together)
    return list(seen.values())


def _reversed_pairs(possible: Sequence[Fault]) -> list[Hypothesis]:
    """Return pairs of reversed joints: correcting one alone may worsen the fit, as with lengths that turn two axes."""
    reversals = [fault for fault in possible if fault.is_reversal]
    return [pair for pair in itertools.combinations(reversals, 2) if _compatible(pair[:1], pair[1])]


def _compatible(before: Hypothesis, more: Fault) -> bool:
    def may_both(one: Fault) -> bool:
        reversed_and_turned = (one.is_turn and more.is_reversal) or (one.is_reversal and more.is_turn)
        return not (one.subjects & more.subjects) or reversed_and_turned

    return all(may_both(one) for one in before)


def _corrected(samples: Samples, faults: Hypothesis) -> Samples:
    for fault in faults:
        samples = fault.corrected(samples)
    return samples


def _placed(blank: Chain, samples: Samples, part: Integers, hypotheses: Sequence[Hypothesis]) -> list[_Candidate]:
    """Place the nominal rig on a part of the data, corrected for each hypothesis; drop those where that fails."""
    changed = [_corrected(samples, faults).select(part) for faults in hypotheses]
    at_once = ChainData(
        np.concatenate([own.data.readings for own in changed]),
        np.concatenate([own.data.prism for own in changed]),
        np.concatenate([own.data.setup for own in changed]),
    )
    nominal = np.zeros(len(blank))
    in_base_mm = np.split(blank.positions_mm(nominal, at_once), len(hypotheses))
    out = []
    for faults, own, own_mm in zip(hypotheses, changed, in_base_mm, strict=True):
        try:
            start = rough_start(blank, own, nominal, mirrored="let pass", rounds=_PLACING, in_base_mm=own_mm)
        except UnsafeError:  # the corrected positions lie on a line
            continue
        quality = Quality.of(blank, own, start.x, start.misfit_mm)
        out.append(_Candidate(faults, start.placements, start.x, quality))
    return out


def _approached(rig: Rig, samples: Samples, part: Integers, precision: Floats, candidate: _Candidate) -> _Candidate:
    chain = Chain(rig, candidate.placements)
    samples = _corrected(samples, candidate.faults).select(part)
    x = approach(chain, samples, candidate.x, precision=precision, rounds=_APPROACHING)
    return replace(candidate, x=x, quality=Quality.of(chain, samples, x))


def _readings_beyond_limits(rig: Rig, samples: Samples) -> int:
    readings = on_one_turn(rig, dict(zip(rig.joint_names, samples.data.readings.T, strict=True)))
    return sum(int(beyond_limits(joint, readings[joint.name], _SLACK).sum()) for joint in rig.joints)


def _for_raw_data(chain: Chain, candidate: _Candidate) -> Floats | None:
    """Return parameters with turned joints as offsets of the rows that they drive; None if any fault is no offset."""
    x = candidate.x.copy()
    for fault in candidate.faults:
        for joint, turn_deg in fault.turn_deg.items():
            for op in itertools.chain.from_iterable(chain.row_ops):
                for driven, coefficient in op.drive:
                    if driven == joint:
                        if op.parameter < 0:
                            return None
                        x[op.parameter] += coefficient * turn_deg
    return x if all(fault.is_turn for fault in candidate.faults) else None


def _in_words(faults: Hypothesis) -> str:
    return " and ".join(fault.what for fault in faults)


def _size(value_mm: float) -> str:
    return f"{value_mm:.0f}" if value_mm >= 100.0 else f"{value_mm:.2g}"
