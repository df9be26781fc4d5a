"""Decoding of the channels that a DBC or EDS file describes, as the rig text of a recording keeps it.

A rig file names such a file and does not change with it. So whoever records adds to the rig's text how each channel was
decoded: recordings from before and after a change of the DBC's factor are then told from each other.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from calibration.rig.toml import quoted

_TABLE = re.compile(r"^\n?\[decoding\]\n(?:[A-Za-z]\w* = \".*\"\n)*", re.MULTILINE)  # as `with_decoding` writes it


def with_decoding(text: str, decoding: Mapping[str, str]) -> str:
    """Return a rig's text with the table `[decoding]`, in place of one that it has.

    Args:
        text: TOML.
        decoding: channel -> how its value is decoded; where it is empty, the text has no such table.
    """
    text = without_decoding(text)
    if not decoding:
        return text
    lines = [f"{name} = {quoted(told)}" for name, told in decoding.items()]
    return "\n".join((text.removesuffix("\n"), "", "[decoding]", *lines, ""))


def without_decoding(text: str) -> str:
    """Return a rig's text as its file has it."""
    return _TABLE.sub("", text)


def decoded_otherwise(here: Mapping[str, str], there: Mapping[str, str]) -> tuple[str, ...]:
    """Return the channels that two rigs say are decoded in different ways; one that either says nothing of is none.

    Args:
        here: channel -> how its value is decoded.
        there: the same of the other rig.
    """
    return tuple(name for name, told in here.items() if there.get(name, told) != told)
