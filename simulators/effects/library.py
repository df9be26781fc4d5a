"""Registry of all effects, and parsing of effects as text: `backlash@theta4:width_rad=2e-3,boom_droop@boom`."""

from __future__ import annotations

import importlib
import math
import pkgutil
from collections.abc import Mapping
from dataclasses import fields
from types import ModuleType

from simulators.effects import families, outside, variants
from simulators.effects.base import Effect

# A seed draws from the families in this order. New families follow at the end, so that old cases remain the same.
_SEEDED_ORDER = (
    "joint_compliance",
    "boom_droop",
    "pad_play",
    "backlash",
    "gravity_flip_play",
    "load_hysteresis",
    "encoder_harmonic",
    "joint_error_map",
    "angle_scale",
    "transducer_scale",
    "transducer_quadratic",
    "transducer_index_jump",
    "transducer_cumulative",
    "thermal_expansion",
    "solar_bow",
    "base_settlement",
    "base_step",
    "payload_change",
    "cylinder_compression",
    "leak_down",
    "latency",
    "clock_drift",
    "station_scale",
    "prism_constant",
    "prism_incidence",
    "linkage_coupling",
)


_LARGEST_INTEGER = 1 << 31  # limit of a seed


def _found_in(room: ModuleType) -> dict[str, type[Effect]]:
    """Return the effects defined in a module, or in the modules of a package, sorted by family."""
    names = [f"{room.__name__}.{module.name}" for module in pkgutil.iter_modules(getattr(room, "__path__", []))]
    found: dict[str, type[Effect]] = {}
    for module in [importlib.import_module(name) for name in names] or [room]:
        for kind in vars(module).values():
            if isinstance(kind, type) and issubclass(kind, Effect) and kind.__module__ == module.__name__:
                found[kind.family] = kind
    return dict(sorted(found.items()))


def _in_seeded_order(found: Mapping[str, type[Effect]]) -> dict[str, type[Effect]]:
    return {name: found[name] for name in (*_SEEDED_ORDER, *(n for n in found if n not in _SEEDED_ORDER))}


LIBRARY: Mapping[str, type[Effect]] = _in_seeded_order(_found_in(families))
"""Effects that the library of physical effects contains."""

OUTSIDE: Mapping[str, type[Effect]] = _found_in(outside)
"""Effects that are in no library in any form."""

FAMILIES: Mapping[str, type[Effect]] = {**LIBRARY, **_found_in(variants), **OUTSIDE}
"""All effects."""


def parse_effects(text: str) -> tuple[Effect, ...]:
    """Parse effects `FAMILY@WHERE[:NAME=VALUE[:NAME=VALUE...]]`, separated by commas; "" means none.

    Raises:
        ValueError: a family or coefficient is unknown (the message lists the known ones), or a value is not a finite
            number.
    """
    return tuple(_parse_one(part.strip()) for part in text.split(",") if part.strip())


def _parse_one(part: str) -> Effect:
    head, *settings = part.split(":")
    family, at, where = head.partition("@")
    kind = FAMILIES.get(family)
    if kind is None:
        raise ValueError(f"unknown effect {family!r}; known: {', '.join(sorted(FAMILIES))}")
    if not at or not where:
        place = {"joint": "JOINT", "revolute": "JOINT", "prismatic": "JOINT", "prism": "PRISM"}
        raise ValueError(f"{part!r}: give the place, as in {family}@{place.get(kind.acts_at[0], kind.acts_at[0])}")
    known = {f.name: f.type for f in fields(kind) if f.name != "where"}
    values: dict[str, float | int] = {}
    for setting in settings:
        name, _, value = setting.partition("=")
        if name not in known:
            raise ValueError(f"{part!r}: {family} has no coefficient {name!r}; known: {', '.join(known)}")
        try:
            number = float(value)
        except ValueError:
            raise ValueError(f"{part!r}: {value!r} is not a number") from None
        if not math.isfinite(number):
            raise ValueError(f"{part!r}: {value!r} is not a finite number")
        if known[name] == "int" and not (number.is_integer() and abs(number) <= _LARGEST_INTEGER):
            raise ValueError(f"{part!r}: {value!r} is not a whole number up to {_LARGEST_INTEGER}")
        values[name] = int(number) if known[name] == "int" else number
    return kind(where=where, **values)
