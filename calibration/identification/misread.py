"""Data that the rig file reads wrongly: which supposition makes them fit, and what to call it.

A reversed sign, another unit, exchanged columns or an encoder mounted turned is a basin of its own that no search
within build tolerances reaches; where a search does reach one, it is a wrong model that looks right on a part of the
work volume. So each is supposed in turn: the readings are changed as the supposition says, the base is placed anew and
the parameters are brought near their optimum. Two or three mistakes at once may show no gain before all are right;
the few best suppositions are therefore carried on (beam search).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.errors import UnsafeError
from calibration.identification.approach import approach
from calibration.identification.samples import Integers, Samples
from calibration.identification.start import rough_start
from calibration.identification.subset import drawn
from calibration.identification.suppositions import Supposition, conceivable_mistakes
from calibration.kinematics import Chain, ChainData, Placement
from calibration.limits import beyond_limits, on_one_turn
from calibration.observations import Floats
from calibration.rig import Rig

_ROWS = 120
_TRIMMED = 0.75
_APPROACHING = 40  # rounds
_PLACING = 20  # rounds; a rough place tells suppositions apart
_CARRIED = 6
_TOGETHER = 32  # suppositions whose positions are computed at once
_APPROACHED = 10  # of the best roughly placed suppositions of a round
_MUCH = 0.5  # of the misfit before; a further supposition that gains less says nothing
_EXPLAINS = 0.25  # of the misfit as given, or less: an explanation
_SETTLES = 0.1  # likewise, and no more than needs no explanation: nothing further need be supposed
_SLACK = 0.05  # of a joint's range: its limits are no more exact
_ALIKE = 1.5  # times the least misfit: as good an explanation


@dataclass(frozen=True)
class Quality:
    """How well a model explains data.

    Attributes:
        misfit_mm: mean of the smaller three quarters of every prism's 3-D errors: outliers do not count, a wrong prism
            does.
        pull: RMS of the corrections in build tolerances.
    """

    misfit_mm: float
    pull: float

    @classmethod
    def of(cls, chain: Chain, samples: Samples, x: Floats) -> Quality:
        """Of a chain with parameters `x` (p,)."""
        misfit_mm = np.linalg.norm(samples.position_mm - chain.positions_mm(x, samples.data), axis=1)
        return cls.at(chain, samples, x, misfit_mm)

    @classmethod
    def at(cls, chain: Chain, samples: Samples, x: Floats, misfit_mm: Floats) -> Quality:
        """Likewise, where the 3-D misfits (m,) are known."""
        of_prisms = (np.sort(misfit_mm[samples.data.prism == prism]) for prism in np.unique(samples.data.prism))
        used = np.concatenate([own[: math.ceil(_TRIMMED * len(own))] for own in of_prisms])
        tolerated = np.isfinite(chain.prior_sigma)
        pull = x[tolerated] / chain.prior_sigma[tolerated]
        return cls(float(used.mean()), math.sqrt(float(pull @ pull) / max(1, len(pull))))

    def much_better_than(self, other: Quality) -> bool:
        """A much smaller misfit, or one as small with much smaller corrections."""
        alike = self.misfit_mm < _ALIKE * other.misfit_mm
        return self.misfit_mm < _MUCH * other.misfit_mm or (alike and self.pull < _MUCH * other.pull)


@dataclass(frozen=True)
class Explanation:
    """What makes misfitting data fit.

    Attributes:
        suppositions: all of them together.
        others: sets of suppositions that explain the data about as well.
        chain: with the bases placed on the data so changed.
        x: (p,) parameters near the optimum there, for the data as they are; None where no parameters can stand for
            the suppositions.
        before, after: how well the data fit as given, and so changed.
    """

    suppositions: tuple[Supposition, ...]
    others: tuple[tuple[Supposition, ...], ...]
    chain: Chain
    x: Floats | None
    before: Quality
    after: Quality

    @property
    def what(self) -> str:
        """The mistakes, in words."""
        return " and ".join(s.what for s in self.suppositions)

    def __str__(self) -> str:
        doubt = "".join(f"; or {' and '.join(s.what for s in other)}, which fits as well" for other in self.others)
        remedies = ", and ".join(s.remedy for s in self.suppositions)
        gain = f"{_size(self.after.misfit_mm)} mm are left in place of {_size(self.before.misfit_mm)} mm"
        if self.after.misfit_mm > _MUCH * self.before.misfit_mm:
            gain = (
                f"the corrections are {_size(self.after.pull)} build tolerances in place of {_size(self.before.pull)}"
            )
        return f"{self.what}: taken so, {gain}{doubt}; {remedies}"


@dataclass(frozen=True)
class _Trial:
    suppositions: tuple[Supposition, ...]
    placements: Mapping[str, Placement]
    x: Floats
    quality: Quality


def explain(
    chain: Chain,
    samples: Samples,
    *,
    precision: Floats,
    before: Quality,
    tolerated_mm: float,
    at_once: int,
) -> Explanation | None:
    """Look for mistakes that explain why data do not fit, or fit with a model far from the rig file only.

    Args:
        chain: kinematics.
        samples: the rows in question.
        precision: (p,) 1 / sigma^2 of the prior that the parameters are held by.
        before: the best fit to them as they are given.
        tolerated_mm: misfit that needs no explanation.
        at_once: how many mistakes to suppose together at most.
    """
    blank = Chain(chain.rig, {setup: Placement.identity() for setup in chain.setups})
    # A part of the samples is enough to tell suppositions apart.
    part = drawn(samples.data, samples.position_mm, _ROWS, 0)
    conceivable = list(conceivable_mistakes(blank, samples))
    carried: list[tuple[Supposition, ...]] = [()]
    best: list[_Trial] = []
    least = before
    for number in range(at_once):
        sets = _extended(carried, conceivable)
        if number == 0 and at_once > 1:
            sets += _reversed_pairs(conceivable)
        together = [sets[begin : begin + _TOGETHER] for begin in range(0, len(sets), _TOGETHER)]
        rough = [trial for some in together for trial in _placed(blank, samples, part, some)]
        rough.sort(key=lambda t: t.quality.misfit_mm)
        near = [_approached(chain.rig, samples, part, precision, trial) for trial in rough[:_APPROACHED]]
        near.sort(key=lambda t: t.quality.misfit_mm)
        as_good = [t for t in near if t.quality.misfit_mm < _ALIKE * near[0].quality.misfit_mm]
        as_good.sort(key=lambda t: t.quality.pull)
        if as_good and as_good[0].quality.much_better_than(least):
            least = as_good[0].quality
            best = [t for t in as_good if t.quality.pull < _ALIKE * least.pull]
        if best and least.misfit_mm < min(_SETTLES * before.misfit_mm, tolerated_mm):
            break
        carried = list(dict.fromkeys(t.suppositions for t in (*near[: _CARRIED // 2], *rough)))[:_CARRIED]
    if not best or not _explains(least, before, tolerated_mm):
        return None
    # As few mistakes as may be; what keeps to the limits of the joints is said first.
    fewest = min(len(trial.suppositions) for trial in best)
    best = [trial for trial in best if len(trial.suppositions) == fewest]
    best.sort(key=lambda trial: _beyond_limits(chain.rig, samples, trial.suppositions))
    first = best[0]
    others = tuple(t.suppositions for t in best[1:])
    chain = Chain(chain.rig, first.placements)
    return Explanation(first.suppositions, others, chain, _for_raw_data(chain, first), before, least)


def _beyond_limits(rig: Rig, samples: Samples, suppositions: tuple[Supposition, ...]) -> int:
    """How many readings are beyond the limits of their joints once they are changed as supposed."""
    samples = _applied(samples, suppositions)
    readings = on_one_turn(rig, dict(zip(rig.joint_names, samples.data.readings.T, strict=True)))
    return sum(int(beyond_limits(joint, readings[joint.name], _SLACK).sum()) for joint in rig.joints)


def _explains(after: Quality, before: Quality, tolerated_mm: float) -> bool:
    """Whether little is left of the misfit, or of the corrections where the misfit was tolerable already."""
    if before.misfit_mm < tolerated_mm:
        return after.pull < _MUCH * before.pull
    return after.misfit_mm < _EXPLAINS * before.misfit_mm


def _extended(
    carried: Sequence[tuple[Supposition, ...]], conceivable: Sequence[Supposition]
) -> list[tuple[Supposition, ...]]:
    """Every set with one more supposition, each set once."""
    seen: dict[frozenset[str], tuple[Supposition, ...]] = {}
    for before in carried:
        for more in conceivable:
            together = (*before, more)
            if _compatible(before, more):
                seen.setdefault(frozenset(s.what for s in together), together)
    return list(seen.values())


def _reversed_pairs(conceivable: Sequence[Supposition]) -> list[tuple[Supposition, ...]]:
    """Two joints the other way round: either alone may be worse than none, as lengths that turn two axes about are."""
    reversals = [s for s in conceivable if s.is_reversal]
    return [pair for pair in itertools.combinations(reversals, 2) if _compatible(pair[:1], pair[1])]


def _compatible(before: Sequence[Supposition], more: Supposition) -> bool:
    def may_both(one: Supposition) -> bool:
        reversed_and_turned = (one.is_turn and more.is_reversal) or (one.is_reversal and more.is_turn)
        return not (one.subjects & more.subjects) or reversed_and_turned

    return all(may_both(one) for one in before)


def _applied(samples: Samples, suppositions: Sequence[Supposition]) -> Samples:
    for supposition in suppositions:
        samples = supposition.applied(samples)
    return samples


def _placed(blank: Chain, samples: Samples, part: Integers, sets: Sequence[tuple[Supposition, ...]]) -> list[_Trial]:
    """The nominal rig placed on a part of the data, changed as each set supposes; without those where it cannot be."""
    changed = [_applied(samples, suppositions).select(part) for suppositions in sets]
    at_once = ChainData(
        np.concatenate([own.data.readings for own in changed]),
        np.concatenate([own.data.prism for own in changed]),
        np.concatenate([own.data.setup for own in changed]),
    )
    nominal = np.zeros(len(blank))
    in_base_mm = np.split(blank.positions_mm(nominal, at_once), len(sets))
    out = []
    for suppositions, own, own_mm in zip(sets, changed, in_base_mm, strict=True):
        try:
            start = rough_start(blank, own, nominal, mirrored="let pass", rounds=_PLACING, in_base_mm=own_mm)
        except UnsafeError:  # positions that so changed lie on a line
            continue
        quality = Quality.at(blank, own, start.x, start.misfit_mm)
        out.append(_Trial(suppositions, start.placements, start.x, quality))
    return out


def _approached(rig: Rig, samples: Samples, part: Integers, precision: Floats, trial: _Trial) -> _Trial:
    chain = Chain(rig, trial.placements)
    samples = _applied(samples, trial.suppositions).select(part)
    x = approach(chain, samples, trial.x, precision=precision, rounds=_APPROACHING)
    return replace(trial, x=x, quality=Quality.of(chain, samples, x))


def _for_raw_data(chain: Chain, trial: _Trial) -> Floats | None:
    """Turned joints as offsets of the rows that they drive; None for what offsets cannot stand for."""
    x = trial.x.copy()
    for supposition in trial.suppositions:
        for joint, turn_deg in enumerate(supposition.turn_deg):
            for op in itertools.chain.from_iterable(chain.row_ops):
                for driven, coefficient in op.drive:
                    if driven == joint and turn_deg:
                        if op.parameter < 0:
                            return None
                        x[op.parameter] += coefficient * turn_deg
    return x if all(s.is_turn for s in trial.suppositions) else None


def _size(value_mm: float) -> str:
    return f"{value_mm:.0f}" if value_mm >= 100.0 else f"{value_mm:.2g}"
