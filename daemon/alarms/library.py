"""The library of alarm rules: all rules in all files of `daemon/alarms/rules`."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from daemon.alarms import rules
from daemon.alarms.alarm import Rule


@cache
def library() -> tuple[Rule, ...]:
    """Return all rules, sorted by file and then in the order within each file."""
    found: dict[str, Rule] = {}
    for name in sorted(module.name for module in pkgutil.iter_modules(rules.__path__)):
        for value in vars(importlib.import_module(f"{rules.__name__}.{name}")).values():
            if isinstance(value, Rule):
                assert value.kind not in found, f"two rules are called {value.kind}"
                found[value.kind] = value
    return tuple(found.values())
