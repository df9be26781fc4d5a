"""Decides which jobs are due, as a pure function of the store's contents and the time. It starts nothing.

A closed session triggers the gap workflow, which identifies the kinematics and adds the effects that the simulation
lacks, then residual training. The report and the comparison with the live model follow, independent of each other.
A closed check session triggers only report and comparison. Its poses are not trained on, and the live model is checked
for drift on it. Once the checks show drift of the live model, the whole chain runs on all sessions, checks included.
A session that no control points confirm triggers nothing until an operator accepts it. A candidate that was compared
with a model that is no longer live is compared again, once for each change of the live model. Jobs wait while a session
is open: acquisition comes first.

The order of sessions decides which sessions a job covers, never time: a wall clock may be wrong for a whole boot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from daemon.commands import CHECK
from daemon.store.queries.jobs import JobFacts, JobKind, SessionFacts
from drivers.clock import NS_PER_S, Stamp

CHECKS = (JobKind.REPORT, JobKind.COMPARISON)
CHAIN = (JobKind.GAP, JobKind.RESIDUAL, *CHECKS)
DRIFT = (JobKind.DRIFT,)
_QUIET_S = 2.0  # after a session's end: its jobs wait in case a new session starts
_QUIET_IN_GUIDE_S = 60.0  # the same while a guide is open, which goes on to the next prism by itself
# An interrupted job waits for this time multiplied by its attempts and interruptions, so that a job that kills the
# daemon or the computer does not do so continuously.
_RETRY_AFTER_S = 5.0
# A job is not to blame for power cuts, but a job that exhausts the computer until it restarts must be abandoned.
MAX_INTERRUPTIONS = 20


@dataclass(frozen=True)
class State:
    """The contents of the store that scheduling depends on.

    Attributes:
        sessions: sessions that calibration may use, in the order of their start; those older than the newest of the
            same kind and state may be left out.
        jobs: jobs that are not yet done, failed or cancelled, in the order of their creation.
        covered: kind of job -> number of the newest session that was closed when the newest job of that kind was
            queued; that job uses this session and all before it. No entry if there is no such job, or if an operator
            has accepted a session since, which the job does not include.
        has_model: whether there is a model that a check session can be compared with.
        live_from: number of the newest session when the live model went live; None without a live model. Check
            sessions after it count for drift.
        drifted: number and id of the check session that showed drift of the live model; None if there is no drift.
        stale_candidate: number of the candidate model if it was compared with a model that is no longer live and no
            comparison with the live one was queued yet; else None.
        has_guide: whether a guide is open.
    """

    sessions: Sequence[SessionFacts]
    jobs: Sequence[JobFacts]
    covered: Mapping[JobKind, int]
    has_model: bool
    live_from: int | None = None
    drifted: tuple[int, str] | None = None
    stale_candidate: int | None = None
    has_guide: bool = False


@dataclass(frozen=True)
class DueChain:
    """Jobs to queue: each training job depends on the one before it, and CHECKS depend on the last training job.

    Attributes:
        kinds: kinds of the jobs.
        session_id: the session that triggers them; a check session triggers CHAIN if it shows drift.
        through_id: they use the closed sessions up to and including this one.
    """

    kinds: tuple[JobKind, ...]
    session_id: str
    through_id: str


@dataclass(frozen=True)
class DueRetry:
    """An interrupted job to queue again."""

    job_id: int


@dataclass(frozen=True)
class DueComparison:
    """A candidate to compare with the live model."""

    model_id: int


Due = DueChain | DueRetry | DueComparison


def due_jobs(state: State, now: Stamp, *, max_attempts: int = 3) -> list[Due]:
    """Return the jobs that should be queued now.

    Args:
        state: the store's contents.
        now: current time; durations are measured on the monotonic clock, within one boot.
        max_attempts: an interrupted job that was started this many times is not queued again.
    """
    if _is_open(state):
        return []
    due: list[Due] = [
        DueRetry(job.id)
        for job in state.jobs
        if job.state == "interrupted"
        and not _is_spent(job, max_attempts)
        and _passed(job.ended, now, _RETRY_AFTER_S * (job.attempts + job.interruptions))
    ]
    closed = _closed(state)
    quiet_s = _QUIET_IN_GUIDE_S if state.has_guide else _QUIET_S
    if closed and _passed(closed[-1].ended, now, quiet_s):
        due += _due_after(closed, state)
    return due


def awaited_session(state: State) -> str | None:
    """Return the closed session that will trigger jobs unless a new session starts; None if there is none."""
    if _is_open(state):
        return None
    chains = (item for item in _due_after(_closed(state), state) if isinstance(item, DueChain))
    return next((chain.session_id for chain in chains), None)


def _closed(state: State) -> list[SessionFacts]:
    return [session for session in state.sessions if session.state == "closed"]


def _due_after(closed: Sequence[SessionFacts], state: State) -> list[Due]:
    """Return what the closed sessions trigger once no session has started for long enough."""
    due: list[Due] = []
    training = [s for s in closed if s.kind != CHECK]
    checks = [s for s in closed if s.kind == CHECK]
    if training and not _is_covered(training[-1], JobKind.GAP, state):
        due.append(DueChain(CHAIN, training[-1].id, closed[-1].id))  # its report evaluates the model on the checks
    elif state.drifted is not None and state.covered.get(JobKind.GAP, 0) < state.drifted[0]:
        due.append(DueChain(CHAIN, state.drifted[1], closed[-1].id))
    elif checks and state.has_model and not _is_covered(checks[-1], JobKind.REPORT, state):
        due.append(DueChain(CHECKS, checks[-1].id, closed[-1].id))
    if checks and _counts_for_drift(checks[-1], state) and not _is_covered(checks[-1], JobKind.DRIFT, state):
        due.append(DueChain(DRIFT, checks[-1].id, closed[-1].id))
    if checks and state.stale_candidate is not None and not _is_being_compared(state, due):
        due.append(DueComparison(state.stale_candidate))
    return due


def spent_jobs(state: State, *, max_attempts: int = 3) -> list[JobFacts]:
    """Return the interrupted jobs that were started or interrupted too often to be queued again."""
    return [job for job in state.jobs if job.state == "interrupted" and _is_spent(job, max_attempts)]


def next_job(state: State) -> JobFacts | None:
    """Return the first queued job whose predecessor is done.

    None while a session is open or a job runs: running one job at a time leaves a core for acquisition.
    """
    if _is_open(state) or any(job.state == "running" for job in state.jobs):
        return None
    return next((job for job in state.jobs if job.state == "queued" and job.is_ready), None)


def _is_spent(job: JobFacts, max_attempts: int) -> bool:
    return job.attempts >= max_attempts or job.interruptions >= MAX_INTERRUPTIONS


def _is_being_compared(state: State, due: Sequence[Due]) -> bool:
    """Return True if a comparison is pending or about to be queued, whose outcome must be known first."""
    return any(job.kind is JobKind.COMPARISON for job in state.jobs) or any(
        isinstance(item, DueChain) and JobKind.COMPARISON in item.kinds for item in due
    )


def _is_open(state: State) -> bool:
    return any(s.state == "open" for s in state.sessions)


def _is_covered(session: SessionFacts, kind: JobKind, state: State) -> bool:
    """Return True if a job of this kind was queued after the session was closed, and so includes it."""
    return kind in state.covered and state.covered[kind] >= session.number


def _counts_for_drift(check: SessionFacts, state: State) -> bool:
    return state.live_from is not None and check.number > state.live_from


def _passed(since: Stamp | None, now: Stamp, seconds: float) -> bool:
    """Return True if `seconds` have passed; always true after a reboot or when a log is replayed again."""
    if since is None or since.boot_id != now.boot_id:
        return True
    return not 0 <= now.monotonic_ns - since.monotonic_ns < seconds * NS_PER_S
