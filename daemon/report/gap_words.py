"""The gap workflow's answer in words: what its report and the commands say alike."""

from __future__ import annotations

import math
from collections.abc import Sequence

from calibration.gap.result import Gap
from daemon.report.markup import number

_UNLIKELY = 1e-3
_MOST_ODDS = 6.0  # decades


def gap_headline(gap: Gap) -> str:
    """The verdict in one sentence."""
    if gap.verdict == "named":
        return f"The simulation lacked {spoken([(e.family, e.where) for e in gap.effects])}."
    if gap.verdict == "none":
        return "Simulation and measurement agree within the noise."
    if gap.verdict == "indistinguishable":
        one_of = " or ".join(place_name(c.family, c.where) for c in gap.indistinguishable)
        return f"The simulation lacks {one_of}: this data cannot tell which."
    return "The simulation lacks something that no effect of the library explains."


def before_and_after(gap: Gap) -> tuple[float, float, str]:
    """The error without and with the effects, mm, and of which rows: held-out ones where there are any."""
    if gap.held_out is not None:
        return *gap.held_out, "on the held-out file"
    if gap.rounds and not gap.rounds[-1].adopted:
        return gap.rounds[0].held_out_mm, gap.rounds[-1].held_out_mm, "on poses held out in turn"
    return gap.before_mm, gap.after_mm, "on the fixes themselves"


def closed_share(before_mm: float, after_mm: float, noise_mm: float) -> float | None:
    """How much of the gap above the noise floor is closed, 0 to 1; None where there was none."""
    gap_mm2 = before_mm**2 - noise_mm**2
    return min(max((before_mm**2 - after_mm**2) / gap_mm2, 0.0), 1.0) if gap_mm2 > 0.0 else None


def dependence(gap: Gap) -> str:
    """On what the structure depends that no effect of the library explains."""
    subject = "What is left" if gap.effects else "It"
    return f"{subject} depends on this: {gap.description}"


def remaining(gap: Gap) -> str:
    """The structure that is left; where it is hidden in the noise of all rows together, without its size."""
    return f"Structure of {number(gap.remaining_mm)} mm is left" if gap.remaining_mm > 0.0 else "Structure is left"


def place_name(family: str, where: str) -> str:
    """An effect for people."""
    return f"{family.replace('_', ' ')} at {where}"


def spoken(effects: Sequence[tuple[str, str]]) -> str:
    """Effects for people, locations of one family together."""
    by_family: dict[str, list[str]] = {}
    for family, where in effects:
        by_family.setdefault(family, []).append(where)
    return listed([place_name(family, listed(where)) for family, where in by_family.items()])


def odds(log_bayes_factor: float) -> str:
    """Odds against no effect, from a natural logarithm."""
    decades = log_bayes_factor / math.log(10.0)
    if decades > _MOST_ODDS:
        return "over 10\u2076 : 1"
    if decades < -_MOST_ODDS:
        return "1 : over 10\u2076"
    return f"{number(10.0**decades, 2)} : 1" if decades >= 0.0 else f"1 : {number(10.0**-decades, 2)}"


def probability(share: float) -> str:
    """A probability for people: nothing is certain."""
    return "over 99.9 %" if share > 1.0 - _UNLIKELY else "under 0.1 %" if share < _UNLIKELY else f"{100 * share:.1f} %"


def chance(p: float) -> str:
    """The probability of a pattern by chance, for people."""
    return "under 0.1 %" if p < _UNLIKELY else f"{100 * p:.1f} %"


def listed(words: Sequence[str]) -> str:
    """Words as a sentence has them."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}" if words else ""
