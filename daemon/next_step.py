"""The next step: what the rig is doing and what to do now, in words for the page and for the terminal.

Both are derived from the daemon's status, whose `guide` holds the current step of an open guide.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from daemon.commands import CHECK

Tone = Literal["good", "busy", "wait", "warning", "critical"]

_JOBS: Mapping[str, str] = {
    "gap": "identifying the model",
    "residual": "training the residual model",
    "report": "writing the report",
    "comparison": "comparing models",
    "drift": "comparing check shots with the live model",
}
_ENOUGH_POSES = {CHECK: 5}  # session kind -> poses that suffice for one session
_ENOUGH_USUALLY = 25
_NEW_SESSION = "`rigcal session guide --prisms NAMES`, or `rigcal session start --prism NAME`"


@dataclass(frozen=True)
class NextStep:
    """The current state and the step that follows from it.

    Attributes:
        state: what is going on, in a few words.
        tone: urgency, which sets the colour on the page.
        step: what to do next, a sentence without its full stop.
        how: terminal commands that do it; "" if none is needed.
        button: label of the page's button; None for no button.
        command: command that the button sends to the daemon; None if it opens a screen.
        arguments: of the command.
        screen: screen that the button opens; None if it sends a command.
        is_pressing: whether the step is shown in preference to alarms that are not critical.
    """

    state: str
    tone: Tone
    step: str
    how: str = ""
    button: str | None = None
    command: str | None = None
    arguments: Mapping[str, Any] = field(default_factory=dict)
    screen: str | None = None
    is_pressing: bool = True


def next_for_page(status: Mapping[str, Any]) -> dict[str, Any]:
    """Return the next step for the page's headline, coloured as critical if a critical alarm is active."""
    found = _next_step(status)
    is_critical = any(alarm["severity"] == "critical" for alarm in status["alarms"]["active"])
    return {
        "state": found.state,
        "tone": "critical" if is_critical else found.tone,
        "step": found.step[:1].upper() + found.step[1:] + ("" if found.step.endswith(".") else "."),
        "button": found.button,
        "command": found.command,
        "arguments": dict(found.arguments),
        "screen": found.screen,
    }


def next_line(status: Mapping[str, Any]) -> str:
    """Return the next step as one terminal line: the remedy of an alarm, or the step and its command."""
    found, alarms = _next_step(status), status["alarms"]["active"]
    critical = [alarm for alarm in alarms if alarm["severity"] == "critical"]
    for alarm in critical or ([] if found.is_pressing else alarms):
        return f"{alarm['subject']}: {alarm['remedy']}"
    return f"{found.step}: {found.how}" if found.how else found.step


def _next_step(status: Mapping[str, Any]) -> NextStep:
    guide = status.get("guide")  # rigcal 0.1, which may still run after an upgrade, sends neither this nor `setup`
    if guide is not None:
        return _of_guide(guide["step"])
    if status["session"] is not None:
        return _in_session(status["session"])
    if status["jobs"] or status.get("jobs_awaited"):
        return _of_jobs(status["jobs"], status.get("jobs_awaited"))
    return _between_sessions(status)


def _of_guide(step: Mapping[str, Any]) -> NextStep:
    does = step["instruction"].removesuffix(".")
    does, how = f"{does[:1].lower()}{does[1:]}", "`rigcal session guide`"
    if step["is_busy"] or step["button"] is None:
        return NextStep(step["title"], "wait" if step["is_busy"] else "busy", does, how, screen="guide")
    if step["is_detected"]:  # it ends by itself; the guide's screen shows where to go
        return NextStep(step["title"], "busy", does, how, "Open the guide", screen="guide")
    return NextStep(step["title"], "busy", does, how, step["button"], "guide.done", {"step": step["id"]})


def _in_session(session: Mapping[str, Any]) -> NextStep:
    what = f"Session {session['id']} on prism {session['prism']}: {session['poses']} poses"
    step, how = _of_session(session)
    return NextStep(what, "busy", step, how, "Open the session", screen="session")


def _of_session(session: Mapping[str, Any]) -> tuple[str, str]:
    """Return what to do in an open session, and the command for it."""
    if (hindrance := _hindrance(session)) is not None:
        return hindrance
    points = {
        phase: {s["point"] for s in session["control_shots"] if s["phase"] == phase} for phase in ("start", "end")
    }
    enough = _ENOUGH_POSES.get(session["kind"], _ENOUGH_USUALLY)
    if not points["start"] and not points["end"]:
        return "aim the station at a control point and shoot it", "`rigcal session shoot NAME`"
    if session["poses"] < enough:
        more = enough - session["poses"]
        return f"stand still at {more} more pose{'s' if more > 1 else ''}, spread over the ranges of all joints", ""
    if missing := sorted(points["start"] - points["end"]):
        return "enough poses: shoot the control points again", f"`rigcal session shoot {missing[0]}`"
    step = "enough poses: stop the session; identification, effects, residual and report then run automatically"
    return step, "`rigcal session stop`"


