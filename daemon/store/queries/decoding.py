"""Captures that wait to be decoded, and whether they may still give observations."""

from __future__ import annotations

from collections.abc import Sequence

from daemon.store.reader import Reader
from daemon.store.rows import RowSource
from drivers.clock import Stamp

OLDEST_WAITING = """SELECT first_boot_id, first_monotonic_ns FROM undecoded_chunks
    CROSS JOIN raw_chunks ON raw_chunks.id = chunk_id ORDER BY first_boot_id, first_monotonic_ns LIMIT 1"""
_IS_UNDECODED = f"""SELECT 1 FROM calibration_sessions
    WHERE id = ?1 AND (ended_boot_id, ended_monotonic_ns + ?2) >= ({OLDEST_WAITING})"""
# The last run has not ended, and has stored no captures from that long after the session's end.
_IS_STILL_READ = """SELECT 1 FROM calibration_sessions
    WHERE id = ?1 AND EXISTS (SELECT 1 FROM daemon_runs
            WHERE id = (SELECT max(id) FROM daemon_runs) AND ended_utc_ns IS NULL)
        AND NOT EXISTS (SELECT 1 FROM raw_chunks
            WHERE (last_boot_id, last_monotonic_ns) >= (ended_boot_id, ended_monotonic_ns + ?2))"""


def is_undecoded(source: RowSource, session_id: str, after_ns: int) -> bool:
    """Return True if captures of an ended session, or from up to `after_ns` after its end, wait to be decoded."""
    return any(True for _ in source.rows(_IS_UNDECODED, (session_id, after_ns)))


def is_being_joined(source: RowSource, session_id: str, after_ns: int) -> bool:
    """Return True if a daemon may still make observations of a session that has ended.

    A fix waits for joint readings that are taken after it.

    Args:
        source: the store.
        session_id: the session.
        after_ns: how long after the session's end captures may belong to it.
    """
    is_read = any(True for _ in source.rows(_IS_STILL_READ, (session_id, after_ns)))
    return is_read or is_undecoded(source, session_id, after_ns)


def decoded_before(
    reader: Reader, stretches: Sequence[tuple[Stamp, Stamp]], margin_ns: int
) -> list[tuple[Stamp, Stamp]]:
    """Cut stretches at a margin before the oldest capture that waits to be decoded, and drop those after it.

    Acquisition stores the records of waiting captures without checking whether they are stored already.

    Args:
        reader: the store.
        stretches: stretches of time, each within one boot.
        margin_ns: the margin.
    """
    oldest = next(reader.rows(OLDEST_WAITING), None)
    if oldest is None:
        return list(stretches)
    boots = {kernel_id: row for row, kernel_id in reader.boots().items()}
    cut = []
    for since, until in stretches:
        boot, last = boots[until.boot_id], until
        if boot == oldest["first_boot_id"]:
            last = until.shifted(min(oldest["first_monotonic_ns"] - margin_ns - until.monotonic_ns, 0))
        if boot <= oldest["first_boot_id"] and since.monotonic_ns <= last.monotonic_ns:
            cut.append((since, last))
    return cut
