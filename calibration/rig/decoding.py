"""The table `[decoding]` of a recorded rig text: how channels of a DBC or EDS file were decoded.

A rig file only names its DBC and EDS files, so it does not change when their contents change. The program that records
therefore adds the decoding of each channel to the rig's text. It distinguishes recordings from before and after a
change, for example of the DBC's factor.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from calibration.rig.toml import quoted

_TABLE = re.compile(r"^\n?\[decoding\]\n(?:[A-Za-z]\w* = \".*\"\n)*", re.MULTILINE)  # as `with_decoding` writes it


def with_decoding(text: str, decoding: Mapping[str, str]) -> str:
    """Return a rig's text with the table `[decoding]` added or replaced.

    Args:
        text: TOML.
        decoding: channel -> how its value is decoded; if empty, the text returned has no such table.
    """
    text = without_decoding(text)
    if not decoding:
        return text
    lines = [f"{name} = {quoted(told)}" for name, told in decoding.items()]
    return "\n".join((text.removesuffix("\n"), "", "[decoding]", *lines, ""))


def without_decoding(text: str) -> str:
    """Return a rig's text without the table `[decoding]`, as in its file."""
    return _TABLE.sub("", text)


def decoded_otherwise(here: Mapping[str, str], there: Mapping[str, str]) -> tuple[str, ...]:
    """Return the channels that two rigs decode differently; a channel must be in both to count.

    Args:
        here: channel -> how its value is decoded, of one rig.
        there: the same for the other rig.
    """
    return tuple(name for name, told in here.items() if there.get(name, told) != told)
