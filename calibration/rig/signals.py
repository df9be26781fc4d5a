"""Signals of a rig: from a column's name to its `[[signal]]`, and which names are free."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

from pydantic import ValidationError

from calibration.rig.channels import Channel, Signal, Unit
from calibration.rig.columns import own_columns

# The longest ending that fits is the unit: `wind_mm_per_s` is in mm/s.
_ENDINGS = sorted(
    ((f"_{unit.replace('/', '_per_')}", unit) for unit in get_args(Unit) if unit), key=lambda pair: -len(pair[0])
)
_READ_ANYWAY = re.compile(r"[A-Za-z][A-Za-z0-9_]*_(bar|mA)")
_NEITHER_LETTER_NOR_DIGIT = re.compile(r"[^A-Za-z0-9]+")
# What learners call the features that they compute themselves.
_FEATURE = re.compile(r"(frame\d+|prism|deflection|rbfn)_[xyz]_mm|torque_.*_Nm?")


def is_read_anyway(column: str) -> bool:
    """Return True for a pressure or a current, `<signal>_bar` or `<signal>_mA`, which no rig file needs to name."""
    return _READ_ANYWAY.fullmatch(column) is not None


@dataclass(frozen=True)
class Taken:
    """Names and columns of a rig that its signals cannot have.

    Attributes:
        names: name -> kind of thing that has it: joint, prism or channel.
        columns: of observations tables, of joints and channels.
    """

    names: Mapping[str, str]
    columns: frozenset[str]

    @classmethod
    def by(cls, joints: Sequence[str], prisms: Iterable[str], channels: Collection[Channel]) -> Taken:
        """Return what joints and prisms of these names, and channels, leave to no signal."""
        names = dict.fromkeys((channel.name for channel in channels), "channel")
        names |= dict.fromkeys(prisms, "prism") | dict.fromkeys(joints, "joint")
        return cls(names, frozenset(own_columns(joints)) | {channel.column for channel in channels})


def signal_of(column: str, taken: Collection[str]) -> Signal:
    """Return the signal that has a column of this name.

    Args:
        column: as in the header of a table.
        taken: names that it cannot have: there, as in `q1_degC` beside a joint q1, the unit stays a part of the name.

    Raises:
        ValueError: no signal can have this column.
    """
    name, unit = next(((column.removesuffix(e), u) for e, u in _ENDINGS if column.endswith(e)), (column, ""))
    if name in taken:
        name, unit = column, ""
    try:
        return Signal(name=name, unit=unit)
    except ValidationError:
        raise ValueError(
            f"{column!a} cannot be a signal's column: letters, digits and underscores, a letter first, and the unit "
            f"last, as in tilt_x_deg"
        ) from None


def signal_lines(signal: Signal) -> tuple[str, str, str]:
    """Return the lines of a rig file that make a signal."""
    return "[[signal]]", f'name = "{signal.name}"', f'unit = "{signal.unit}"'


def signal_faults(signals: Iterable[Signal], taken: Taken) -> Iterator[str]:
    """Yield why signals of a rig cannot be: each is a name that something else has."""
    for signal in signals:
        if signal.column in taken.columns:
            yield f"signal {signal.name!r}: the column {signal.column} is known without it; leave it out"
        elif signal.name in taken.names:
            read = "; its column is read without it" if is_read_anyway(signal.column) else ""
            yield f"signal {signal.name!r}: a {taken.names[signal.name]} is called so{read}"
        elif _FEATURE.fullmatch(signal.column):
            yield f"signal {signal.name!r}: rigcal computes something called {signal.column}; give it another name"


def how_to_use(column: str, taken: Taken) -> str:
    """Return a sentence on how a column of numbers that nothing uses can be used."""
    fitting = _NEITHER_LETTER_NOR_DIGIT.sub("_", column).strip("_")
    for name in (column, fitting, f"signal_{fitting}"):
        try:
            signal = signal_of(name, taken.names)
        except ValueError:
            continue
        if any(signal_faults([signal], taken)):
            continue
        rename = "" if name == column else f"rename it to {name} and "
        header, *keys = signal_lines(signal)
        return (
            f"column {column!a} holds numbers and is not used; to use it, {rename}add --signal {name}, or to the rig "
            f"file the three lines {header}, {' and '.join(keys)}"
        )
    return f"column {column!a} holds numbers and is not used; a signal needs another name"
