"""Scores of the gap workflow's answers against the labels, each with its target."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.stats import binomtest

from daemon.benchmark.trial import Trial

LEVEL = 0.95  # confidence level of Wilson intervals

T = TypeVar("T")


@dataclass(frozen=True)
class Score:
    """A figure of merit and its target.

    Attributes:
        what: name of the figure.
        target: the target in words; "" if there is none.
        value: measured value; NaN if no case counts.
        n: number of cases that it was measured on.
        interval: 95 % Wilson interval of a share; None for other figures.
        met: whether the target is met; None if there is no target or no case counts.
        is_chance: whether chance alone may explain a missed target, as the interval includes it.
    """

    what: str
    target: str
    value: float
    n: int
    interval: tuple[float, float] | None
    met: bool | None
    is_chance: bool = False


def scores(trials: Sequence[Trial]) -> tuple[Score, ...]:
    """Return all figures of merit, with and without a target."""
    single = [t for t in trials if t.kind == "single"]
    strong = [t for t in single if t.size >= 1.0]
    half = [t for t in single if t.size == 0.5]
    one = [t for t in single if t.size == 1.0]
    known = [t for t in trials if t.kind in ("single", "null", "decoy", "pair", "triple", "alias")]
    return (
        *_named("rightly named at >= 1x, separable", strong, 0.98),
        *_named("rightly named at 0.5x, separable", half, 0.95),
        *_named("rightly named at 0.25x, separable", [t for t in single if t.size == 0.25], None),
        _share("wrong name among all named", [t for t in known if t.named], lambda t: t.is_wrong, most=0.01),
        *_no_effect(trials),
        *_sets(single, [t for t in trials if t.kind == "alias"]),
        *_closed(">= 1x", strong, with_bar=True),
        *_closed("0.5x", half, with_bar=False),
        *_strangers(trials),
        _share("two effects, both exact", [t for t in trials if t.kind == "pair"], lambda t: t.is_right, least=0.90),
        _share("three effects, all exact", [t for t in trials if t.kind == "triple"], lambda t: t.is_right),
        *_coefficients(one),
        *_machines([t for t in trials if t.kind == "machine"]),
        *_regimes([t for t in trials if t.kind == "regime"]),
        *_paths([t for t in trials if t.kind == "path"]),
        _share("cases that ended in an error", trials, lambda t: t.verdict == "failed", most=0.0),
        *_seconds(trials),
    )


def _named(what: str, trials: Sequence[Trial], least: float | None) -> Iterable[Score]:
    separable = [t for t in trials if t.separable]
    yield _share(what, separable, lambda t: t.is_right, least=least)
    yield _share("  also at the right place", separable, lambda t: t.is_in_place)
    for poses in dict.fromkeys(t.poses for t in separable):
        yield _share(f"  {poses} poses", [t for t in separable if t.poses == poses], lambda t: t.is_right)
    yield _share("  of all cases, separable or not", trials, lambda t: t.is_right)


def _no_effect(trials: Sequence[Trial]) -> Iterable[Score]:
    for kind, words in (("null", "no effect"), ("decoy", "no effect, decoy columns")):
        own = [t for t in trials if t.kind == kind]
        yield _share(f"{words}: falsely named", own, lambda t: bool(t.named), most=0.005)
        yield _share(f"{words}: any alarm", own, lambda t: t.verdict != "none", most=0.01)


def _sets(single: Sequence[Trial], alias: Sequence[Trial]) -> Iterable[Score]:
    reported = [t for t in single if t.verdict == "indistinguishable"]
    # In one draw of the noise in fifty, even a separable effect lacks the odds for a name; a set is right then.
    told = "truth in a reported set where no name was possible"
    yield _share(told, reported, lambda t: t.is_set_true and not t.plain, least=0.99)
    yield _share("  truth in a set of an inseparable effect", reported, lambda t: t.is_set_true and not t.separable)
    yield _share("  truth in any set", reported, lambda t: t.is_set_true)
    sizes = [len(t.reported_set) for t in (*reported, *alias) if t.reported_set]
    yield _figure("families in a set, mean", sizes, np.mean)
    yield _share("exact aliases: set with the truth and its alias", alias, _alias_told, least=0.99)
    measured = [t for t in (*reported, *alias) if t.measured is not None]
    yield _share("set resolved after 20 proposed poses", measured, lambda t: t.is_resolved, least=0.80)
    yield _share("  of a single effect", [t for t in measured if t.kind == "single"], lambda t: t.is_resolved)
    yield _share("  of exact aliases", [t for t in measured if t.kind == "alias"], lambda t: t.is_resolved)
    yield _share(
        "  where the poses were expected to resolve it", [t for t in measured if t.is_promised], lambda t: t.is_resolved
    )
    yield _share("  sets that 20 poses were not expected to resolve", measured, lambda t: not t.is_promised)


def _alias_told(trial: Trial) -> bool:
    return trial.verdict == "indistinguishable" and trial.reported_set >= set(trial.aliases) and not trial.named


def _closed(words: str, trials: Sequence[Trial], *, with_bar: bool) -> Iterable[Score]:
    shares = [share for t in trials if (share := t.closed) is not None]
    yield _figure(f"held-out gap closed at {words}, median", shares, np.median, least=0.98 if with_bar else None)
    yield _figure(
        f"held-out gap closed at {words}, 10th percentile",
        shares,
        lambda values: np.percentile(values, 10),
        least=0.90 if with_bar else None,
    )


def _strangers(trials: Sequence[Trial]) -> Iterable[Score]:
    outside = [t for t in trials if t.kind == "outside"]
    yield _share("outside the library: misnamed", outside, lambda t: bool(t.named - t.general), most=0.03)
    yield _share("outside the library: right location", outside, lambda t: t.is_located, least=0.85)
    yield _share("outside the library: unidentified", outside, lambda t: t.verdict == "unidentified")
    left_out = [t for t in trials if t.kind == "left_out"]
    misnamed = "a family left out of the library: misnamed"
    yield _share(misnamed, left_out, lambda t: bool(t.named - t.general), most=0.03)
    yield _share("  misnamed or named as a more general family", left_out, lambda t: bool(t.named))
    beside = [t for t in trials if t.kind == "beside"]
    yield _share("with an effect outside the library: rightly named", beside, lambda t: t.is_right)
    yield _share("  misnamed", beside, lambda t: t.is_wrong)


def _coefficients(trials: Sequence[Trial]) -> Iterable[Score]:
    found = [t.coefficient_errors() for t in trials if t.is_in_place]
    errors = [error for error, _ in found if np.isfinite(error)]
    yield _figure("coefficient error at 1x, median of relative errors", errors, np.median, most=0.05)
    inside = [held for _, each in found for held in each]
    yield _share("90 % intervals of coefficients cover", inside, bool, least=0.85, most=0.95)


def _machines(trials: Sequence[Trial]) -> Iterable[Score]:
    told = [one for t in trials for one in t.effects_told]
    yield _share("machine: effects named at their place", told, lambda one: one[1], least=0.85)
    yield _share("  of those that the data distinguish", [o for o in told if o[0].separable], lambda one: one[1])
    for poses in dict.fromkeys(t.poses for t in trials):
        own = [one for t in trials if t.poses == poses for one in t.effects_told]
        yield _share(f"  {poses} poses", own, lambda one: one[1])
    wrong = [is_wrong for t in trials for is_wrong in t.names_told]
    yield _share("machine: wrong name or place among all named", wrong, bool, most=0.03)
    yield _share("machine: held-out error raised", trials, lambda t: t.is_held_out_raised, most=0.0)
    shares = [share for t in trials if (share := t.closed) is not None]
    closed = "machine: held-out gap closed to the unknown structure"
    yield _figure(f"{closed}, median", shares, np.median, least=0.90)
    yield _figure(f"{closed}, 10th percentile", shares, lambda values: np.percentile(values, 10))
    yield _figure("machine: seconds per case, median", [t.answer["seconds"] for t in trials], np.median)


def _regimes(trials: Sequence[Trial]) -> Iterable[Score]:
    yield _share("regime: effect, part and border named", trials, lambda t: t.is_border_right, least=0.85)
    yield _share("  effect and part, any border", trials, lambda t: t.is_regime_named)
    yield _share("  effect, any part", trials, lambda t: all(named for _, named in t.effects_told))
    wrong = [is_wrong for t in trials for is_wrong in t.names_told]
    yield _share("regime: wrong name, place or part among all named", wrong, bool, most=0.02)


def _paths(trials: Sequence[Trial]) -> Iterable[Score]:
    what = "no effect, noise wandering along a path: named, also in a set"
    yield _share(what, trials, lambda t: bool(t.named | t.reported_set), most=0.0)
    yield _share("  any alarm", trials, lambda t: t.verdict != "none")


def _seconds(trials: Sequence[Trial]) -> Iterable[Score]:
    nulls = [t.answer["seconds"] for t in trials if t.kind == "null"]
    yield _figure("seconds per case without effect, median", nulls, np.median)
    every = [t.answer["seconds"] for t in trials]
    yield _figure("seconds per case, median", every, np.median)
    yield _figure("seconds per case, 95th percentile", every, lambda values: np.percentile(values, 95))


def _share(
    what: str, among: Sequence[T], holds: Callable[[T], bool], *, least: float | None = None, most: float | None = None
) -> Score:
    n, k = len(among), sum(holds(one) for one in among)
    if n == 0:
        return Score(what, _target(least, most), float("nan"), 0, None, None)
    interval = binomtest(k, n).proportion_ci(LEVEL, method="wilson")
    low, high = float(interval.low), float(interval.high)
    met = _met(k / n, least, most)
    is_chance = met is False and (least is None or high >= least) and (most is None or low <= most)
    return Score(what, _target(least, most), k / n, n, (low, high), met, is_chance)


def _figure(
    what: str,
    values: Sequence[float],
    summary: Callable[[Sequence[float]], np.floating],
    *,
    least: float | None = None,
    most: float | None = None,
) -> Score:
    value = float(summary(values)) if values else float("nan")
    return Score(what, _target(least, most), value, len(values), None, _met(value, least, most) if values else None)


def _met(value: float, least: float | None, most: float | None) -> bool | None:
    if least is None and most is None:
        return None
    return (least is None or value >= least) and (most is None or value <= most)


def _target(least: float | None, most: float | None) -> str:
    parts = [f"{sign} {bar:g}" for sign, bar in ((">=", least), ("<=", most)) if bar is not None]
    return " and ".join(parts)


@dataclass(frozen=True)
class Tally:
    """Outcomes of the cases of one family and size.

    Attributes:
        family, size: of the cell, over all poses and noises.
        outcomes: outcome, as in `Trial.outcome` -> number of cases.
        mistaken: family that was named or reported in a set instead -> number of cases.
    """

    family: str
    size: float
    outcomes: Counter[str]
    mistaken: Counter[str]


def tallies(trials: Sequence[Trial]) -> tuple[Tally, ...]:
    """Return a tally for each family and size of the cases with a single effect of the library."""
    single = [t for t in trials if t.kind == "single"]
    cells = sorted({(t.effects[0].family, t.size) for t in single})
    return tuple(
        Tally(
            family,
            size,
            Counter(t.outcome for t in own),
            Counter(other for t in own for other in sorted((t.named | t.reported_set) - t.families)),
        )
        for family, size in cells
        if (own := [t for t in single if (t.effects[0].family, t.size) == (family, size)])
    )
