"""Records as rows of STRICT tables: values are a Python int, float, str, bytes or None, never NaN."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from drivers.clock import Stamp
from drivers.readings import DecodeFailure, Fix, Reading, Status

SqlValue = int | float | str | bytes | None
SqlRow = tuple[SqlValue, ...]

EXCERPT_BYTES = 64  # bytes stored with a decode failure; the raw chunks contain all bytes


class RowSource(Protocol):
    """A source of query results: the writing connection, or a reader."""

    def rows(self, sql: str, parameters: Sequence[object] = ()) -> Iterable[dict[str, Any]]:
        """Return the rows of a query as mappings."""


FIX_NUMBERS = (
    "hz_angle_rad",
    "zenith_angle_rad",
    "slope_distance_m",
    "north_m",
    "east_m",
    "up_m",
    "prism_constant_mm",
    "ppm",
)
FIX_COLUMNS = (
    "station",
    *("utc_ns", "monotonic_ns", "boot_id"),
    *("last_byte_utc_ns", "last_byte_monotonic_ns", "last_byte_boot_id"),
    *("status", "lock", "reason", "raw", "face", "tilt_ok", "edm_level"),
    *FIX_NUMBERS,
)


def marks(values: Collection[object]) -> str:
    """Return the placeholders (question marks) of a query for values."""
    return ", ".join("?" * len(values))


def stored_text(data: bytes) -> str:
    """Return a text column's value; bytes that are not UTF-8, from other programs, become replacement characters."""
    return data.decode("utf-8", "replace")


def sql_value(value: object) -> SqlValue:
    """Convert a value for SQLite: numpy scalars to Python's, NaN and infinities to None, mappings and lists to JSON.

    Raises:
        TypeError: a column cannot hold `value`.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str):
        return str(value)  # a StrEnum becomes its text
    if value is None or isinstance(value, int | bytes):
        return value
    if isinstance(value, Mapping | list | tuple):
        return json.dumps(_json_value(value), allow_nan=False, separators=(",", ":"))
    raise TypeError(f"a {type(value).__name__} cannot be stored in a column")


def _json_value(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(key): _json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_json_value(item) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)  # JSON has truth values, columns do not
    return sql_value(value)


def sample_row(reading: Reading, channel_id: int, boot_id: int) -> SqlRow:
    """Return a row of `joint_samples` or `signals`; a value that is not finite is stored as NULL and malformed."""
    value, status = reading.value, reading.status
    if value is not None:
        value = float(value)
        if status is not Status.OK:
            value = None
        elif not math.isfinite(value):
            value, status = None, Status.MALFORMED
    elif status is Status.OK:
        status = Status.MALFORMED
    stamp = reading.stamp
    counts = reading.raw_counts
    if counts is not None:
        counts = _signed_64(int(counts))
    return channel_id, stamp.utc_ns, stamp.monotonic_ns, boot_id, value, status.value, counts


def _signed_64(counts: int) -> int:
    """Return an unsigned 64-bit integer of a device as a signed one, which SQLite can hold."""
    return counts - 2**64 if counts >= 2**63 else counts


def fix_row(fix: Fix, boot_id: int, last_byte_boot_id: int) -> SqlRow:
    """Return a row of `fixes`, in the order of FIX_COLUMNS; a number that is not finite makes the fix malformed.

    Args:
        fix: the fix.
        boot_id: row of `boots` of its stamp.
        last_byte_boot_id: row of `boots` of the stamp of its last byte.
    """
    numbers = [sql_value(getattr(fix, name)) for name in FIX_NUMBERS]
    broken = [n for n, value in zip(FIX_NUMBERS, numbers, strict=True) if value is None and getattr(fix, n) is not None]
    status, reason = fix.status.value, fix.reason
    if broken:
        status, reason = Status.MALFORMED.value, f"{broken[0]} is not a finite number"
    return (
        fix.station,
        *(fix.stamp.utc_ns, fix.stamp.monotonic_ns, boot_id),
        *(fix.last_byte.utc_ns, fix.last_byte.monotonic_ns, last_byte_boot_id),
        *(status, fix.lock.value, reason, fix.raw, sql_value(fix.face), sql_value(fix.tilt_ok)),
        sql_value(fix.edm_level),
        *numbers,
    )


def counted_failures(failures: Sequence[DecodeFailure]) -> list[tuple[DecodeFailure, int]]:
    """Return the first failure of each device and reason, and the number of such failures."""
    first: dict[tuple[str, str], DecodeFailure] = {}
    count: dict[tuple[str, str], int] = {}
    for failure in failures:
        key = failure.device, failure.reason
        first.setdefault(key, failure)
        count[key] = count.get(key, 0) + 1
    return [(failure, count[key]) for key, failure in first.items()]


def stamp_of(row: Mapping[str, object], boots: Mapping[int, str], prefix: str = "") -> Stamp:
    """Return the instant in the columns `<prefix>utc_ns`, `<prefix>monotonic_ns`, `<prefix>boot_id` of a row.

    Args:
        row: a row with these columns, not NULL.
        boots: kernel boot ids by row id.
        prefix: `started_`, `last_byte_`, ...

    Raises:
        ValueError: the row has no instant in these columns.
    """
    utc_ns, monotonic_ns, boot = (row[f"{prefix}{name}"] for name in ("utc_ns", "monotonic_ns", "boot_id"))
    if not (isinstance(utc_ns, int) and isinstance(monotonic_ns, int) and isinstance(boot, int)):
        raise ValueError(f"the row has no instant in its columns {prefix}utc_ns, ...")
    return Stamp(utc_ns, monotonic_ns, boots[boot])
