"""The rules there are, every one in every file of `daemon/alarms/rules`, and the page that is made of them."""

from __future__ import annotations

import importlib
import pkgutil
import sys
from functools import cache

from daemon.alarms import rules
from daemon.alarms.alarm import Rule

_HEAD = """# Alarms

What is wrong, since when, and what to do: `rigcal alarms` shows the active ones, `rigcal alarms --all` those that are
over as well; `rigcal status` begins with them. Each is a line in the log when it is raised (warning or error) and when
it is over (info), and a row of the store's table `alarms`.

A *critical* alarm: data are lost, or cannot be used. A *warning*: measuring goes on, and someone should look.

Alarms are raised and cleared by what is known at the moment, once a second; nobody acknowledges them. One that stands
when rigcal is stopped goes on, with its old time, if its reason is still there 15 s after the next start.

This page is made from the rules in `daemon/alarms/rules`: `python -m daemon.alarms.library > docs/alarms.md`.
"""


@cache
def library() -> tuple[Rule, ...]:
    """Return all rules, by file and in the order of each file."""
    found: dict[str, Rule] = {}
    for name in sorted(module.name for module in pkgutil.iter_modules(rules.__path__)):
        for value in vars(importlib.import_module(f"{rules.__name__}.{name}")).values():
            if isinstance(value, Rule):
                assert value.kind not in found, f"two rules are called {value.kind}"
                found[value.kind] = value
    return tuple(found.values())


def page() -> str:
    """Return the text of docs/alarms.md: `python -m daemon.alarms.library > docs/alarms.md` writes it."""
    sections = (_section(rule) for rule in sorted(library(), key=lambda rule: rule.kind))
    return "\n".join((_HEAD, *sections))


def _section(rule: Rule) -> str:
    return f"## {rule.kind}\n\n*{rule.severity.capitalize()}.* {rule.meaning}\n\n**What to do:** {rule.remedy}\n"


if __name__ == "__main__":
    sys.stdout.write(page())
