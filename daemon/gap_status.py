"""What `status` says of the gap between simulation and machine: the newest verdict, and how the live model holds."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from daemon.drift_table import DriftTable
from daemon.store.store import Store

_NEWEST = """SELECT job.id, job.session_id, job.ended_utc_ns, job.result_json, job.error FROM jobs AS job
    JOIN calibration_sessions AS session ON session.id = job.session_id
    WHERE job.state = ? AND job.kind = 'gap' AND session.rig = ? ORDER BY job.id DESC LIMIT 1"""


class GapStatus:
    """The gap of one rig.

    Args:
        store: where jobs have left their results.
        rig_name: whose.
        drift: of its live model.
    """

    def __init__(self, store: Store, rig_name: str, drift: DriftTable) -> None:
        self._store, self._rig, self._drift = store, rig_name, drift

    def now(self) -> dict[str, Any]:
        """What there is to tell.

        Returns:
            `verdict`: of the newest gap job that has come to one, None before; `failed`: of a later one that has failed
            `job`, `session` and `error`, None without; `drift`: as `DriftTable.status`.
        """
        done, failed = (self._store.rows(_NEWEST, (state, self._rig)) for state in ("done", "failed"))
        later = failed and (not done or failed[0]["id"] > done[0]["id"])
        return {
            "verdict": self._verdict(done),
            "failed": {"job": failed[0]["id"], "session": failed[0]["session_id"], "error": failed[0]["error"]}
            if later
            else None,
            "drift": self._drift.status(),
        }

    def _verdict(self, found: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
        if not found:
            return None
        result = json.loads(found[0]["result_json"])
        if "gap" not in result:
            return None  # an identification from before there was a gap workflow
        return {
            "job": found[0]["id"],
            "session": found[0]["session_id"],
            "ended_utc_ns": found[0]["ended_utc_ns"],
            "verdict": result["gap"]["verdict"],
            "effects": [f"{effect['family']}@{effect['where']}" for effect in result["gap"]["effects"]],
            "sentence": result["sentence"],
            "experiments": [experiment["text"] for experiment in result["gap"]["experiments"]],
            "report": result["report"],
        }
