"""Background jobs and the live model."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence


@rule("warning", "Do what the error says, then `rigcal jobs retry SUBJECT`; too few data need another session instead.")
def job_failed(evidence: Evidence) -> Iterator[Finding]:
    """A job has failed or was given up, and is the newest of its kind that has.

    Cleared when it is retried, or when a newer one of its kind is done.
    """
    for job in evidence.failed_jobs:
        yield str(job.id), f"job {job.id} ({job.kind}) has failed: {job.error}"


@rule("warning", "Calibrate again; `rigcal status` and the report of the gap workflow tell what has changed.")
def model_drifted(evidence: Evidence) -> Iterator[Finding]:
    """Check sessions show that the machine has left the live model.

    Cleared when another model goes live.
    """
    if evidence.model is not None and evidence.model.drifted_with is not None:
        yield (
            f"model {evidence.model.id}",
            f"the machine has left the live model, by session {evidence.model.drifted_with}",
        )


@rule("critical", "Put another model live with `rigcal model rollback`, or calibrate again.", hold_s=10.0)
def model_unusable(evidence: Evidence) -> Iterator[Finding]:
    """The live model is damaged or is of another rig file: there is no tip."""
    if evidence.model is not None and evidence.model.defect:
        yield f"model {evidence.model.id}", evidence.model.defect
