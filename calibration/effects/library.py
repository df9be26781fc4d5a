"""All effect families: every file of `calibration/effects/families`."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from functools import cache
from types import MappingProxyType

from calibration.effects import families
from calibration.effects.base import Family
from calibration.rig.description import Rig


@cache
def library() -> Mapping[str, Family]:
    """Return name -> family, in alphabetical order."""
    names = sorted(module.name for module in pkgutil.iter_modules(families.__path__))
    found: dict[str, Family] = {}
    for name in names:
        family: Family = importlib.import_module(f"{families.__name__}.{name}").FAMILY
        assert family.name not in found, f"two effects are called {family.name}"
        found[family.name] = family
    return MappingProxyType(found)


def parse_effects(text: str, rig: Rig) -> tuple[tuple[str, str], ...]:
    """Parse `FAMILY@WHERE,...`.

    Args:
        text: the text.
        rig: the rig, which determines the possible places.

    Returns:
        (family, where) of each effect, in the order of the text.

    Raises:
        ValueError: a family is unknown, a place does not exist on this rig, or an effect is named twice; the message
            lists the valid choices.
    """
    found: list[tuple[str, str]] = []
    for part in text.split(","):
        name, _, where = (word.strip() for word in part.strip().partition("@"))
        if name not in library():
            raise ValueError(f"effect {name!r} is unknown; there are {', '.join(library())}, as FAMILY@WHERE")
        places = library()[name].places(rig)
        if where not in places:
            there = f"may be at {', '.join(places)}" if places else "has no place"
            what = f"{name}@{where}" if where else name
            raise ValueError(f"{what}: {name} {there} in rig {rig.name!r}")
        if (name, where) in found:
            raise ValueError(f"{name}@{where} is named twice")
        found.append((name, where))
    return tuple(found)
