"""Thinning of readings and fixes outside sessions: they are stored for viewing only, and raw captures contain all."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence

from drivers.clock import NS_PER_S
from drivers.readings import Fix, Reading, Record

INTERVAL_NS = NS_PER_S


class Thinning:
    """Keeps one reading per channel and one fix per station each second, and every change of a status.

    All events, gaps and failures are kept, and all records in a session.

    Args:
        is_of_session: returns whether a reading or fix was measured in a session.
    """

    def __init__(self, is_of_session: Callable[[Reading | Fix], bool]) -> None:
        self._is_of_session = is_of_session
        self._kept: dict[tuple[type[Record], str], Reading | Fix] = {}

    def kept(self, records: Sequence[Record]) -> list[Record]:
        """Return the records to store, in order; all of them if the sessions cannot be read at present."""
        try:
            return [record for record in records if self._is_kept(record)]
        except sqlite3.Error:
            return list(records)

    def _is_kept(self, record: Record) -> bool:
        if isinstance(record, Reading):
            key: tuple[type[Record], str] = Reading, record.channel
        elif isinstance(record, Fix):
            key = Fix, record.station
        else:
            return True
        last = self._kept.get(key)
        is_new = (
            last is None
            or last.status is not record.status
            or last.stamp.boot_id != record.stamp.boot_id
            or not 0 <= record.stamp.monotonic_ns - last.stamp.monotonic_ns < INTERVAL_NS
        )
        if not is_new and not self._is_of_session(record):
            return False
        self._kept[key] = record
        return True
