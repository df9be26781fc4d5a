"""What alarms are told of sessions, set-ups and jobs; asked once a second, so each query finds its rows by an index."""

from __future__ import annotations

from dataclasses import dataclass

from daemon.store.store import Store
from drivers.clock import Stamp

_OPEN = """SELECT id, started_utc_ns, started_monotonic_ns, started_boot_id FROM calibration_sessions
    WHERE rig = ? AND state = 'open' ORDER BY rowid DESC LIMIT 1"""
_JUMPED = """SELECT DISTINCT device FROM device_events
    WHERE kind = 'preset_jump' AND (boot_id, monotonic_ns) >= (?, ?) ORDER BY device"""
_FAILED = """SELECT max(job.id) AS id, job.kind, job.error FROM jobs AS job
    CROSS JOIN calibration_sessions AS session ON session.id = job.session_id
    WHERE job.state = 'failed' AND session.rig = ? GROUP BY job.kind ORDER BY job.id"""
_DONE_LATER = """SELECT 1 FROM jobs AS job CROSS JOIN calibration_sessions AS session ON session.id = job.session_id
    WHERE job.state = 'done' AND job.id > ? AND job.kind = ? AND session.rig = ? LIMIT 1"""
# Those after the newest session that is used: later measurements make up for the earlier ones.
_UNTRAINED = """SELECT id, excluded FROM calibration_sessions
    WHERE rig = ?1 AND state = 'closed' AND excluded IS NOT NULL AND rowid >
        (SELECT coalesce(max(rowid), 0) FROM calibration_sessions
            WHERE rig = ?1 AND state = 'closed' AND excluded IS NULL)
    ORDER BY rowid"""


@dataclass(frozen=True)
class OpenSessionRow:
    """The open session.

    Attributes:
        id: of the session.
        started: when it was opened.
        jumped: devices whose encoders have jumped since.
    """

    id: str
    started: Stamp
    jumped: tuple[str, ...]


def open_session(store: Store, rig_name: str) -> OpenSessionRow | None:
    """The rig's open session; None without one."""
    rows = store.rows(_OPEN, (rig_name,))
    if not rows:
        return None
    started = store.stamp(rows[0], "started_")
    assert started is not None  # the columns are NOT NULL
    jumped = store.rows(_JUMPED, (rows[0]["started_boot_id"], rows[0]["started_monotonic_ns"]))
    return OpenSessionRow(rows[0]["id"], started, tuple(row["device"] for row in jumped))


def untrained_sessions(store: Store, rig_name: str) -> dict[str, str]:
    """Closed sessions of the rig that nothing trains on, newer than all that are used -> why."""
    return {row["id"]: row["excluded"] for row in store.rows(_UNTRAINED, (rig_name,))}


def newest_setup(store: Store) -> tuple[str, str] | None:
    """Id and state of the newest station set-up; None before the first."""
    rows = store.rows("SELECT id, state FROM station_setups ORDER BY rowid DESC LIMIT 1")
    return (rows[0]["id"], rows[0]["state"]) if rows else None


def has_jobs(store: Store) -> bool:
    """Whether there ever was a job."""
    return bool(store.rows("SELECT 1 FROM jobs LIMIT 1"))


def failed_jobs(store: Store, rig_name: str) -> list[tuple[int, str, str]]:
    """Number, kind and error of the newest failed job of each kind, where no later one of the kind is done."""
    return [
        (row["id"], row["kind"], row["error"] or "")
        for row in store.rows(_FAILED, (rig_name,))
        if not store.rows(_DONE_LATER, (row["id"], row["kind"], rig_name))
    ]
