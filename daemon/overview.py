"""The daemon's state as one JSON object, the source of `rigcal status`, `rigcal health` and the metrics."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, TypeVar

from daemon.acquisition.status.snapshot import AcquisitionStatus
from daemon.alarms.board import AlarmBoard
from daemon.composition import Parts
from daemon.guide.manager import GuideManager
from daemon.jobs.runner import JobRunner
from daemon.models.drift import gap_status
from daemon.models.registry import ModelRegistry
from daemon.monitoring.notices import Notices
from daemon.sessions.manager import SessionManager
from daemon.store.errors import StoreError
from daemon.store.health import StoreHealth
from daemon.store.queries.jobs import JobTable
from daemon.store.queries.models import ModelTable
from daemon.store.queries.setups import SetupRow, SetupTable
from daemon.store.store import Store
from daemon.version import VERSION

T = TypeVar("T")

_EVENTS = 12  # newest events that `status` shows


def newest_latency(by_session: Mapping[str, Mapping[str, Any]]) -> dict[str, Any] | None:
    """Return the newest known latency with the name of its session; None if no session has one."""
    known = [{"session": name, **found} for name, found in by_session.items() if "seconds" in found]
    return known[-1] if known else None


@dataclass(frozen=True)
class Overview:
    """Gathers the state of all parts; may be used from any thread.

    Attributes:
        parts: rig and mode.
        store: open for writing.
        store_health, acquisition: return the state of the store and of acquisition.
        clock: returns the state of the host's clock; None if it is unknown or not in use.
        alarms, notices, sessions, guide, runner, jobs, models, model_table: the parts.
    """

    parts: Parts
    store: Store
    store_health: Callable[[], StoreHealth]
    acquisition: Callable[[], AcquisitionStatus]
    clock: Callable[[], dict[str, Any] | None]
    alarms: AlarmBoard
    notices: Notices
    sessions: SessionManager
    guide: GuideManager
    runner: JobRunner
    jobs: JobTable
    models: ModelRegistry
    model_table: ModelTable

    def command(self, _arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return the state of all parts; a damaged part of the store does not hide the others."""
        unreadable: dict[str, str] = {}
        clock = self.parts.clock

        setups, file = SetupTable(self.store, self.parts.rig.name), self.store.files.database

        def stored(part: str, read: Callable[[], T]) -> T | None:
            try:
                return read()
            except (sqlite3.Error, StoreError) as error:
                self.store.note_damage(error)
                unreadable[part] = str(error)
                return None

        return {
            "rig": self.parts.rig.name,
            "mode": self.parts.mode,
            "version": VERSION,
            "time": {"utc_ns": clock.now().utc_ns, "real_s_per_s": clock.real_seconds(1.0)},
            "alarms": self.alarms.status(),
            "notices": self.notices.status(),
            "acquisition": asdict(self.acquisition()),
            "clock": self.clock(),
            "session": stored("session", self.sessions.open_session),
            "guide": self.guide.now(),
            "setup": stored("setup", lambda: _setup(setups.current())),
            "control_shots": stored("control_shots", setups.current_shots) or [],
            "jobs": stored("jobs", self.jobs.unfinished) or [],
            "jobs_awaited": stored("jobs_awaited", self.runner.awaited_session),
            "job_counts": stored("job_counts", self.jobs.counts) or [],
            "latency": stored("latency", lambda: newest_latency(self.jobs.latencies())),
            "models": stored("models", self.models.status),
            "gap": stored("gap", lambda: gap_status(self.jobs, self.model_table)),
            "events": stored("events", lambda: self.store.newest_events(_EVENTS)) or [],
            "store": str(self.store.path),
            "store_file": None if file is None else [file.device, file.inode],
            "store_health": self.store_health().as_dict(),
            "unreadable": unreadable,
        }


def _setup(row: SetupRow | None) -> dict[str, Any] | None:
    return None if row is None else asdict(row)
