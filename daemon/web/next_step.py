"""What the rig is doing and what to do next: one line, one sentence and one button, from the daemon's status."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Tone = Literal["good", "busy", "wait", "warning", "critical"]

_JOBS: Mapping[str, str] = {
    "gap": "identifying the model",
    "residual": "learning what remains",
    "report": "writing the report",
    "comparison": "comparing models",
    "drift": "holding check shots against the live model",
}


@dataclass(frozen=True)
class NextStep:
    """What to show large.

    Attributes:
        state: what is going on, one line.
        tone: how urgent it looks.
        step: what to do next, a sentence.
        button: its text; None where nothing is to be pressed.
        command, arguments: what the button sends to the daemon; None where it opens a screen.
        screen: what the button opens; None where it sends a command.
    """

    state: str
    tone: Tone
    step: str
    button: str | None = None
    command: str | None = None
    arguments: Mapping[str, Any] = field(default_factory=dict)
    screen: str | None = None


def next_step(status: Mapping[str, Any], guide: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the next step as the page has it.

    Args:
        status: the daemon's.
        guide: the newest guide; None without one.
    """
    found = _next_step(status, guide)
    if found.tone != "critical" and any(alarm["severity"] == "critical" for alarm in status["alarms"]["active"]):
        found = NextStep(**{**vars(found), "tone": "critical"})
    return asdict(found)


def _next_step(status: Mapping[str, Any], guide: Mapping[str, Any] | None) -> NextStep:
    if guide is not None and guide["state"] == "open":
        return _of_guide(guide)
    session, jobs, models = status["session"], status["jobs"], status["models"]
    if session is not None:
        what = f"Session {session['id']} on prism {session['prism']}: {session['poses']} poses"
        step = "Stand still at each pose until it counts; shoot the control points first and last."
        return NextStep(what, "busy", step, "Open the session", screen="session")
    if any(job["state"] in ("running", "queued") for job in jobs):
        return _of_jobs(jobs)
    drift = (status["gap"] or {}).get("drift")
    return _of_models(
        models or {"candidate": None, "live": None}, is_drifting=bool(drift and drift["alarm"] == "worse")
    )


def _of_jobs(jobs: Sequence[Mapping[str, Any]]) -> NextStep:
    running = next((job for job in jobs if job["state"] == "running"), None)
    doing = "jobs are queued"
    if running is not None:
        doing = f"{_JOBS.get(running['kind'], running['kind'])}, {math.floor(100 * running['progress'])} %"
    step = "Nothing to do; the boom may move."
    return NextStep(f"Calibrating: {doing}", "wait", step, "See the jobs", screen="health")


def _of_models(models: Mapping[str, Any], *, is_drifting: bool) -> NextStep:
    candidate, live = models["candidate"], models["live"]
    if candidate is not None and candidate["is_acceptable"]:
        what = f"Model {candidate['id']} is better and waits for you"
        return NextStep(what, "good", "Look at what it changes, then accept it.", "Review the model", screen="models")
    tone: Tone = "warning"
    if candidate is not None:
        what, step = f"Model {candidate['id']} waits", f"It would be refused now: {candidate['refused_because']}"
    elif live is None:
        what, step = "No model is live yet", "A guided session leads through all prisms and a check to a first model."
    elif is_drifting:
        what, step = f"Model {live['id']} is live, and check shots drift from it", "The machine has changed: measure."
    else:
        what, step = f"Ready: model {live['id']} is live", "Check shots now and then show whether it still holds."
        tone = "good"
    return NextStep(what, tone, step, "Start a guided session", screen="guide")


def _of_guide(guide: Mapping[str, Any]) -> NextStep:
    step = guide["step"]
    if step["is_busy"] or step["button"] is None:
        return NextStep(step["title"], "wait" if step["is_busy"] else "busy", step["instruction"], screen="guide")
    arguments = {"step": step["id"]}
    return NextStep(step["title"], "busy", step["instruction"], step["button"], "guide.done", arguments)
