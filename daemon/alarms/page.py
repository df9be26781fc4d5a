"""docs/alarms.md, made from the rules: `python -m daemon.alarms.page > docs/alarms.md`."""

from __future__ import annotations

import sys

from daemon.alarms.alarm import Rule
from daemon.alarms.library import library

_HEAD = """# Alarms

What is wrong, since when, and what to do: `rigcal alarms` shows the active ones, `rigcal alarms --all` those that are
over as well; `rigcal status` begins with them. Each is a line in the log when it is raised (warning or error) and when
it is over (info), and a row of the store's table `alarms`.

A *critical* alarm: data are lost, or cannot be used. A *warning*: measuring goes on, and someone should look.

Alarms are raised and cleared by what is known at the moment, once a second; nobody acknowledges them. One that stands
when rigcal is stopped goes on, with its old time, if its reason is still there 15 s after the next start.

This page is made from the rules in `daemon/alarms/rules`: `python -m daemon.alarms.page > docs/alarms.md`.
"""


def page() -> str:
    """The page."""
    sections = (_section(rule) for rule in sorted(library(), key=lambda rule: rule.kind))
    return "\n".join((_HEAD, *sections))


def _section(rule: Rule) -> str:
    return f"## {rule.kind}\n\n*{rule.severity.capitalize()}.* {rule.meaning}\n\n**What to do:** {rule.remedy}\n"


if __name__ == "__main__":
    sys.stdout.write(page())
