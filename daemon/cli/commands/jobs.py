"""`rigcal jobs`: the daemon's background jobs."""

from __future__ import annotations

from typing import Any

import click

from daemon.cli.client import ask, client_options
from daemon.cli.command import Command
from daemon.cli.lines.jobs import show_jobs, waiting_for
from daemon.cli.terminal import echo


@click.group()
def jobs() -> None:
    """List, cancel and retry background jobs.

    Jobs are the gap workflow, residual training, reports, comparisons and drift checks.
    """


@jobs.command(cls=Command, name="list")
@client_options
def jobs_list(**where: Any) -> Any:
    """List all jobs with session, duration, result or error, and report.

    Sessions without a job are listed with the reason.
    """
    silent = where | {"as_json": True}
    found = ask(silent, "jobs.list", echo)
    sessions = ask(silent, "session.list", echo)["result"]
    without = [session for session in sessions if session.get("no_job")]
    if not where["as_json"]:
        show_jobs(found["result"], without)
        opened = next((session for session in sessions if session["state"] == "open"), None)
        if opened is not None and any(job["state"] == "queued" for job in found["result"]):
            echo(f"each queued job {waiting_for(opened)}")
        if not found["result"] and not without:
            echo("no jobs yet: jobs are queued after a session is closed; `rigcal session start` opens a session")
    return found | {"without_job": [{key: session[key] for key in ("id", "no_job")} for session in without]}


@jobs.command(cls=Command, name="cancel")
@click.argument("number", type=int)
@client_options
def jobs_cancel(number: int, **where: Any) -> Any:
    """Cancel a queued or running job and the jobs that depend on it."""
    return ask(where, "jobs.cancel", echo, id=number)


@jobs.command(cls=Command, name="retry")
@click.argument("number", type=int)
@client_options
def jobs_retry(number: int, **where: Any) -> Any:
    """Queue a failed, cancelled or interrupted job again."""
    return ask(where, "jobs.retry", echo, id=number)
