"""Formatting of numbers, units and names for reports and commands."""

from __future__ import annotations

import math
from collections.abc import Sequence

from daemon.commands import HOW_TO_READ_AGAIN, NO_POSE, OTHER_RIG_FILE

INTERVAL_SIGMAS = 2.0  # standard errors of a 95 % interval
DASH = "\N{EN DASH}"
MINUS = "\N{MINUS SIGN}"
PLUS_MINUS = "\N{PLUS-MINUS SIGN}"

_PREFIXED = ("rad", "s", "rad/s", "rad/h", "rad/K")
_PREFIXES = {-3: "m", -6: "\N{MICRO SIGN}", -9: "n"}
_SUPERSCRIPTS = str.maketrans("-0123456789", "\u207b\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079")
_UNLIKELY = 1e-3
_MOST_ODDS = 6.0  # decades


# ---- numbers ---------------------------------------------------------------------------------------------------------


def number(value: float, digits: int = 3) -> str:
    """Format a number with `digits` significant digits and at most three decimals; a dash stands for NaN."""
    if not math.isfinite(value):
        return DASH
    if value == 0:
        return "0"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    most = 3 if abs(value) >= 0.001 else decimals
    return f"{value:.{min(decimals, most)}f}".replace("-", MINUS)


def signed(value: float, digits: int = 3) -> str:
    """Format as `number`, with a plus sign if the value is positive."""
    return ("+" if value > 0 else "") + number(value, digits)


def readable_unit(unit: str, reach: float) -> tuple[float, str]:
    """Choose a unit that avoids long rows of zeros.

    Args:
        unit: current unit; `1` for a plain ratio.
        reach: largest magnitude of the numbers.

    Returns:
        The factor by which to multiply the numbers, and their new unit.
    """
    plain = "" if unit == "1" else unit
    if not math.isfinite(reach) or reach == 0.0 or reach >= 0.1:
        return 1.0, plain
    exponent = 3 * math.floor(math.log10(reach) / 3.0 + 1e-9)
    if unit in _PREFIXED and exponent in _PREFIXES:
        return 1.0 / 10.0**exponent, _PREFIXES[exponent] + unit
    power = str(exponent).translate(_SUPERSCRIPTS)
    return 1.0 / 10.0**exponent, f"\N{MULTIPLICATION SIGN}\N{THIN SPACE}10{power} {plain}".rstrip()


def odds(log_bayes_factor: float) -> str:
    """Format a Bayes factor, given as its natural logarithm, as odds."""
    decades = log_bayes_factor / math.log(10.0)
    if decades > _MOST_ODDS:
        return "over 10\u2076 : 1"
    if decades < -_MOST_ODDS:
        return "1 : over 10\u2076"
    return f"{number(10.0**decades, 2)} : 1" if decades >= 0.0 else f"1 : {number(10.0**-decades, 2)}"


def probability(share: float) -> str:
    """Format a probability; values close to 0 or 1 become `under 0.1 %` or `over 99.9 %`."""
    return "over 99.9 %" if share > 1.0 - _UNLIKELY else "under 0.1 %" if share < _UNLIKELY else f"{100 * share:.1f} %"


def chance(p: float) -> str:
    """Format the probability that a pattern arises by chance."""
    return "under 0.1 %" if p < _UNLIKELY else f"{100 * p:.1f} %"


# ---- names -----------------------------------------------------------------------------------------------------------


def place_name(family: str, where: str) -> str:
    """Return the name of an effect as people read it."""
    return f"{family.replace('_', ' ')} at {where}"


def spoken(effects: Sequence[tuple[str, str]]) -> str:
    """Name effects in one phrase, with the places of each family grouped."""
    by_family: dict[str, list[str]] = {}
    for family, where in effects:
        by_family.setdefault(family, []).append(where)
    return listed([place_name(family, listed(where)) for family, where in by_family.items()])


def listed(words: Sequence[str]) -> str:
    """Join words as in a sentence: `a, b and c`."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}" if words else ""


# ---- sessions --------------------------------------------------------------------------------------------------------


def not_used(session_id: str, reason: str) -> str:
    """Return a sentence on a closed session that calibration does not use, with what to do.

    Args:
        session_id: the session.
        reason: why it is not used, a clause.
    """
    remedy = f"to use it anyway: `rigcal session accept {session_id}`"
    if reason.startswith(OTHER_RIG_FILE):
        remedy = HOW_TO_READ_AGAIN
    elif NO_POSE in reason:
        remedy = "hold another one"
    return f"calibration does not use this session: {reason}; {remedy}"
