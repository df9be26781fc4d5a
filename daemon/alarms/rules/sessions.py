"""Station set-ups and calibration sessions, their background jobs, and the live model that results."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.alarms.alarm import Finding, rule
from daemon.alarms.evidence import Evidence
from daemon.commands import NO_POSE

WITHOUT_FIX_S = 600.0
LONG_S = 86_400.0


@rule(
    "warning",
    "End what is open: a guide with `rigcal session guide --stop REASON`, otherwise a session with "
    "`rigcal session stop`. Then describe the station's new set-up with `rigcal setup new`, and hold a new session.",
)
def setup_moved(evidence: Evidence) -> Iterator[Finding]:
    """The station's set-up has moved: a control point is no longer where it was.

    The set-up is that of the open session or guide; otherwise the one last described or used for a session. Critical
    while a session is open. Cleared when no session is open in it and another set-up is described or used.
    """
    if evidence.setup is not None and evidence.setup.state == "moved":
        text = "the station has moved: its control points no longer fit"
        yield evidence.setup.id, text, "warning" if evidence.session is None else "critical"


@rule("warning", "Check the station with `rigcal status`, or close the session with `rigcal session stop`.")
def session_without_fixes(evidence: Evidence) -> Iterator[Finding]:
    """A session is open and no station has given a good fix for 10 minutes."""
    session = evidence.session
    if session is None:
        return
    good_s = [s.good_age_s for s in evidence.acquisition.stations if s.good_age_s is not None]
    if min(evidence.session_age_s, evidence.running_s, *good_s) > WITHOUT_FIX_S:
        yield session.id, f"no good fix for {WITHOUT_FIX_S / 60:g} minutes"


@rule("warning", "Close it with `rigcal session stop`, or with `rigcal session abort` if it is unusable.")
def session_open_long(evidence: Evidence) -> Iterator[Finding]:
    """A session has been open for more than 24 hours; no job runs meanwhile."""
    if evidence.session is not None and evidence.session_age_s > LONG_S:
        yield evidence.session.id, "the session has been open for more than 24 hours, and jobs wait for its end"


@rule(
    "warning",
    "If the alarm stays, check with `rigcal doctor` whether the computer is overloaded. To go on without poses of this "
    "prism, use `rigcal session guide --rest REASON`.",
)
def gain_meter_hangs(evidence: Evidence) -> Iterator[Finding]:
    """The process that chooses the poses of the open guide did not answer in time, and was restarted.

    It has 2 minutes to answer, and 3 s more for each pose to choose. Cleared when it answers, or when the guide ends.
    """
    if evidence.meter_fault is not None:
        yield "guide", evidence.meter_fault


@rule(
    "warning",
    "Hold a new session with control shots at its start and end, or accept this one with "
    "`rigcal session accept SUBJECT`. `rigcal session reject SUBJECT` ends the alarm, too.",
)
def session_not_trained(evidence: Evidence) -> Iterator[Finding]:
    """Calibration does not use a closed session: control shots are missing at its start or end, or the station moved.

    Cleared when an operator accepts or rejects the session, or when a newer session is used.
    """
    for name, why in evidence.untrained_sessions.items():
        text = f"calibration does not use the session: {why}"
        if NO_POSE in why:
            yield name, text, None, "Hold a new session. `rigcal session reject SUBJECT` ends the alarm, too."
        else:
            yield name, text


@rule(
    "warning",
    "Follow the error text, then run `rigcal jobs retry SUBJECT`. If there are too few data, hold another session "
    "instead.",
)
def job_failed(evidence: Evidence) -> Iterator[Finding]:
    """A job has failed or was abandoned; only the newest such job of each kind raises the alarm.

    Cleared when it is retried, or when a newer job of its kind is done.
    """
    for job in evidence.failed_jobs:
        yield str(job.id), f"job {job.id} ({job.kind}) has failed: {job.error}"


@rule("warning", "Calibrate again. `rigcal status` and the report of the gap workflow show what has changed.")
def model_drifted(evidence: Evidence) -> Iterator[Finding]:
    """Check sessions show that the machine no longer matches the live model.

    Cleared when another model goes live.
    """
    if evidence.model is not None and evidence.model.drifted_with is not None:
        yield (
            f"model {evidence.model.id}",
            f"the machine no longer matches the live model, as session {evidence.model.drifted_with} shows",
        )


@rule(
    "warning",
    "Accept a model that was trained without the session, once there is one, or return to an earlier model with "
    "`rigcal model rollback NUMBER`; `rigcal model list` shows all. `rigcal model reject NUMBER` takes this one out of "
    "use at once.",
)
def model_of_rejected_session(evidence: Evidence) -> Iterator[Finding]:
    """The live model was trained on a session that an operator has rejected since.

    Cleared when another model goes live, or when the session is accepted again.
    """
    if evidence.model is not None and evidence.model.rejected is not None:
        yield (
            f"model {evidence.model.id}",
            f"the live model was trained on session {evidence.model.rejected}, which has been rejected",
        )


@rule(
    "critical",
    "`rigcal model list` shows the other models: one that was live before goes live again with "
    "`rigcal model rollback NUMBER`, a candidate with `rigcal model compare NUMBER` and then "
    "`rigcal model accept NUMBER`. Or calibrate again.",
    hold_s=10.0,
)
def model_unusable(evidence: Evidence) -> Iterator[Finding]:
    """The live model is damaged or belongs to another rig file: there is no tip.

    Cleared when another model goes live, or when the model's files are intact again; they are checked every 30 s.
    """
    if evidence.model is not None and evidence.model.defect:
        yield f"model {evidence.model.id}", evidence.model.defect


@rule("critical", "Provide what the alarm says the computer lacks; rigcal then loads the model by itself.", hold_s=10.0)
def model_not_loaded(evidence: Evidence) -> Iterator[Finding]:
    """The computer cannot load the live model, for lack of memory or descriptors or a disk fault: there is no tip.

    The model itself may be sound. Loading is retried every 30 s.
    """
    if evidence.model is not None and evidence.model.hindrance:
        yield f"model {evidence.model.id}", evidence.model.hindrance


@rule(
    "critical",
    "If a session was open at the jump, stop it: no fix since the jump is used. Check the joint's zero. Where it is as "
    "before, run `rigcal model zeros-checked`; otherwise, and before the first model, start a new session and "
    "calibrate again.",
    hold_s=3.0,
)
def zero_lost(evidence: Evidence) -> Iterator[Finding]:
    """The encoder of a joint has jumped or was exchanged, and nobody has checked its zero.

    This happened since the live model was trained, since the newest session was started, or in the open session.
    Aborted and rejected sessions do not count. The model then gives no tip, no job uses sessions from before the jump,
    and the open session takes no more fixes. Cleared 3 s after none of these conditions holds.
    """
    unchecked = dict.fromkeys((*(() if evidence.model is None else evidence.model.jumped), *evidence.zeros_lost))
    session = () if evidence.session is None else evidence.session.jumped
    for joint in dict.fromkeys((*unchecked, *session)):
        is_confirmed = joint not in unchecked and evidence.model is not None
        what = "the open session takes no more fixes" if is_confirmed else "its zero is no longer valid"
        yield joint, f"{joint} has jumped by more than it can move, or its encoder was exchanged; {what}"
