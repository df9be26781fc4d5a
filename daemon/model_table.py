"""The store's table of models: what is in it, and every way in which a model changes its state.

A model is made as a candidate, goes live when an operator accepts it, and is retired when another takes its place; it
can be put back. One is live per rig. Each change is one transaction and leaves a row in `model_states`; no row of
either table is ever deleted, and neither are the models' directories.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daemon.caller import caller_columns
from daemon.control import REFUSED, CommandError
from daemon.session_data import time_zero_ns
from daemon.store.store import Store
from drivers.clock import Clock

_MODELS = """SELECT model.id, model.rig, model.path, model.manifest_sha256, model.stage, model.state,
        model.metrics_json, model.created_utc_ns, job.result_json
    FROM models AS model LEFT JOIN jobs AS job ON job.id = model.job_id"""
# A boot's number rises from boot to boot, and monotonic_ns within one; utc_ns may step.
_JUMPED = """SELECT device, max(id) AS newest FROM device_events
    WHERE kind = 'preset_jump' AND (boot_id, monotonic_ns) > (?, ?) AND id > ? GROUP BY device ORDER BY device"""


@dataclass(frozen=True)
class ModelRow:
    """A model of the store.

    Attributes:
        id: its number.
        rig: name of the machine it is of.
        path: its directory.
        manifest_sha256: what its manifest was when it was written.
        stage: geometric, effects or hybrid.
        state: candidate, live or retired.
        metrics: errors on its training rows (`training`, `noise_mm`), and `comparison`, where there was one: its
            figures on held-out sessions beside those of the model `live` then, as `calibration.promotion` has them.
        sessions: what it was trained on.
        created_utc_ns: when it was made.
    """

    id: int
    rig: str
    path: Path
    manifest_sha256: str
    stage: str
    state: str
    metrics: Mapping[str, Any]
    sessions: tuple[str, ...]
    created_utc_ns: int

    @property
    def comparison(self) -> Mapping[str, Any] | None:
        """How it did on held-out sessions; None before that is known."""
        found = self.metrics.get("comparison")
        return found if isinstance(found, dict) else None

    def as_dict(self) -> dict[str, Any]:
        """For the control socket."""
        return {
            "id": self.id,
            "rig": self.rig,
            "state": self.state,
            "stage": self.stage,
            "path": str(self.path),
            "manifest_sha256": self.manifest_sha256,
            "sessions": list(self.sessions),
            "created_utc_ns": self.created_utc_ns,
            "metrics": dict(self.metrics),
        }


class ModelTable:
    """The models of one rig.

    Args:
        store: where they are.
        rig_name: whose models go live.
        clock: for when what happened.
    """

    def __init__(self, store: Store, rig_name: str, clock: Clock) -> None:
        self._store, self._rig, self._clock = store, rig_name, clock

    # ---- what is there -----------------------------------------------------------------------------------------------

    def all(self) -> list[ModelRow]:
        """All models of the store, other rigs' too, oldest first."""
        return [_row(row) for row in self._store.rows(f"{_MODELS} ORDER BY model.id")]

    def get(self, model_id: object) -> ModelRow:
        """The model of that number; CommandError if there is none."""
        found = type(model_id) is int and self._store.rows(f"{_MODELS} WHERE model.id = ?", (model_id,))
        if not found:
            raise CommandError(f"there is no model {model_id!r:.80}; `rigcal model list` shows them")
        return _row(found[0])

    def at(self, path: str) -> ModelRow:
        """The model in a directory; CommandError if there is none."""
        found = self._store.rows(f"{_MODELS} WHERE model.path = ? ORDER BY model.id DESC LIMIT 1", (path,))
        if not found:
            raise CommandError(f"there is no model at {path}; `rigcal model list` shows them")
        return _row(found[0])

    def live(self) -> ModelRow | None:
        """The rig's live model."""
        found = self._store.rows(f"{_MODELS} WHERE model.rig = ? AND model.state = 'live'", (self._rig,))
        return _row(found[0]) if found else None

    def waiting(self) -> ModelRow | None:
        """The rig's newest model, if it is a candidate."""
        found = self._store.rows(f"{_MODELS} WHERE model.rig = ? ORDER BY model.id DESC LIMIT 1", (self._rig,))
        return _row(found[0]) if found and found[0]["state"] == "candidate" else None

    def predecessor(self, model: ModelRow) -> int | None:
        """The model that was live when this one was accepted; None for a first one."""
        (first,) = self._store.rows(
            "SELECT replaced_id FROM model_states WHERE model_id = ? AND state = 'live' ORDER BY id LIMIT 1",
            (model.id,),
        )
        return None if first["replaced_id"] is None else int(first["replaced_id"])

    def history(self, model: ModelRow) -> list[dict[str, Any]]:
        """Every change of a model's state, oldest first."""
        return self._store.rows(
            "SELECT state, utc_ns, operator, caller_user AS user, reason, replaced_id FROM model_states "
            "WHERE model_id = ? ORDER BY id",
            (model.id,),
        )

    def jumped(self, model: ModelRow) -> dict[str, int]:
        """Devices whose readings jumped since the model was trained, beyond what an operator has checked.

        What a session measured after a jump is in no model, so jumps count from the start of the newest session. What
        came later is decided by boots and the monotonic clock: a wall clock may be wrong for whole boots.

        Returns:
            device -> number of its newest jump among the store's device events.
        """
        sessions = self._store.rows(
            "SELECT id, started_boot_id, started_monotonic_ns FROM calibration_sessions WHERE rig = ? "
            "ORDER BY rowid DESC",
            (self._rig,),
        )
        started = ((s["started_boot_id"], s["started_monotonic_ns"]) for s in sessions if s["id"] in model.sessions)
        (checked,) = self._store.rows(
            "SELECT coalesce(max(zeros_checked_through), 0) AS through FROM model_states WHERE model_id = ?",
            (model.id,),
        )
        found = self._store.rows(_JUMPED, (*next(started, (0, 0)), checked["through"]))
        return {row["device"]: row["newest"] for row in found}

    def training_ns(self, model: ModelRow) -> tuple[int, int]:
        """UTC that `time_s` of its training counts from, and of the newest observation that it was trained on."""
        marks = ",".join("?" * len(model.sessions))
        (newest,) = self._store.rows(
            "SELECT coalesce(max(utc_ns), 0) AS utc_ns FROM observations "
            f"WHERE excluded IS NULL AND session_id IN ({marks})",
            model.sessions,
        )
        return time_zero_ns(self._store), newest["utc_ns"]

    # ---- what changes ------------------------------------------------------------------------------------------------

    def add(self, job_id: int, result: Mapping[str, Any]) -> None:
        """The candidate that a job has made."""
        created = self._store.instant(self._clock.now(), "created_")
        with self._store.transaction():
            row = {
                "rig": self._rig,
                "path": result["model"],
                "manifest_sha256": result["manifest_sha256"],
                "stage": result["stage"],
                "state": "candidate",
                "job_id": job_id,
                "metrics_json": result["metrics"],
                **created,
            }
            self._note(self._store.insert("models", row), "candidate", f"made by job {job_id}")

    def note_comparison(self, path: str, comparison: Mapping[str, Any]) -> None:
        """How the model in a directory did on held-out sessions; an earlier comparison is replaced."""
        with self._store.transaction():
            for row in self._store.rows("SELECT id, metrics_json FROM models WHERE path = ?", (path,)):
                metrics = json.loads(row["metrics_json"]) | {"comparison": comparison}
                self._store.update("models", {"id": row["id"]}, {"metrics_json": metrics})

    def go_live(self, model: ModelRow, replaced: ModelRow | None, operator: str, reason: str) -> None:
        """Make a model the live one and retire the one before it.

        Args:
            model: as it was when the decision was made.
            replaced: the live model then.
            operator: who decided.
            reason: why, a clause.

        Raises:
            CommandError: another model is live, or the model was compared anew or has changed its state since.
        """
        with self._store.transaction():
            now_live = self.live()
            if self.get(model.id) != model or (now_live and now_live.id) != (replaced and replaced.id):
                raise CommandError(
                    "another command or comparison changed the models meanwhile; look again with `rigcal model list`",
                    REFUSED,
                )
            if replaced is not None:
                self._store.update("models", {"id": replaced.id}, {"state": "retired"})
                self._note(replaced.id, "retired", f"model {model.id} took its place", operator)
            self._store.update("models", {"id": model.id}, {"state": "live"})
            (newest,) = self._store.rows(
                "SELECT coalesce(max(rowid), 0) AS number FROM calibration_sessions WHERE rig = ?", (self._rig,)
            )
            found = {"replaced_id": replaced.id if replaced else None, "after_session": newest["number"]}
            self._note(model.id, "live", reason, operator, **found)

    def note_zeros_checked(self, model: ModelRow, operator: str, through: int) -> None:
        """An operator has made sure that the joints' zeros are those that the live model was trained with.

        Args:
            model: the live one.
            operator: who.
            through: number of the newest device event that was known then; jumps beyond it count.
        """
        row = {"model_id": model.id, "state": "live", "operator": operator, "reason": "zeros checked"}
        checked = {"zeros_checked_through": through}
        self._store.insert("model_states", row | checked | caller_columns() | self._store.instant(self._clock.now()))

    def _note(self, model_id: int, state: str, reason: str, operator: str = "", **more: int | None) -> None:
        row: dict[str, Any] = {"model_id": model_id, "state": state, "operator": operator, "reason": reason, **more}
        self._store.insert("model_states", row | caller_columns() | self._store.instant(self._clock.now()))


def trained_on(models: Sequence[ModelRow | None]) -> frozenset[str]:
    """Sessions that any of these models was trained on."""
    return frozenset(session for model in models if model is not None for session in model.sessions)


def _row(row: Mapping[str, Any]) -> ModelRow:
    made = json.loads(row["result_json"] or "{}")
    return ModelRow(
        id=row["id"],
        rig=row["rig"],
        path=Path(row["path"]),
        manifest_sha256=row["manifest_sha256"],
        stage=row["stage"],
        state=row["state"],
        metrics=json.loads(row["metrics_json"]),
        sessions=tuple(made.get("sessions", ())),
        created_utc_ns=row["created_utc_ns"],
    )
