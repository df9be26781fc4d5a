"""When the station of a guided session was on no prism, as the guide's stored events show."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.guide.job import Job, Request
from daemon.store.connection import Connection
from daemon.store.queries.guides import guide_events, guide_request
from daemon.store.queries.sessions import session
from daemon.store.reader import Reader
from drivers.clock import Stamp


def is_on_prism(job: Job) -> bool:
    """Return True while the station is on the prism of the session."""
    return job.step is not None and job.step.kind == "poses"


def times_away(source: Connection | Reader, session_id: str) -> Iterator[tuple[Stamp, Stamp | None]]:
    """Yield start and end of each time of a session with the station on no prism, oldest first.

    Args:
        source: the store.
        session_id: the session; nothing is yielded for one that was not guided.

    Yields:
        The end is None if the time lasts, or lasted until the session's end.
    """
    found, row = guide_request(source, session_id), session(source, session_id)
    if found is None or row is None:
        return
    guide_id, request = found
    job, away = Job.of(Request.of(request)), None
    for event in guide_events(source, guide_id):
        was_on_prism, job = is_on_prism(job), job.after(event.kind, event.details)
        if job.state != "open" or job.run.session != session_id:
            continue
        if event.kind == "opened":
            away = source.stamp(row, "started_")
        elif event.kind == "aimed" and away is not None:
            yield away, event.at
            away = None
        elif was_on_prism and not is_on_prism(job):
            away = event.at
    if away is not None:
        yield away, None
