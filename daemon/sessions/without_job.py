"""Reasons why a session has started no job of its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from daemon.commands import CHECK
from daemon.store.queries.jobs import JobKind, JobTable


def why_no_job(session: Mapping[str, Any], jobs: JobTable, *, are_jobs_enabled: bool) -> str | None:
    """Return why a session has started no job; None if it has.

    Args:
        session: summary of the session.
        jobs: jobs of the rig.
        are_jobs_enabled: closed sessions start jobs ([jobs] enabled).
    """
    if jobs.has_of_session(session["id"]):
        return None
    return next(_reasons(session, jobs, are_jobs_enabled))


def _reasons(session: Mapping[str, Any], jobs: JobTable, are_jobs_enabled: bool) -> Iterator[str]:
    """Yield the reasons why a session has no job, the most important first."""
    if session["state"] == "open":
        yield "the session is open; its jobs are queued a few seconds after it is closed"
    if session["state"] == "aborted":
        yield "the session was aborted, so calibration does not use it"
    if session["not_used"] is not None:
        yield f"calibration does not use the session: {session['not_used']}"
    is_check = session["kind"] == CHECK
    kinds = (JobKind.REPORT, JobKind.DRIFT) if is_check else (JobKind.GAP,)
    if (other := jobs.first_on(session["id"], *kinds)) is not None:
        yield f"job {other['id']} of session {other['session_id']} includes this session"
    if not are_jobs_enabled:
        yield "jobs are disabled: set `[jobs] enabled = true` in the configuration and restart rigcal"
    if is_check and not jobs.has_done(JobKind.GAP):
        yield "there is no model yet to compare the session with; the report of the first model will use it"
    yield "its jobs are queued within seconds, as soon as no session is open"
