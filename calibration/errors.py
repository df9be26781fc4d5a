"""The few errors of `calibration`. The command line turns them into exit statuses 1, 2 and 3."""

from __future__ import annotations

MESSAGE_MAX = 1000  # characters


class CalibrationError(Exception):
    """Base of all errors of `calibration`; on its own, it says that the computation failed."""

    def __str__(self) -> str:
        text = super().__str__()
        # What was found is quoted, and may be anything
        return text if len(text) <= MESSAGE_MAX else f"{text[:MESSAGE_MAX]}..."


class RigError(CalibrationError):
    """A rig file is malformed or contradicts itself.

    Args:
        source: name of the file.
        where: key in it; empty for the whole file.
        reason: the fault, and what is allowed.
        line: number of the line, from 1, where it is known.
    """

    def __init__(self, source: str, where: str, reason: str, line: int | None = None) -> None:
        at = "" if line is None else f" (line {line})"
        super().__init__(f"{source}: {where}: {reason}{at}" if where else f"{source}: {reason}{at}")
        self.source, self.where, self.reason, self.line = source, where, reason, line


class DataError(CalibrationError):
    """Observations are malformed or do not fit the rig.

    Args:
        source: name of the file or table.
        reason: the fault, and how to mend it.
        line: number of the line, from 1.
        column: name of the column.
    """

    def __init__(self, source: str, reason: str, line: int | None = None, column: str | None = None) -> None:
        place = source + (f", line {line}" if line is not None else "") + (f", column {column}" if column else "")
        super().__init__(f"{place}: {reason}")
        self.source, self.reason, self.line, self.column = source, reason, line, column


class ModelError(CalibrationError):
    """A model directory is truncated, edited, of another version, or not a model at all."""


class UnsafeError(CalibrationError):
    """The result would be unsafe to use: not identifiable, worse than the live model, another rig's data."""
