"""Why a session has started no job of its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from daemon.commands import CHECK
from daemon.store.queries.jobs import JobKind, JobTable


def why_no_job(session: Mapping[str, Any], jobs: JobTable, *, are_jobs_enabled: bool) -> str | None:
    """Say why a session has started no job; None where it has.

    Args:
        session: its summary.
        jobs: of the rig.
        are_jobs_enabled: closed sessions start jobs ([jobs] enabled).
    """
    if jobs.has_of_session(session["id"]):
        return None
    return next(_reasons(session, jobs, are_jobs_enabled))


def _reasons(session: Mapping[str, Any], jobs: JobTable, are_jobs_enabled: bool) -> Iterator[str]:
    """Yield what keeps a session from having a job, the first cause first."""
    if session["state"] == "open":
        yield "it is open; its jobs are queued some seconds after it is closed"
    if session["state"] == "aborted":
        yield "it was aborted, and calibration does not use it"
    if session["not_used"] is not None:
        yield f"calibration does not use it: {session['not_used']}"
    is_check = session["kind"] == CHECK
    kinds = (JobKind.REPORT, JobKind.DRIFT) if is_check else (JobKind.GAP,)
    if (other := jobs.first_on(session["id"], *kinds)) is not None:
        yield f"job {other['id']}, of session {other['session_id']}, works on it too"
    if not are_jobs_enabled:
        yield "jobs are switched off: set `[jobs] enabled = true` in the configuration and start rigcal again"
    if is_check and not jobs.has_done(JobKind.RESIDUAL):
        yield "there is no model yet to hold it against; the report of the first model uses it"
    yield "its jobs are queued within seconds, as soon as no session is open"
