"""Gathers the evidence that rules look at, from the parts of the daemon."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from daemon.acquisition_status import AcquisitionStatus
from daemon.alarms.evidence import Evidence, FailedJob, ModelEvidence, SessionEvidence, SetupEvidence, StoreEvidence
from daemon.drift_table import DriftTable
from daemon.live_model import LiveModel, Loaded
from daemon.prism_guard import Suspicion
from daemon.store.alarm_evidence import failed_jobs, has_jobs, newest_setup, open_session, untrained_sessions
from daemon.store.health import StoreHealth
from daemon.store.store import Store
from drivers.clock import NS_PER_S, Clock, Stamp

T = TypeVar("T")


class Gatherer:
    """Takes a snapshot of everything, again and again. A part that fails keeps what it was last known to be.

    Args:
        store: for sessions, set-ups and jobs.
        rig_name: whose.
        live: the live model.
        drift: of the live model.
        clock: when it is.
        previous_run: as of `Evidence`.
        acquisition: its status.
        health: of the store.
        suspicions: stations that may be on another prism than the open session's.
        control_faults: of the control sockets, as of `Evidence`.
        models_directory: where jobs leave models.
    """

    def __init__(
        self,
        store: Store,
        rig_name: str,
        live: LiveModel,
        drift: DriftTable,
        clock: Clock,
        previous_run: Stamp | None,
        *,
        acquisition: Callable[[], AcquisitionStatus],
        health: Callable[[], StoreHealth],
        suspicions: Callable[[], Sequence[Suspicion]],
        control_faults: Callable[[], Mapping[str, str]],
        models_directory: Path,
    ) -> None:
        self._acquisition, self._health, self._suspicions = acquisition, health, suspicions
        self._store, self._rig = store, rig_name
        self._live, self._drift, self._clock, self._previous_run = live, drift, clock, previous_run
        self._control_faults, self._models_directory = control_faults, models_directory
        self._began = clock.now()
        self._known = Evidence(self._began)
        self._failed: dict[str, str] = {}

    def __call__(self) -> Evidence:
        """What is known now."""
        self._failed = {}
        now, known = self._clock.now(), self._known
        self._known = Evidence(
            now=now,
            running_s=now.since(self._began) / NS_PER_S,
            acquisition=self._part("acquisition", self._acquisition, known.acquisition),
            session=self._part("the open session", self._session, known.session),
            setup=self._part("the set-ups", self._setup, known.setup),
            failed_jobs=self._part("the jobs", self._failed_jobs, known.failed_jobs),
            model=self._part("the live model", self._model, known.model),
            store=self._part("the store's files", self._files, known.store),
            previous_run=self._previous_run,
            untrained_sessions=self._part("the sessions", self._untrained, known.untrained_sessions),
            control_faults=self._part("the control sockets", self._control_faults, known.control_faults),
            unwatched=self._failed,
        )
        return self._known

    def _part(self, name: str, look: Callable[[], T], before: T) -> T:
        try:
            return look()
        except Exception as error:  # noqa: BLE001 - whatever fails must not keep the others from being looked at
            self._failed[name] = f"{type(error).__name__}: {error}"
            return before

    def _session(self) -> SessionEvidence | None:
        row = open_session(self._store, self._rig)
        if row is None:
            return None
        age_s = self._clock.now().since(row.started) / NS_PER_S
        return SessionEvidence(row.id, age_s, row.jumped, tuple(self._suspicions()))

    def _setup(self) -> SetupEvidence | None:
        found = newest_setup(self._store)
        return None if found is None else SetupEvidence(found[0], found[1] == "moved")

    def _failed_jobs(self) -> tuple[FailedJob, ...]:
        return tuple(FailedJob(*row) for row in failed_jobs(self._store, self._rig))

    def _model(self) -> ModelEvidence | None:
        run = self._drift.run()
        if run is None:
            return None
        live, drifted = self._live.now(), self._drift.drifted(run)
        drifted_with = None if drifted is None else drifted[1]
        if isinstance(live, Loaded):
            return ModelEvidence(run.model_id, live.jumped, "", drifted_with)
        return ModelEvidence(run.model_id, (), live.reason if live.is_defect else "", drifted_with)

    def _files(self) -> StoreEvidence:
        health = self._health()
        fault = health.text if health.state in ("damaged", "replaced", "missing") else ""
        are_models_there = self._models_directory.is_dir() and any(self._models_directory.iterdir())
        is_new = are_models_there and not has_jobs(self._store)
        return StoreEvidence(fault, health.free_bytes, health.is_low, is_new)

    def _untrained(self) -> dict[str, str]:
        return untrained_sessions(self._store, self._rig)
