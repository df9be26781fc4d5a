"""Signals of a rig: the `[[signal]]` for a column, and the names that signals cannot have."""

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
# Names that learners give to the features that they compute.
_FEATURE = re.compile(r"(frame\d+|prism|deflection|rbfn)_[xyz]_mm|torque_.*_Nm?")


def is_read_anyway(column: str) -> bool:
    """Return True for a pressure or current, `<signal>_bar` or `<signal>_mA`, which is read without a `[[signal]]`."""
    return _READ_ANYWAY.fullmatch(column) is not None


@dataclass(frozen=True)
class Taken:
    """Names and columns of a rig that its signals cannot have.

    Attributes:
        names: name -> the kind of part that has it: joint, prism or channel.
        columns: columns of observations tables that joints, channels and rigcal itself use.
    """

    names: Mapping[str, str]
    columns: frozenset[str]

    @classmethod
    def by(cls, joints: Sequence[str], prisms: Iterable[str], channels: Collection[Channel]) -> Taken:
        """Return the names and columns that the given joints, prisms and channels occupy.

        Args:
            joints: names of the joints.
            prisms: names of the prisms.
            channels: the channels.
        """
        names = dict.fromkeys((channel.name for channel in channels), "channel")
        names |= dict.fromkeys(prisms, "prism") | dict.fromkeys(joints, "joint")
        return cls(names, frozenset(own_columns(joints)) | {channel.column for channel in channels})


def signal_of(column: str, taken: Collection[str]) -> Signal:
    """Return the signal that has a column of this name.

    Args:
        column: name of a column, as in the header of a table.
        taken: names that a signal cannot have. If the name without its unit is taken, as for `q1_degC` in a rig with a
            joint q1, the unit remains part of the name.

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
            f"{column!a} cannot be the column of a signal; use letters, digits and underscores, a letter first and the "
            f"unit last, as in tilt_x_deg"
        ) from None


def signal_lines(signal: Signal) -> tuple[str, str, str]:
    """Return the lines of a rig file that define a signal."""
    return "[[signal]]", f'name = "{signal.name}"', f'unit = "{signal.unit}"'


def signal_faults(signals: Iterable[Signal], taken: Taken) -> Iterator[str]:
    """Yield a message for each signal whose name or column is taken.

    Args:
        signals: signals of a rig.
        taken: the names and columns that other parts of the rig have.
    """
    for signal in signals:
        if signal.column in taken.columns:
            yield f"signal {signal.name!r}: the column {signal.column} is already defined; remove the signal"
        elif signal.name in taken.names:
            is_read = is_read_anyway(signal.column)
            todo = "remove the signal, as its column is read without it" if is_read else "rename the signal"
            yield f"signal {signal.name!r}: a {taken.names[signal.name]} has the same name; {todo}"
        elif _FEATURE.fullmatch(signal.column):
            yield f"signal {signal.name!r}: rigcal computes a column {signal.column} itself; rename the signal"


def how_to_use(column: str, taken: Taken) -> str:
    """Return a sentence that explains how to use a column of numbers that is not used."""
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
            f"column {column!a} holds numbers but is not used; to use it, {rename}add --signal {name}, or add to the "
            f"rig file the three lines {header}, {' and '.join(keys)}"
        )
    return f"column {column!a} holds numbers but is not used; to use it as a signal, give it another name"
