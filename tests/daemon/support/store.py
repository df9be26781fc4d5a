"""Records and captures for tests of the store, the acquisition and the joiner."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

from daemon.store import Reader, Store
from drivers.clock import Stamp
from drivers.readings import CanCapture, Fix, LockState, Reading, SerialCapture, Status

BOOT = "boot-a"
UTC_0 = 1_700_000_000_000_000_000
MONOTONIC_0 = 5_000_000_000


def at(seconds: float, boot_id: str = BOOT) -> Stamp:
    """The instant `seconds` into a test."""
    shift = round(seconds * 1e9)
    return Stamp(UTC_0 + shift, MONOTONIC_0 + shift, boot_id)


def frame(number: int, seconds: float | None = None, link: str = "boom", boot_id: str = BOOT) -> CanCapture:
    """A frame that carries its number, at `seconds`, by default one a millisecond."""
    when = number / 1000 if seconds is None else seconds
    return CanCapture(link, at(when, boot_id), 0x181, number.to_bytes(8, "little"))


def serial_bytes(data: bytes, seconds: float, link: str = "station", boot_id: str = BOOT) -> SerialCapture:
    return SerialCapture(link, at(seconds, boot_id), data)


def reading(
    channel: str, seconds: float, value: float | None, unit: str = "deg", status: Status = Status.OK
) -> Reading:
    return Reading(channel, at(seconds), value, unit, status)


def fix(seconds: float, status: Status = Status.OK, station: str = "ts1") -> Fix:
    return Fix(
        station,
        at(seconds),
        at(seconds + 0.01),
        status,
        LockState.LOCKED,
        hz_angle_rad=1.25,
        zenith_angle_rad=1.5,
        slope_distance_m=11.7845,
        face=1,
        prism_constant_mm=-30.0,
        ppm=2.5,
        tilt_ok=True,
        edm_level=12,
        raw=b"Q+0117848",
    )


def table(path: Path, name: str, order: str = "rowid") -> list[dict[str, Any]]:
    """All rows of a table, through a reader of its own."""
    with Reader(path) as reader:
        return [*reader.rows(f"SELECT * FROM {name} ORDER BY {order}")]


def rows(path: Path, sql: str, **parameters: Any) -> list[dict[str, Any]]:
    """What a query answers on a store's file."""
    with contextlib.closing(sqlite3.connect(path)) as db:
        db.row_factory = sqlite3.Row
        return [dict(row) for row in db.execute(sql, parameters)]


def steps_of(store: Store, work: Callable[[], object]) -> int:
    """Return the number of steps of SQLite's virtual machine; unlike time it is always the same."""
    steps = 0

    def count() -> int:
        nonlocal steps
        steps += 100
        return 0

    with store.transaction() as db:
        db.conn.set_progress_handler(count, 100)
        work()
        db.conn.set_progress_handler(None, 0)
    return steps
