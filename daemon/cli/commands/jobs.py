"""`rigcal jobs`: the daemon's background jobs."""

from __future__ import annotations

from typing import Any

import click

from daemon.cli.client import ask, client_options
from daemon.cli.command import Command
from daemon.cli.lines.jobs import show_jobs
from daemon.cli.terminal import echo


@click.group()
def jobs() -> None:
    """Background jobs: gap workflow, residual training, reports, comparisons, drift of checks."""


@jobs.command(cls=Command, name="list")
@client_options
def jobs_list(**where: Any) -> Any:
    """List all jobs: session, how long each took, its result or why it failed, and its report.

    Sessions that have started no job are listed with the reason.
    """
    silent = where | {"as_json": True}
    found = ask(silent, "jobs.list", echo)
    without = [session for session in ask(silent, "session.list", echo)["result"] if session.get("no_job")]
    if not where["as_json"]:
        show_jobs(found["result"], without)
        if not found["result"] and not without:
            echo("no jobs yet: `rigcal session start` opens a session, and its jobs are queued after it is closed")
    return found | {"without_job": [{key: session[key] for key in ("id", "no_job")} for session in without]}


@jobs.command(cls=Command, name="cancel")
@click.argument("number", type=int)
@client_options
def jobs_cancel(number: int, **where: Any) -> Any:
    """Cancel a queued or running job and those that wait for it."""
    return ask(where, "jobs.cancel", echo, id=number)


@jobs.command(cls=Command, name="retry")
@click.argument("number", type=int)
@client_options
def jobs_retry(number: int, **where: Any) -> Any:
    """Queue a job again that did not end well."""
    return ask(where, "jobs.retry", echo, id=number)
