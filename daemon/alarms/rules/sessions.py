"""Station set-ups and calibration sessions, their background jobs, and the live model that comes of them."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence

WITHOUT_FIX_S = 600.0
LONG_S = 86_400.0


@rule("warning", "Describe where the station stands now with `rigcal setup new`, and hold a new session.")
def setup_moved(evidence: Evidence) -> Iterator[Finding]:
    """The set-up that the station stands in has moved: a control point is not where it was.

    It is that of the open session or guide, else the one that was described, or used for a session, last. Critical
    while a session is open. Cleared when no session is open there and another set-up is described or used.
    """
    if evidence.setup is not None and evidence.setup.state == "moved":
        text = "the station has moved: its control points no longer fit"
        yield evidence.setup.id, text, "warning" if evidence.session is None else "critical"


@rule("warning", "Look at the station with `rigcal status`, or close the session with `rigcal session stop`.")
def session_without_fixes(evidence: Evidence) -> Iterator[Finding]:
    """A session is open and no station has given a good fix for 10 minutes."""
    session = evidence.session
    if session is None:
        return
    good_s = [s.good_age_s for s in evidence.acquisition.stations if s.good_age_s is not None]
    if min(evidence.session_age_s, evidence.running_s, *good_s) > WITHOUT_FIX_S:
        yield session.id, f"no good fix for {WITHOUT_FIX_S / 60:g} minutes"


@rule("warning", "Close it with `rigcal session stop`, or `rigcal session abort` if it is of no use.")
def session_open_long(evidence: Evidence) -> Iterator[Finding]:
    """A session has been open for more than 24 hours; no job runs meanwhile."""
    if evidence.session is not None and evidence.session_age_s > LONG_S:
        yield evidence.session.id, "the session has been open for more than 24 hours, and jobs wait for its end"


@rule("warning", "Hold a new session with control shots at both ends, or accept it: `rigcal session accept SUBJECT`.")
def session_not_trained(evidence: Evidence) -> Iterator[Finding]:
    """Calibration does not use a closed session: control shots are missing at its start or end, or the station moved.

    Cleared when an operator accepts it, and by a newer session that is used.
    """
    for name, why in evidence.untrained_sessions.items():
        yield name, f"calibration does not use the session: {why}"


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
    """The live model is damaged or is of another rig file: there is no tip.

    Cleared when another model goes live, or its files are as they were: they are looked at every 30 s.
    """
    if evidence.model is not None and evidence.model.defect:
        yield f"model {evidence.model.id}", evidence.model.defect


@rule(
    "critical", "Put right what the text says the computer lacks; rigcal loads the model by itself then.", hold_s=10.0
)
def model_not_loaded(evidence: Evidence) -> Iterator[Finding]:
    """The computer cannot load the live model, for want of memory or descriptors or by a fault of its disk: no tip.

    The model may be sound. It is tried again every 30 s.
    """
    if evidence.model is not None and evidence.model.hindrance:
        yield f"model {evidence.model.id}", evidence.model.hindrance


@rule(
    "critical",
    "Check the joint's zero; then `rigcal model zeros-checked` (`rigcal session accept` before the first model), or "
    "calibrate again.",
    hold_s=10.0,
)
def zero_lost(evidence: Evidence) -> Iterator[Finding]:
    """The encoder of a joint has jumped, and nobody has checked its zero.

    It has jumped since the live model was trained, since the newest session was begun, or in the open session: the
    model gives no tip, no job uses the sessions from before it, the open session takes no more fixes. Cleared 10 s
    after none of these holds.
    """
    model = () if evidence.model is None else evidence.model.jumped
    session = () if evidence.session is None else evidence.session.jumped
    for joint in dict.fromkeys((*model, *session, *evidence.zeros_lost)):
        yield joint, f"{joint} has jumped by more than it can move; its zero is not what it was"
