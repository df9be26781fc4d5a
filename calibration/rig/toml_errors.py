"""Errors of pydantic translated to the terms of TOML: texts in quotes, lists in brackets, tables."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, get_args

from pydantic import BaseModel
from pydantic_core import ErrorDetails

_WHOLE, _NUMBER, _BOOL, _TABLE = (
    "must be a whole number",
    "must be a number",
    "must be true or false",
    "must be a table, with its keys below a header in square brackets or in braces",
)
_TABLES = "must be tables, each below a header [[KEY]]"
_LIST = "must be a list, in square brackets"
_LISTS = frozenset({"tuple_type", "list_type"})

# pydantic's type of an error -> function that makes the message from the error's context.
_WORDS: Mapping[str, Callable[[Mapping[str, Any]], str]] = MappingProxyType(
    {
        "string_type": lambda _: "must be a text in quotes",
        "string_too_short": lambda _: "must not be empty",
        "string_pattern_mismatch": lambda _: "must consist of letters, digits and _, and begin with a letter",
        "path_type": lambda _: "must be a path, a text in quotes",
        "int_type": lambda _: _WHOLE,
        "int_parsing": lambda _: _WHOLE,
        "int_from_float": lambda _: _WHOLE,
        "int_parsing_size": lambda _: f"{_WHOLE} of at most 64 bits",
        "float_type": lambda _: _NUMBER,
        "float_parsing": lambda _: _NUMBER,
        "finite_number": lambda _: "must be a finite number",
        "bool_type": lambda _: _BOOL,
        "bool_parsing": lambda _: _BOOL,
        "greater_than": lambda told: f"must be above {told['gt']:.15g}",
        "greater_than_equal": lambda told: f"must be {told['ge']:.15g} or more",
        "less_than": lambda told: f"must be below {told['lt']:.15g}",
        "less_than_equal": lambda told: f"must be {told['le']:.15g} or less",
        "literal_error": lambda told: f"must be {told['expected']}",
        "too_short": lambda told: f"must have {told['min_length']} or more entries, but has {told['actual_length']}",
        "too_long": lambda told: f"must have at most {told['max_length']} entries",
        "dict_type": lambda _: _TABLE,
        "model_type": lambda _: _TABLE,
        "union_tag_not_found": lambda told: f"lacks the key {told['discriminator']}, which selects its kind",
        "union_tag_invalid": lambda told: (
            f"{told['discriminator']} must be one of {told['expected_tags']}, not {told['tag']!r:.80}"
        ),
    }
)


def place(error: ErrorDetails) -> tuple[str | int, ...]:
    """Return the key that an error is about, as a path; entries of lists are counted from 1."""
    return tuple(part + 1 if isinstance(part, int) else part for part in error["loc"] if part != "[key]")


def reason(error: ErrorDetails, model: type[BaseModel]) -> str:
    """Return the fault of a value, as a clause that follows its key.

    Args:
        error: any error except a missing or an unknown key.
        model: the model that validated the document.
    """
    kind = error["type"]
    if kind in _LISTS:
        key = error["loc"][-1]
        field = _fields(section_at(model, error["loc"][:-1])).get(str(key))
        return _TABLES.replace("KEY", str(key)) if field and any(_models(field.annotation)) else _LIST
    if kind in _WORDS:
        said = _WORDS[kind](error.get("ctx", {}))
        return f"is not a valid key: it {said}" if "[key]" in error["loc"] else said
    return error["msg"].removeprefix("Value error, ")


def as_toml(value: object) -> str:
    """Return a value as written in TOML, a long string shortened; "a list" or "a table" for these."""
    if isinstance(value, list | dict):
        return "a list" if isinstance(value, list) else "a table"
    if isinstance(value, bool):
        return str(value).lower()
    return reprlib.repr(value) if isinstance(value, str) else str(value)


def section_at(model: type[BaseModel], where: Sequence[str | int]) -> type[BaseModel]:
    """Return the section of a model at a place; if the place is not a section, the innermost section around it.

    Args:
        model: the model of the whole document.
        where: names of keys and positions in lists, from the document inwards.
    """
    for part in where:
        field = _fields(model).get(str(part))
        model = next(_models(field.annotation), model) if field else model
    return model


def _fields(model: type[BaseModel]) -> dict[str, Any]:
    """Return the fields of a section by their keys."""
    return {field.alias or name: field for name, field in model.model_fields.items()}


def _models(annotation: object) -> Iterator[type[BaseModel]]:
    """Yield the sections that a value of this type may be or contain."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models(inner)
