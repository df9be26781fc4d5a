"""Plain words for names of the code: constants, effects, coefficients, methods, units."""

from __future__ import annotations

import re
from functools import cache

from calibration.rig.description import Joint

RESIDUALS = {
    "gp": "Gaussian process",
    "rbfn": "radial basis function network",
    "lightgbm": "gradient-boosted trees",
    "chain": "network followed by trees",
    "table": "table of corrections",
    "rbfn-paper": "published network",
}
METHODS = {
    "nominal": "drawings alone",
    "default": "rigcal",
    "pde-paper": "published differential evolution",
    "km": "published kinematic calibration",
    "skcm": "published calibration of kinematics and stiffness",
    "rbf-tcm": "published calibration followed by a network",
    "effects": "no learned residual",
}
_UNITS = {
    "deg": "degrees",
    "rad": "radians",
    "mrad": "milliradians",
    "\N{MICRO SIGN}rad": "microradians",
    "mrad/(kN m)": "milliradians per kilonewton metre",
    "rad/(N m)": "radians per newton metre",
    "degC": "degrees Celsius",
    "s": "seconds",
    "ms": "milliseconds",
    "h": "hours",
    "%": "percent",
}
_CONSTANTS = {
    "a": "length along x",
    "d": "length along z",
    "b": "length along y",
    "alpha": "twist",
    "theta": "zero angle",
    "beta": "tilt",
}
_TURNS = {"rx": "turn about x", "ry": "turn about y", "rz": "turn about z"}
_ROW = re.compile(r"\brow(\d+)\.(alpha|theta|beta|a|d|b)\b")
_PRISM = re.compile(r"\bprism\.(\w+)\.([xyz])\b")
_BASE = re.compile(r"\bbase\[([^\]]*)\]\.(r?[xyz])\b")
_EFFECT = re.compile(r"\b([a-z]+(?:_[a-z]+)*)@(\w+)")
_UNIT_OF_A_NAME = re.compile(
    r"_?(rad_per_s|rad_per_h|rad_per_Nm2?|rad_per_K|mm_per_m|mm_per_bar|mm_per_h|per_K|per_N|rad|mm|deg|s|ppm|kg)$"
)


def unit_words(unit: str) -> str:
    """Return a unit in words if only programs or specialists use its symbol; millimetres stay mm."""
    return _UNITS.get(unit, unit)


def joint_words(joint: Joint | str) -> str:
    """Name a joint's reading: as an angle or a length if its kind is known."""
    if isinstance(joint, str):
        return f"joint {joint}"
    return f"{'angle' if joint.kind == 'revolute' else 'length'} {joint.name}"


def constant_words(name: str) -> str:
    """Name a constant of the kinematic model: `row4.theta` is `row 4, zero angle`."""
    text = _ROW.sub(lambda found: f"row {found[1]}, {_CONSTANTS[found[2]]}", name)
    text = _PRISM.sub(lambda found: f"prism {found[1]}, offset along {found[2]}", text)
    return _BASE.sub(_base_words, text)


def _base_words(found: re.Match[str]) -> str:
    what = _TURNS.get(found[2], f"place along {found[2]}")
    return f"base at set-up {found[1]}, {what}" if found[1] else f"base, {what}"


def coefficient_words(name: str) -> str:
    """Name a coefficient of an effect without its unit: `width_rad` is `width`."""
    plain = _UNIT_OF_A_NAME.sub("", name).replace("_", " ").strip()
    return plain or "coefficient"


def residual_words(kind: str | None) -> str:
    """Name a learned residual."""
    return "none" if kind is None else RESIDUALS.get(kind, kind)


def method_words(method: str) -> str:
    """Name a row of a comparison: a method, or a residual on rigcal's own kinematics."""
    return METHODS.get(method) or RESIDUALS.get(method, method)


def in_words(sentence: str) -> str:
    """Replace code names in a sentence by plain words; names of columns and commands stay."""
    text = constant_words(sentence)
    text = _EFFECT.sub(lambda found: f"{found[1].replace('_', ' ')} at {found[2]}", text)
    return _code_names().sub(lambda found: _spoken(found[0]), text)


def _spoken(name: str) -> str:
    return RESIDUALS[name] if name in RESIDUALS else name.replace("_", " ")


@cache
def _code_names() -> re.Pattern[str]:
    from calibration.effects.library import library

    families = [family for family in library() if "_" in family]
    learners = [name for name in RESIDUALS if name not in ("table", "chain")]  # these two are ordinary words
    names = sorted([*families, *learners], key=len, reverse=True)
    return re.compile(rf"(?<![\w`-])(?:{'|'.join(map(re.escape, names))})(?![\w`-])")
