"""A draft of a rig file: sections with remarks, written as TOML."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from calibration.rig.description import Convention, Rig, parse_rig
from calibration.rig.toml import quoted

_ASSUMED = """\
[tolerances]            # assumed, 1 sigma: how far the machine may be from these numbers
length_mm = 1.0
angle_deg = 0.2
beta_deg = 0.1
prism_mm = 3.0

[station]               # assumed: random errors of the instrument
angle_sigma_arcsec = 1.0
distance_sigma_mm = 0.1
distance_sigma_ppm = 1.0
"""
LIMITS_ASSUMED = "limits assumed"  # the remark of a joint
SIGMA = {"revolute": 0.002, "prismatic": 0.02}  # deg and mm; assumed, as the imported descriptions do not give it


@dataclass(frozen=True)
class Section:
    """One table of an array of tables: its keys in order, and a remark for its first line."""

    keys: Mapping[str, object]
    remark: str = ""


@dataclass
class Draft:
    """A rig file except tolerances and station, which are assumed because other descriptions do not have them.

    Attributes:
        name: name of the machine.
        convention: convention of its rows.
        source: name of the imported file, for the first line of the rig file.
        notes: sentences about what was assumed and what was left out.
        values_assumed: clauses about values that the imported file does not give.
        sections: `joint`, `row`, `prism` and `mass` -> tables.
    """

    name: str
    convention: Convention
    source: str
    notes: list[str] = field(default_factory=list)
    values_assumed: list[str] = field(default_factory=list)
    sections: dict[str, list[Section]] = field(
        default_factory=lambda: {name: [] for name in ("joint", "row", "prism", "mass")}
    )

    def add(self, section: str, keys: Mapping[str, object], remark: str = "") -> None:
        """Add a table to `[[section]]`."""
        self.sections[section].append(Section(keys, remark))

    @property
    def assumed(self) -> str:
        """A sentence that lists what was assumed because the imported description does not have it."""
        joints = [str(t.keys["name"]) for t in self.sections["joint"] if LIMITS_ASSUMED in t.remark]
        limits = f"the limits of {', '.join(joints)}, " if joints else ""
        always = f"the random errors of readings (sigma), {limits}the build tolerances and the station"
        return f"Assumed: {'; '.join((always, *self.values_assumed))}."

    def text(self) -> str:
        """Return the TOML."""
        return "\n".join(self._lines()) + "\n"

    def rig(self) -> Rig:
        """Return the rig that the text describes; raise RigError if its parts do not fit together."""
        return parse_rig(self.text(), self.name)

    def _lines(self) -> Iterator[str]:
        yield f"# Made by `rigcal rig import` from {self.source}."
        yield from (f"# {note}" for note in self.notes)
        yield ""
        yield f"name = {_value(self.name)}"
        yield f'convention = "{self.convention}"'
        yield "gravity = [0, 0, -1]    # assumed: the base's z is up"
        yield ""
        yield _ASSUMED
        for name, tables in self.sections.items():
            for number, table in enumerate(tables, 1):
                remark = f"{number}: {table.remark}".removesuffix(": ") if name == "row" else table.remark
                yield f"[[{name}]]" + (f"  # {remark}" if remark else "")
                yield from (f"{key} = {_value(value)}" for key, value in table.keys.items())
                yield ""


def free_name(wanted: str, taken: Collection[str]) -> str:
    """Return a name that is valid in a rig file (letters, digits, underscores) and not in `taken`.

    Args:
        wanted: any name; the result is as similar to it as possible.
        taken: names that are in use.
    """
    plain = re.sub(r"[^A-Za-z0-9]+", "_", wanted).strip("_")
    plain = plain if plain[:1].isalpha() else f"n_{plain}".rstrip("_")
    number, name = 2, plain
    while name in taken:
        name, number = f"{plain}_{number}", number + 1
    return name


def _value(value: object) -> str:
    """Return a value formatted as TOML."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_value(item)}" for key, item in value.items()) + " }"
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, Sequence):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return repr(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
    return str(value)
