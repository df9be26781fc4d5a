"""docs/reference/rig-keys.md: every column of observations and every key of rig files."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from calibration.rig.channels import (
    AnyChannel,
    CanopenChannel,
    Cia404Analogue,
    Cia406Encoder,
    Cia406Linear,
    DbcSignal,
    RawSignal,
    Signal,
)
from calibration.rig.columns import READ, WRITTEN, Column
from calibration.rig.description import FixedTransform, Joint, Mass, Prism, Rig, Row, Station, Tolerances
from docs.references.markdown import table

_HEAD = """# Columns and rig keys

Every column of observations and every key of a rig file. Their use is described in [files and outputs](formats.md) and
[rig files](../how-to/rig-files.md).

This page is generated from the code: `python -m docs.references`.

## Columns of observations

`<joint>` is the name of a joint in the rig file, and `<signal>` the name of a channel or a signal, or any other name.
Any other column of numbers is not used, and a warning explains how to make it usable.
"""
_WRITTEN = """
## Columns that rigcal adds

`rigcal predict` adds predictions (and intervals with `--intervals`), `rigcal inverse` adds the closure, and a plan has
`fixes`. These columns are ignored in input data.
"""
_KEYS = """
## Keys of a rig file

A *name* begins with a letter and consists of letters, digits and underscores.
"""
_TABLES: tuple[tuple[str, type[BaseModel]], ...] = (
    ("The file", Rig),
    ("`[tolerances]`", Tolerances),
    ("`[station]`", Station),
    ("`[[joint]]`", Joint),
    ("`[[row]]`", Row),
    ("`before` of a `[[row]]`", FixedTransform),
    ("`[[prism]]`", Prism),
    ("`[[mass]]`", Mass),
    ("`[[signal]]`", Signal),
    ("`[[channel]]`", AnyChannel),
    ("`[[channel]]`: CANopen devices, `cia406_encoder`, `cia406_linear` and `cia404`", CanopenChannel),
    ('`device = "cia406_encoder"`', Cia406Encoder),
    ('`device = "cia406_linear"`', Cia406Linear),
    ('`device = "cia404"`', Cia404Analogue),
    ('`device = "dbc"`', DbcSignal),
    ('`device = "raw"`', RawSignal),
)
_ENDINGS = ("mm", "m", "deg", "kg", "s", "ms", "nm", "arcsec", "ppm", "counts", "bits", "hz")
_UNITS = {  # units of keys whose names do not end with the unit; most depend on the kind of the joint
    "limits": "deg or mm",
    "sigma": "deg or mm",
    "resolution": "deg or mm",
    "linearity": "deg or share",
    "max_rate": "deg/s or mm/s",
    "max_speed_m_s": "m/s",
}
_WORDS = {float: "number", int: "whole number", str: "text", bool: "true or false", Path: "path"}
_ENTRY = re.compile(r"        (\w+(?:, \w+)*): (.+)")


def page() -> str:
    """Return the text of docs/reference/rig-keys.md."""
    tables = itertools.chain.from_iterable(_keys(title, model) for title, model in _TABLES)
    columns = (*_columns(READ, needed=True), _WRITTEN, *_columns(WRITTEN, needed=False))
    return "\n".join((_HEAD, *columns, _KEYS, *tables)).rstrip() + "\n"


def _columns(columns: Iterable[Column], *, needed: bool) -> Iterator[str]:
    header = ("column", "unit", "meaning", *(("needed",) if needed else ()))
    yield from table(header, ((f"`{c.name}`", c.unit, c.meaning, c.need)[: len(header)] for c in columns))


def _keys(title: str, model: type[BaseModel]) -> Iterator[str]:
    """Yield the section of a TOML table: the keys of the model itself; inherited keys have sections of their own."""
    yield f"### {title}"
    yield ""
    yield from keys(model, _own_fields(model))


def keys(model: type[BaseModel], fields: Mapping[str, FieldInfo]) -> Iterator[str]:
    """Yield lines that describe keys of a TOML table: the model's first paragraph, and a row for each key.

    Args:
        model: its docstring and those of its bases describe each key under `Attributes:`.
        fields: name -> field of each key to list.
    """
    yield " ".join(str(model.__doc__).split("\n\n")[0].split())
    yield ""
    told = _told(model)
    rows = (
        (f"`{field.alias or name}`", _type(field), _unit(name), _default(field), told[name])
        for name, field in fields.items()
    )
    yield from table(("key", "type", "unit", "default", "meaning"), rows)
    yield ""


def _own_fields(model: type[BaseModel]) -> Mapping[str, FieldInfo]:
    """Return the fields of a model without those that have sections of their own."""
    elsewhere = next((base for base in model.__mro__[1:] if base in (AnyChannel, CanopenChannel)), None)
    if elsewhere is None:
        return model.model_fields
    return {name: model.model_fields[name] for name in model.__annotations__ if name != "device"}


def _told(model: type[BaseModel]) -> dict[str, str]:
    """Return attribute -> description, from the docstrings of a model and its base classes."""
    found: dict[str, str] = {}
    for base in reversed(model.__mro__):
        names: list[str] = []
        for line in str(base.__doc__).partition("Attributes:\n")[2].splitlines():
            entry = _ENTRY.fullmatch(line)
            if entry:
                names = entry[1].split(", ")
                found |= dict.fromkeys(names, entry[2])
            elif line.startswith(" " * 12):
                found |= {name: f"{found[name]} {line.strip()}" for name in names}
    return found


def _type(field: FieldInfo) -> str:
    text = _words(field.annotation)
    above = next((rule.gt for rule in field.metadata if isinstance(rule, Gt)), None)
    least = next((rule.ge for rule in field.metadata if isinstance(rule, Ge)), None)
    most = next((rule.le for rule in field.metadata if isinstance(rule, Le)), None)
    if any(getattr(rule, "pattern", None) for rule in field.metadata):  # the only pattern in use
        return "name"
    if above is not None:
        return f"{text} above {above}" if most is None else f"{text} above {above}, at most {most}"
    if least is not None:
        return f"{text}, {least} or more" if most is None else f"{text}, {least} to {most}"
    return text


def _words(annotation: Any) -> str:
    """Return the TOML type of an annotation in words."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(_words(a) for a in arguments if a is not NoneType))
    if origin is Literal:
        return ", ".join(f"`{json.dumps(a)}`" for a in arguments)
    if origin is tuple and arguments[-1] is Ellipsis:
        inside = _words(arguments[0])
        return {"table": "tables"}.get(inside, f"list of {inside}" if inside.startswith("`") else f"list of {inside}s")
    if origin is tuple:
        return f"list of {len(arguments)} {_words(arguments[0])}s"
    return _WORDS.get(annotation, "table") if isinstance(annotation, type) else "table"


def _unit(name: str) -> str:
    ending = name.rpartition("_")[2]
    return _UNITS.get(name, ending if ending in _ENDINGS else "")


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value is None or value == () or isinstance(value, BaseModel):
        return ""
    return f"`{json.dumps(value, default=str)}`" if value != {} else "`{}`"
