"""`rigcal jobs`: the daemon's background jobs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import click

from daemon.cli.client import ask, client_options
from daemon.cli.command import Command
from daemon.cli.state_lines import job_line
from daemon.cli.terminal import echo


@click.group()
def jobs() -> None:
    """Background jobs: gap workflow, residual training, reports, comparisons, drift of checks."""


@jobs.command(cls=Command, name="list")
@client_options
def jobs_list(**where: Any) -> Any:
    """List all jobs."""
    return ask(where, "jobs.list", _show)


def _show(found: Sequence[Mapping[str, Any]]) -> None:
    for job in found:
        echo(job_line(job))
    if not found:
        echo("no jobs yet; those of a session are queued some seconds after it was closed")


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
