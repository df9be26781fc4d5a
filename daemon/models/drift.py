"""Drift of the live model: two CUSUM statistics of its errors on check sessions show whether the machine has changed.

The sums (`calibration.numerics.statistics`) restart whenever a model goes live, also by a rollback. When an operator
accepts or rejects a check session, the sums from this session on are deleted, and a drift job makes them anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from calibration.numerics.statistics import DECISION, Cusum
from daemon.store.queries.jobs import JobKind, JobTable
from daemon.store.queries.models import LiveRun, ModelTable


def unseen_checks(
    models: ModelTable, run: LiveRun, checks: Sequence[tuple[int, str]], trained: Sequence[str]
) -> tuple[str, ...]:
    """Return the check sessions that count for a live run and were not used to check its model for drift yet.

    Args:
        models: the table of the rig's models.
        run: the run of the live model.
        checks: number and id of closed check sessions, oldest first.
        trained: sessions that the model was trained on.
    """
    known = {row["session_id"] for row in models.drift_checks(run.since)} | set(trained)
    return tuple(name for number, name in checks if number > run.after_session and name not in known)


def note_drift(models: ModelTable, drift: Mapping[str, Any]) -> None:
    """Store the result of a drift job, in the caller's transaction; results of known sessions are not replaced."""
    since = drift["live_since"]
    for check in drift["checks"]:
        rows = models.drift_checks(since)
        if any(row["session_id"] == check["session"] for row in rows):
            continue
        before = Cusum(rows[-1]["upper"], rows[-1]["lower"]) if rows else Cusum()
        after = before.after(check["scores"])
        models.add_drift_check(
            live_since=since,
            session_id=check["session"],
            fixes=check["fixes"],
            standstills=len(check["scores"]),
            ratio=check["ratio"],
            reason=check["reason"],
            upper=after.upper,
            lower=after.lower,
            alarm=after.alarm,
        )


def drift_status(models: ModelTable) -> dict[str, Any] | None:
    """Return the drift as shown in `status`; None if no model is live."""
    run = models.live_run()
    if run is None:
        return None
    rows = models.drift_checks(run.since)
    none = {"session_id": None, "ratio": None, "reason": "", "upper": 0.0, "lower": 0.0, "alarm": "none"}
    newest = rows[-1] if rows else none
    drifted = models.drifted(run)
    return {
        "model": run.model_id,
        "checks": len(rows),
        "standstills": sum(row["standstills"] for row in rows),
        "newest": newest["session_id"],
        "ratio": newest["ratio"],
        "reason": newest["reason"],
        "upper": newest["upper"],
        "lower": newest["lower"],
        "decision": DECISION,
        "alarm": "worse" if drifted else newest["alarm"],
        "drifted_with": drifted[1] if drifted else None,
    }


def gap_status(jobs: JobTable, models: ModelTable) -> dict[str, Any]:
    """Return the gap between simulation and machine, as shown in `status`.

    Returns:
        `verdict`: result of the newest gap job that is done, or None; also None if one of its sessions is not used any
        more. `failed`: `job`, `session` and `error` of a later gap job that failed, or None. `drift`: as from
        `drift_status`.
    """
    done, failed = (jobs.newest(JobKind.GAP, state) for state in ("done", "failed"))
    is_later = failed is not None and (done is None or failed["id"] > done["id"])
    return {
        "verdict": _verdict(done, models),
        "failed": {"job": failed["id"], "session": failed["session_id"], "error": failed["error"]}
        if failed and is_later
        else None,
        "drift": drift_status(models),
    }


def _verdict(job: Mapping[str, Any] | None, models: ModelTable) -> dict[str, Any] | None:
    if job is None or "gap" not in job["result"]:  # identifications made before the gap workflow existed
        return None
    result = job["result"]
    if models.not_used(result.get("sessions", ())) is not None:
        return None
    return {
        "job": job["id"],
        "session": job["session_id"],
        "ended_utc_ns": job["ended_utc_ns"],
        "verdict": result["gap"]["verdict"],
        "effects": [f"{effect['family']}@{effect['where']}" for effect in result["gap"]["effects"]],
        "sentence": result["sentence"],
        "experiments": [experiment["text"] for experiment in result["gap"]["experiments"]],
        "report": result["report"],
    }
