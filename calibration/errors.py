"""The few errors of `calibration`. The command line turns them into exit statuses 1, 2 and 3.

An argument of a wrong type is a TypeError, which only programs can cause.
"""

from __future__ import annotations

MESSAGE_MAX = 1000  # characters


class CalibrationError(Exception):
    """Base class of all errors of `calibration`; raised itself when a computation fails."""

    def __str__(self) -> str:
        text = super().__str__()
        # Messages quote the input, which may be arbitrarily long
        return text if len(text) <= MESSAGE_MAX else f"{text[:MESSAGE_MAX]}..."


class RigError(CalibrationError):
    """A rig file is malformed or contradicts itself.

    Args:
        source: name of the file.
        where: key in the file; empty for the whole file.
        reason: the fault, and what is allowed.
        line: number of the line, from 1; None if unknown.
    """

    def __init__(self, source: str, where: str, reason: str, line: int | None = None) -> None:
        at = "" if line is None else f" (line {line})"
        super().__init__(f"{source}: {where}: {reason}{at}" if where else f"{source}: {reason}{at}")
        self.source, self.where, self.reason, self.line = source, where, reason, line


class DataError(CalibrationError):
    """Observations are malformed or do not fit the rig.

    Args:
        source: name of the file or table.
        reason: the fault, and how to correct it.
        line: number of the line, from 1; None if the fault is not in one line.
        column: name of the column; None if the fault is not in one column.
    """

    def __init__(self, source: str, reason: str, line: int | None = None, column: str | None = None) -> None:
        place = source + (f", line {line}" if line is not None else "") + (f", column {column}" if column else "")
        super().__init__(f"{place}: {reason}")
        self.source, self.reason, self.line, self.column = source, reason, line, column


class ModelError(CalibrationError):
    """A model directory is truncated, edited, of an unsupported version, or not a model at all."""


class UnsafeError(CalibrationError):
    """The result would be unsafe to use: not identifiable, worse than the live model, or from another rig's data."""


def check_type(name: str, value: object, kind: type | tuple[type, ...], wanted: str) -> None:
    """Check the type of an argument that a user gives.

    Args:
        name: name of the argument.
        value: its value.
        kind: the type that it must have, or several.
        wanted: what to give instead, and how to get it.

    Raises:
        TypeError: the value has a different type.
    """
    if not isinstance(value, kind):
        raise wrong_type(name, value, wanted)


def wrong_type(name: str, value: object, wanted: str) -> TypeError:
    """Return the error about an argument of a wrong type; the arguments are those of `check_type`."""
    found = type(value).__name__
    article = "an" if found[0] in "AEIOaeio" else "a"
    return TypeError(f"{name} is {'None' if value is None else f'{article} {found}'}; give {wanted}")
