"""docs/reference/python.md: every public name with its signature and docstring."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

import rigcal

_HEAD = """# Python

Every public name of `import rigcal`. [Notebook or program](../how-to/notebook.md) is a worked example. These names
follow Semantic Versioning; everything in the other packages may change. `rigcal.__version__` is a string.

This page is generated from the code: `python -m docs.references`.
"""
_QUOTED = re.compile(r"(?<=: )'(.*?)'(?= = |$)")
"""An annotation that is stored as a string."""
_PART = re.compile(r"(?m)^(Args|Attributes|Returns|Raises):\n")
_ENTRY = re.compile(r"(?m)^    ([\w*, ]+): ")


def page() -> str:
    """Return the text of docs/reference/python.md."""
    called = (name for name in rigcal.__all__ if callable(getattr(rigcal, name)))
    names = sorted(called, key=lambda name: (inspect.isclass(getattr(rigcal, name)), name))
    return "\n".join((_HEAD, *(line for name in names for line in _section(name)))).rstrip() + "\n"


def _section(name: str) -> Iterator[str]:
    """Yield the section of a function or class."""
    thing = getattr(rigcal, name)
    yield from (f"## {name}", "")
    if not inspect.isclass(thing):
        yield from _signature(f"rigcal.{name}", thing)
    elif issubclass(thing, Exception):
        base = thing.__mro__[1].__name__
        yield from (f"An error, a subclass of `{base}`.", "")
    yield from _text(thing)
    if inspect.isclass(thing):
        for member, value in _members(thing):
            yield from (f"### {name}.{member}", "")
            if not isinstance(value, property):
                owner = name if isinstance(value, classmethod | staticmethod) else name.lower()
                yield from _signature(f"{owner}.{member}", getattr(thing, member))
            yield from _text(value if isinstance(value, property) else getattr(thing, member))


def _members(cls: type) -> Iterator[tuple[str, Any]]:
    """Yield the methods and properties that a class itself documents."""
    for name, value in vars(cls).items():
        kind = isinstance(value, property | classmethod | staticmethod) or inspect.isfunction(value)
        if kind and not name.startswith("_") and value.__doc__ and not hasattr(BaseModel, name):
            yield name, value


def _signature(name: str, function: Any) -> Iterator[str]:
    """Yield a signature with types; a long one has one argument on each line."""
    signature = inspect.signature(function)
    arguments = [p for p in signature.parameters.values() if p.name not in ("self", "cls")]
    plain = [_QUOTED.sub(r"\1", str(p)) for p in arguments]
    first = next((i for i, p in enumerate(arguments) if p.kind is inspect.Parameter.KEYWORD_ONLY), None)
    if first is not None:
        plain.insert(first, "*")
    given = signature.return_annotation
    end = "" if given is inspect.Signature.empty else f" -> {given}"
    line = f"{name}({', '.join(plain)}){end}"
    if len(line) > 88:
        line = "\n".join((f"{name}(", *(f"    {part}," for part in plain), f"){end}"))
    yield from ("```python", line, "```", "")


def _text(thing: Any) -> Iterator[str]:
    """Yield a docstring with its sections as lists."""
    text = inspect.getdoc(thing) or ""
    about, *sections = _PART.split(text)
    yield from (about.strip(), "")
    for title, body in zip(sections[::2], sections[1::2], strict=True):
        yield from (f"**{title}**", "")
        entries = _ENTRY.split(f"{body.rstrip()}\n")
        if title == "Returns" or len(entries) == 1:
            yield from (" ".join(body.split()), "")
            continue
        pairs = zip(entries[1::2], entries[2::2], strict=True)
        yield from (*(f"- `{names}`: {' '.join(words.split())}" for names, words in pairs), "")
