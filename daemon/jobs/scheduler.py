"""Which jobs are due: a pure function of what the store holds and of the time. It starts nothing.

A closed session triggers the gap workflow, which identifies the kinematics and adds what the simulation lacks, then
residual training, and of that model the report and the comparison with the live one, which do not wait for each other.
A closed check session triggers report and comparison alone, its poses are not trained on, and the live model is held
against it. Once the checks have drifted from the live model, the chain runs on all that was measured, checks included.
A session that no control points vouch for triggers nothing until an operator accepts it. A candidate that was compared
with a model that is live no more is compared again, once for each model that goes live. Work waits while a session is
open: acquisition comes first.

What a job covers is decided by the order of sessions, never by time: a wall clock may be wrong for whole boots.
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
_QUIET_S = 2.0  # after a session's end: its jobs wait for a next session to begin
_QUIET_IN_GUIDE_S = 60.0  # the same where a guide is open, which goes on to the next prism by itself
# An interrupted job waits this long times its attempts and interruptions, so that one that kills the daemon or the
# computer does not do so without pause.
_RETRY_AFTER_S = 5.0
# A job is not to blame for power cuts; one that exhausts the computer until it restarts must end all the same.
MAX_INTERRUPTIONS = 20


@dataclass(frozen=True)
class State:
    """The contents of the store, as far as they can still matter.

    Attributes:
        sessions: those that calibration may use, in the order they were started; those older than the newest of their
            kind and state may be left out.
        jobs: those that have not ended for good, in the order they were created.
        covered: kind of job -> number of the newest session that was closed when the newest job of the kind was
            queued: that job works on it and on all before it. No entry where there is no such job, or where an
            operator has accepted a session since, which the job does not know of.
        has_model: a model exists that a check session could be held against.
        live_from: number of the newest session when the live model went live; None without one. Checks after it count
            for drift.
        drifted: number and id of the check session with which the live model was found to have drifted; None before.
        stale_candidate: the model that waits to be accepted, where its comparison is with another model than the live
            one and none with the live one was queued yet.
        has_guide: a guide is open.
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
    """Jobs to queue: those that train each to run after the one before it is done, CHECKS after the last of them.

    Attributes:
        kinds: what to run.
        session_id: the session that triggers them; a check session triggers CHAIN because it has drifted.
        through_id: they work on the sessions closed up to and including this one.
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
    """Return all that should be queued now.

    Args:
        state: what the store holds.
        now: the present instant; durations are taken on the monotonic clock, within one boot.
        max_attempts: an interrupted job that was started this often is not offered again.
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
    """Return the session that has ended and will trigger jobs unless a next one begins; None without one."""
    if _is_open(state):
        return None
    chains = (item for item in _due_after(_closed(state), state) if isinstance(item, DueChain))
    return next((chain.session_id for chain in chains), None)


def _closed(state: State) -> list[SessionFacts]:
    return [session for session in state.sessions if session.state == "closed"]


def _due_after(closed: Sequence[SessionFacts], state: State) -> list[Due]:
    """Return what the sessions that have ended trigger, once it has been quiet for long enough."""
    due: list[Due] = []
    training = [s for s in closed if s.kind != CHECK]
    checks = [s for s in closed if s.kind == CHECK]
    if training and not _is_covered(training[-1], JobKind.GAP, state):
        due.append(DueChain(CHAIN, training[-1].id, closed[-1].id))  # its report holds the model against the checks
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
    """Interrupted jobs that were started or interrupted so often that they are not offered again."""
    return [job for job in state.jobs if job.state == "interrupted" and _is_spent(job, max_attempts)]


def next_job(state: State) -> JobFacts | None:
    """The first queued job whose predecessor is done.

    None while a session is open, and while a job runs: one at a time leaves a core for acquisition.
    """
    if _is_open(state) or any(job.state == "running" for job in state.jobs):
        return None
    return next((job for job in state.jobs if job.state == "queued" and job.is_ready), None)


def _is_spent(job: JobFacts, max_attempts: int) -> bool:
    return job.attempts >= max_attempts or job.interruptions >= MAX_INTERRUPTIONS


def _is_being_compared(state: State, due: Sequence[Due]) -> bool:
    """True if a comparison is under way or about to be queued: its outcome is waited for."""
    return any(job.kind is JobKind.COMPARISON for job in state.jobs) or any(
        isinstance(item, DueChain) and JobKind.COMPARISON in item.kinds for item in due
    )


def _is_open(state: State) -> bool:
    return any(s.state == "open" for s in state.sessions)


def _is_covered(session: SessionFacts, kind: JobKind, state: State) -> bool:
    """True if a job of this kind was queued after the session had been closed, and so works on it."""
    return kind in state.covered and state.covered[kind] >= session.number


def _counts_for_drift(check: SessionFacts, state: State) -> bool:
    return state.live_from is not None and check.number > state.live_from


def _passed(since: Stamp | None, now: Stamp, seconds: float) -> bool:
    """True if `seconds` have passed; across a reboot, or when a log is replayed once more, they have."""
    if since is None or since.boot_id != now.boot_id:
        return True
    return not 0 <= now.monotonic_ns - since.monotonic_ns < seconds * NS_PER_S
