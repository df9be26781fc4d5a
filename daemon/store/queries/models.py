"""The tables of models: every model and its state, all changes of states, and results of live models on check sessions.

A model is created as a candidate, goes live when an operator accepts it, and is retired when another model replaces it
or an operator rejects it; it can be made live again. Each rig has at most one live model. Each change adds a row to
`model_states`. No model and no change is ever deleted, and neither are the models' directories. Results on check
sessions are deleted to be made anew.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from daemon.store.connection import Connection
from daemon.store.errors import NotInStoreError
from daemon.store.queries.sessions import SessionTable
from daemon.store.queries.time_axis import TimeAxis, time_axis
from daemon.store.queries.zeros import Zeros
from daemon.store.rows import marks
from drivers.clock import Clock

REJECTED = "rejected: "
_MODELS = """SELECT model.id, model.rig, model.path, model.manifest_sha256, model.stage, model.state,
        model.metrics_json, model.created_utc_ns, job.result_json
    FROM models AS model LEFT JOIN jobs AS job ON job.id = model.job_id"""
# This runs twice a second for months, so each step finds its rows by an index.
_LIVE_RUN = """SELECT state.id AS since, model.id AS model_id, coalesce(state.after_session, 0) AS after_session
    FROM models AS model CROSS JOIN model_states AS state ON state.model_id = model.id
    WHERE model.rig = ? AND model.state = 'live' AND state.state = 'live' AND state.zeros_checked_through IS NULL
    ORDER BY state.id DESC LIMIT 1"""
_NEWEST_RETIREMENT = """SELECT max(state.id) AS number FROM models AS model
    CROSS JOIN model_states AS state ON state.model_id = model.id WHERE model.rig = ? AND state.state = 'retired'"""
_DRIFTED = """SELECT session.rowid AS number, session.id FROM drift_checks AS drift
    CROSS JOIN calibration_sessions AS session ON session.id = drift.session_id
    WHERE drift.live_since = ? AND drift.alarm = 'worse' ORDER BY drift.id LIMIT 1"""
_DRIFT_CHECKS = """SELECT session_id, standstills, ratio, reason, upper, lower, alarm FROM drift_checks
    WHERE live_since = ? ORDER BY id"""
_FORGET_DRIFT = """DELETE FROM drift_checks WHERE live_since = ? AND session_id IN (SELECT id FROM calibration_sessions
    WHERE rowid >= (SELECT rowid FROM calibration_sessions WHERE id = ? AND kind = 'check'))"""


@dataclass(frozen=True)
class ModelRow:
    """A model of the store.

    Attributes:
        id: number of the model.
        rig: name of its machine.
        state: candidate, live or retired.
        stage: geometric, effects or hybrid.
        path: its directory.
        manifest_sha256: SHA-256 of its manifest when it was written.
        sessions: sessions on which it was trained.
        created_utc_ns: when it was created.
        metrics: errors on its training rows (`training`, `noise_mm`), its named `effects`, and, if it was compared,
            `comparison`: its figures on held-out sessions and those of the model that was `live` at that time, as in
            `evaluation.promotion`.
    """

    id: int
    rig: str
    state: str
    stage: str
    path: Path
    manifest_sha256: str
    sessions: tuple[str, ...]
    created_utc_ns: int
    metrics: Mapping[str, Any]

    @property
    def comparison(self) -> Mapping[str, Any] | None:
        """Figures of the model on held-out sessions; None before they are known."""
        found = self.metrics.get("comparison")
        return found if isinstance(found, dict) else None

    def as_dict(self) -> dict[str, Any]:
        """Return the row as a JSON object for the control socket."""
        return asdict(self) | {"path": str(self.path), "sessions": list(self.sessions)}


@dataclass(frozen=True)
class LiveRun:
    """The period during which a model is live.

    Attributes:
        since: number of the change by which the model went live.
        model_id: number of the model.
        after_session: number of the rig's newest session at that time.
    """

    since: int
    model_id: int
    after_session: int


class ModelTable:
    """The models of one rig.

    Args:
        store: the database.
        rig_name: name of the rig.
        clock: clock for the instants of changes.
    """

    def __init__(self, store: Connection, rig_name: str, clock: Clock) -> None:
        self._store, self._rig, self._clock = store, rig_name, clock
        self._sessions = SessionTable(store, rig_name)

    # ---- models ------------------------------------------------------------------------------------------------------

    def all(self) -> list[ModelRow]:
        """Return all models of the store, including other rigs', oldest first."""
        return [_row(row) for row in self._store.rows(f"{_MODELS} ORDER BY model.id")]

    def get(self, model_id: object) -> ModelRow:
        """Return the model of that number.

        Raises:
            NotInStoreError: there is no such model.
        """
        found = type(model_id) is int and self._store.rows(f"{_MODELS} WHERE model.id = ?", (model_id,))
        if not found:
            raise NotInStoreError(f"there is no model {model_id!r:.80}; `rigcal model list` shows them")
        return _row(found[0])

    def at(self, path: str) -> ModelRow:
        """Return the model in a directory.

        Raises:
            NotInStoreError: there is no such model.
        """
        found = self._store.rows(f"{_MODELS} WHERE model.path = ? ORDER BY model.id DESC LIMIT 1", (path,))
        if not found:
            raise NotInStoreError(f"there is no model at {path}; `rigcal model list` shows them")
        return _row(found[0])

    def live(self) -> ModelRow | None:
        """Return the rig's live model; None if there is none."""
        found = self._store.rows(f"{_MODELS} WHERE model.rig = ? AND model.state = 'live'", (self._rig,))
        return _row(found[0]) if found else None

    def newest(self) -> ModelRow | None:
        """Return the rig's newest model; None before the first."""
        found = self._store.rows(f"{_MODELS} WHERE model.rig = ? ORDER BY model.id DESC LIMIT 1", (self._rig,))
        return _row(found[0]) if found else None

    def waiting(self) -> ModelRow | None:
        """Return the rig's newest model if it is a candidate, otherwise None."""
        newest = self.newest()
        return newest if newest is not None and newest.state == "candidate" else None

    def not_used(self, session_ids: Collection[str], *, only_if_rejected: bool = False) -> tuple[str, str] | None:
        """Return the first of some sessions that calibration does not use any more, and why, a clause; None if all are.

        Args:
            session_ids: closed sessions; unknown ones are ignored.
            only_if_rejected: ask only for sessions that an operator has rejected.
        """
        column = "rejected_utc_ns" if only_if_rejected else "excluded"
        sql = f"""SELECT id, excluded FROM calibration_sessions
            WHERE id IN ({marks(session_ids)}) AND {column} IS NOT NULL ORDER BY rowid LIMIT 1"""
        return next(((row["id"], row["excluded"]) for row in self._store.rows(sql, (*session_ids,))), None)

    def predecessor(self, model: ModelRow) -> int | None:
        """Return the number of the model that was live when this one was accepted; None for the first model."""
        (first,) = self._store.rows(
            "SELECT replaced_id FROM model_states WHERE model_id = ? AND state = 'live' ORDER BY id LIMIT 1",
            (model.id,),
        )
        return None if first["replaced_id"] is None else int(first["replaced_id"])

    def history(self, model: ModelRow) -> list[dict[str, Any]]:
        """Return every change of a model's state, oldest first."""
        return self._store.rows(
            "SELECT state, utc_ns, operator, caller_user AS user, reason, replaced_id FROM model_states "
            "WHERE model_id = ? ORDER BY id",
            (model.id,),
        )

    def jumped(self, model: ModelRow) -> dict[str, int]:
        """Return the devices whose readings have jumped since the model was trained, without jumps that were checked.

        No model uses what a session measured after a jump, so jumps are counted from the start of the newest session of
        its training. Order of time is decided by boots and the monotonic clock, because the wall clock may be wrong for
        whole boots.

        Returns:
            Device -> number of its newest jump among the store's device events.
        """
        return Zeros(self._store, self._rig).lost(self._sessions.newest_start(model.sessions))

    def time_axis(self) -> TimeAxis:
        """Return the axis of `time_s` in the store's observations, and so in its models' training data."""
        return time_axis(self._store)

    def live_run(self) -> LiveRun | None:
        """Return the live model's run; None if no model is live."""
        found = self._store.rows(_LIVE_RUN, (self._rig,))
        return LiveRun(**found[0]) if found else None

    def newest_retirement(self) -> int | None:
        """Return the number of the newest change by which a model of the rig was retired; None before the first."""
        (found,) = self._store.rows(_NEWEST_RETIREMENT, (self._rig,))
        return None if found["number"] is None else int(found["number"])

    def drifted(self, run: LiveRun) -> tuple[int, str] | None:
        """Return number and id of the check session that showed drift of a live model; None if none did."""
        found = self._store.rows(_DRIFTED, (run.since,))
        return (found[0]["number"], found[0]["id"]) if found else None

    def drift_checks(self, live_since: int) -> list[dict[str, Any]]:
        """Return the check sessions compared with a live model, and its cumulative sums after each, oldest first."""
        return self._store.rows(_DRIFT_CHECKS, (live_since,))

    # ---- changes -----------------------------------------------------------------------------------------------------

    def add(self, job_id: int, result: Mapping[str, Any]) -> None:
        """Add the candidate made by a job.

        Args:
            job_id: number of the job.
            result: result of the job.
        """
        row = {
            "rig": self._rig,
            "path": result["model"],
            "manifest_sha256": result["manifest_sha256"],
            "rig_sha256": self._sessions.rig_of(result.get("sessions", ())),
            "stage": result["stage"],
            "state": "candidate",
            "job_id": job_id,
            "metrics_json": result["metrics"],
        }
        with self._store.transaction():
            model_id = self._store.insert("models", row | self._store.instant(self._clock.now(), "created_"))
            self._note_state(model_id, "candidate", f"made by job {job_id}")

    def note_comparison(self, path: str, comparison: Mapping[str, Any]) -> None:
        """Store the figures on held-out sessions of the model in a directory; they replace an earlier comparison."""
        with self._store.transaction():
            for row in self._store.rows("SELECT id, metrics_json FROM models WHERE path = ?", (path,)):
                metrics = json.loads(row["metrics_json"]) | {"comparison": comparison}
                self._store.update("models", {"id": row["id"]}, {"metrics_json": metrics})

    def go_live(self, model: ModelRow, replaced: ModelRow | None, reason: str, **by: object) -> bool:
        """Make a model live and retire the previous live model.

        Args:
            model: the model, as it was when the decision was made.
            replaced: the live model at that time.
            reason: why, a clause.
            by: `operator`, and the columns of the caller.

        Returns:
            False, with nothing changed, if a different model is live by now, or the model was compared again or has
            changed its state since, or a session on which a candidate was trained or compared is not used any more.
        """
        with self._store.transaction():
            now_live = self.live()
            if self.get(model.id) != model or (now_live and now_live.id) != (replaced and replaced.id):
                return False
            checks = (model.comparison or {}).get("sessions", ())
            if model.state == "candidate" and self.not_used((*model.sessions, *checks)) is not None:
                return False
            if replaced is not None:
                self._store.update("models", {"id": replaced.id}, {"state": "retired"})
                self._note_state(replaced.id, "retired", f"model {model.id} took its place", **by)
            self._store.update("models", {"id": model.id}, {"state": "live"})
            replaced_id = replaced.id if replaced else None
            after_session = self._sessions.newest_number()
            self._note_state(model.id, "live", reason, replaced_id=replaced_id, after_session=after_session, **by)
        return True

    def reject(self, model: ModelRow, reason: str, **by: object) -> bool:
        """Retire a candidate or the live model, which an operator does not want.

        Args:
            model: the model, as it was when the decision was made.
            reason: why, a clause.
            by: as for `go_live`.

        Returns:
            False, with nothing changed, if the model is retired already or has changed its state since.
        """
        with self._store.transaction():
            if model.state == "retired" or self.get(model.id).state != model.state:
                return False
            self._store.update("models", {"id": model.id}, {"state": "retired"})
            self._note_state(model.id, "retired", reason, **by)
        return True

    def was_live(self, model: ModelRow) -> bool:
        """Return True if a model was ever live."""
        return any(change["state"] == "live" for change in self.history(model))

    def rejection(self, model: ModelRow) -> str | None:
        """Return the reason with which an operator rejected a model that is retired for it; None if that is not so."""
        retired = [change for change in self.history(model) if change["state"] in ("live", "retired")]
        reason = str(retired[-1]["reason"]) if retired else ""
        return reason if model.state == "retired" and reason.startswith(REJECTED) else None

    def at_once(self) -> AbstractContextManager[object]:
        """Return a transaction: all changes in its block are stored together, or none."""
        return self._store.transaction()

    def note_zeros_checked(self, model: ModelRow, through: int, **by: object) -> None:
        """Note that an operator has checked that the joints' zeros are those with which a model was trained.

        Args:
            model: the live or the waiting model.
            through: number of the newest device event known at that time; later jumps are not covered.
            by: as for `go_live`.
        """
        self._note_state(model.id, model.state, "zeros checked", zeros_checked_through=through, **by)

    def _note_state(self, model_id: int, state: str, reason: str, **columns: object) -> None:
        row = {"model_id": model_id, "state": state, "reason": reason, **columns}
        self._store.insert("model_states", row | self._store.instant(self._clock.now()))

    def forget_drift(self, session_id: str) -> bool:
        """Delete what a check session and all later ones showed of the live model, so that it is made anew, in order.

        Args:
            session_id: the session; of one that is no check, nothing is deleted.

        Returns:
            Whether anything was deleted.
        """
        run = self.live_run()
        if run is None:
            return False
        with self._store.transaction() as db:
            return db.execute(_FORGET_DRIFT, [run.since, session_id]).rowcount > 0

    def add_drift_check(self, **columns: object) -> None:
        """Add the comparison of a check session with a live model."""
        self._store.insert("drift_checks", columns | self._store.instant(self._clock.now()))


def trained_on(models: Sequence[ModelRow | None]) -> frozenset[str]:
    """Return the sessions on which any of these models was trained."""
    return frozenset(session for model in models if model is not None for session in model.sessions)


def _row(row: Mapping[str, Any]) -> ModelRow:
    made = json.loads(row["result_json"] or "{}")
    same = {name: row[name] for name in ("id", "rig", "state", "stage", "manifest_sha256", "created_utc_ns")}
    sessions = tuple(made.get("sessions", ()))
    return ModelRow(**same, path=Path(row["path"]), sessions=sessions, metrics=json.loads(row["metrics_json"]))
