"""Units for people: a number as mrad or parts in a thousand, without long rows of zeros."""

from __future__ import annotations

import math

_PREFIXED = {"rad": "rad", "s": "s", "rad/s": "rad/s", "rad/h": "rad/h", "rad/K": "rad/K"}
_PREFIXES = {-3: "m", -6: "\N{MICRO SIGN}", -9: "n"}
_SUPERSCRIPTS = str.maketrans("-0123456789", "\u207b\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079")


def readable_unit(unit: str, reach: float) -> tuple[float, str]:
    """What to multiply numbers by, and the unit that they then have.

    Args:
        unit: of the numbers; `1` for a plain ratio.
        reach: how large they get.
    """
    plain = "" if unit == "1" else unit
    if not math.isfinite(reach) or reach == 0.0 or reach >= 0.1:
        return 1.0, plain
    exponent = 3 * math.floor(math.log10(reach) / 3.0 + 1e-9)
    if unit in _PREFIXED and exponent in _PREFIXES:
        return 1.0 / 10.0**exponent, _PREFIXES[exponent] + unit
    return (
        1.0 / 10.0**exponent,
        f"\N{MULTIPLICATION SIGN}\N{THIN SPACE}10{str(exponent).translate(_SUPERSCRIPTS)} {plain}".rstrip(),
    )
