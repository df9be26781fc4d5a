"""docs/reference/effects.md: every effect of the library."""

from __future__ import annotations

from collections.abc import Iterator

from calibration.effects.base import Family, JointFamily
from calibration.effects.library import library
from calibration.rig.description import shipped_rig
from docs.references.markdown import table

_HEAD = """# Effects

Known physical causes of errors that `rigcal gap` can name, and that `calibrate --effects FAMILY@WHERE` adds.
*Plausible* is the expected standard deviation of a coefficient; a value beyond the bounds is no evidence for the
effect. `rigcal effects NAME --rig RIG` shows places and sizes for your rig. [The gap between model and
machine](../explanation/gap.md#the-library) explains how an effect is selected, and [Extend
rigcal](../how-to/extend.md) how to add one.

This page is generated from the code: `python -m docs.references`.
"""


def page() -> str:
    """Return the text of docs/reference/effects.md."""
    index = table(("effect", "acts at", "summary"), (_line(family) for family in library().values()))
    sections = (line for family in library().values() for line in _section(family))
    return "\n".join((_HEAD, *index, "", *sections)).rstrip() + "\n"


def _line(family: Family) -> tuple[str, str, str]:
    return f"[`{family.name}`](#{family.name})", _acts_at(family), _sentences(family)[0]


def _acts_at(family: Family) -> str:
    if isinstance(family, JointFamily):
        return f"a {family.kind} joint"
    places = family.places(shipped_rig("swdt82"))
    return ", ".join(f"`{place}`" for place in places) or "no place of the boom"


def _section(family: Family) -> Iterator[str]:
    """Yield the section of a family, from its docstring and attributes."""
    yield from (f"## {family.name}", "", *(f"{text}\n" for text in _sentences(family)))
    places = family.places(shipped_rig("swdt82"))
    facts = {
        "equation": f"`{family.equation}`",
        "source": family.source,
        "can be confused with": ", ".join(f"[`{name}`](#{name})" for name in family.confused_with) or "nothing",
        "revealed by": family.revealed_by,
        "needs": _needs(family, places),
        "places in `swdt82`": ", ".join(f"`{place}`" for place in places) or "none",
    }
    facts = {name: text if name == "equation" else text.replace("<", "&lt;") for name, text in facts.items() if text}
    yield from table(("", ""), ((f"**{name}**", text) for name, text in facts.items()))
    yield ""
    if family.fixed:
        rows = ((f"`{c.name}`", c.unit, f"{c.sigma:g}", f"{c.lower:g} to {c.upper:g}") for c in family.fixed)
        yield from table(("coefficient", "unit", "plausible", "bounds"), rows)
    else:
        yield f"Its coefficients depend on the machine: `rigcal effects {family.name} --rig RIG` lists them."
    yield ""


def _needs(family: Family, places: tuple[str, ...]) -> str:
    """Return the inputs of a family in addition to joint readings; a joint's name is replaced by `<joint>`."""
    if not places:
        return ""
    needs = family.needs(places[0])
    return needs.replace(f"{places[0]}_", "<joint>_") if isinstance(family, JointFamily) else needs


def _sentences(family: Family) -> list[str]:
    """Return the paragraphs of a family's docstring, up to its attributes."""
    text = (type(family).__doc__ or "").partition("Attributes:")[0]
    return [" ".join(paragraph.split()) for paragraph in text.strip().split("\n\n")]