def _hindrance(session: Mapping[str, Any]) -> tuple[str, str] | None:
    """Return what to do before more fixes of an open session are of use, and the command for it; None for nothing."""
    if jumped := session.get("jumped"):
        why = f"{jumped[0]} has jumped, so no later fix is used"
        return f"{why}: stop the session, check the joint's zero, then start a new session", "`rigcal session stop`"
    if suspicions := session.get("prism_suspicions"):
        return str(suspicions[0]["remedy"]), ""
    if session["setup_moved"]:
        how = "`rigcal session stop`, then `rigcal setup new`"
        return "the station has moved: stop the session, then record the station's new set-up", how
    return None


def _of_jobs(jobs: Sequence[Mapping[str, Any]], awaited_session: str | None) -> NextStep:
    running = next((job for job in jobs if job["state"] == "running"), None)
    doing = "jobs are queued" if jobs else f"the jobs of session {awaited_session} are about to be queued"
    if running is not None:
        doing = f"{_JOBS.get(running['kind'], running['kind'])}, {math.floor(100 * running['progress'])} %"
    step, how = "wait for the jobs; the boom may move", "`rigcal watch` follows them, `rigcal jobs list` has results"
    return NextStep(f"Calibrating: {doing}", "wait", step, how, "See the jobs", screen="health")


def _between_sessions(status: Mapping[str, Any]) -> NextStep:
    models, drift = status["models"] or {}, (status["gap"] or {}).get("drift")
    live, candidate = models.get("live"), models.get("candidate")
    if candidate is not None and candidate["is_acceptable"]:
        what = f"Model {candidate['id']} is better and waits for you"
        how = f"`rigcal model show {candidate['id']}`, `rigcal model accept {candidate['id']}`"
        step = "review its changes, then accept it"
        return NextStep(what, "good", step, how, "Review the model", screen="models")
    is_drifting = drift is not None and drift["alarm"] == "worse"
    tone: Tone = "warning"
    if candidate is not None:
        what = f"Model {candidate['id']} waits"
    elif live is None:
        what = "No model is live"
    elif is_drifting:
        what = f"Model {live['id']} is live, but check shots show drift from it"
    else:
        what, tone = f"Ready: model {live['id']} is live", "good"
    pressing = next(_pressing(status, candidate), None)
    step, how = pressing or _to_improve(models, is_drifting=is_drifting)
    button = "Start a guided session"
    return NextStep(what, tone, step, how, button, screen="guide", is_pressing=pressing is not None)


def _pressing(status: Mapping[str, Any], candidate: Mapping[str, Any] | None) -> Iterator[tuple[str, str]]:
    """Yield steps without which the next model cannot be made or judged, the most important first."""
    setup, gap = status.get("setup"), status["gap"] or {}
    if setup is None:
        yield "record the station's set-up in a guided session", "`rigcal session guide --new-setup NAME`"
    elif setup["state"] != "ok":
        yield "record the station's set-up", "`rigcal setup new NAME --instrument TYPE`"
    if gap.get("failed") is not None:
        how = "`rigcal jobs list`, `rigcal session start`"
        yield f"job {gap['failed']['job']} failed: follow its error message, or hold another session", how
    if candidate is not None and candidate["comparison"] is None and not candidate.get("is_outdated"):
        how = "`rigcal session start --kind check --prism NAME`"
        yield "hold a check session to judge the new model", how
    verdict = gap.get("verdict")
    if verdict is not None and verdict["verdict"] == "indistinguishable" and verdict["experiments"]:
        yield f"measure what distinguishes the possible causes: {verdict['experiments'][0]}", ""


def _to_improve(models: Mapping[str, Any], *, is_drifting: bool) -> tuple[str, str]:
    """Return the step that leads to a first or a better model, and the command for it."""
    live, candidate, earlier = models.get("live"), models.get("candidate"), models.get("to_put_back")
    if candidate is not None:
        return _to_replace(candidate)
    if live is None and earlier is not None:
        step = f"put model {earlier} back, which was live before, or hold a calibration session"
        return step, f"`rigcal model rollback {earlier}`; {_NEW_SESSION}"
    if live is None:
        step = "hold a calibration session; a guided session covers all prisms and a check, and yields a first model"
        return step, f"{_NEW_SESSION}; `rigcal plan` proposes poses"
    if is_drifting:
        return "the machine has changed: measure it again", _NEW_SESSION
    return "nothing to do; an occasional check session shows whether the live model is still accurate", ""


def _to_replace(candidate: Mapping[str, Any]) -> tuple[str, str]:
    """Return the step that leads to a better model than a candidate that would be refused, and the command for it."""
    refused = f"model {candidate['id']} would be refused: {candidate['refused_because']}"
    if candidate.get("is_outdated"):
        return f"{refused}; hold a calibration session, which yields a new model", _NEW_SESSION
    if candidate["comparison"].get("is_stale"):
        return refused, ""  # the reason says how it is compared again
    return f"{refused}; hold sessions with other prisms or poses, then another check session", ""
