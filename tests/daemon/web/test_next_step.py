"""One state, one sentence and one button for whatever the daemon does."""

from typing import Any

import pytest

from daemon.web.next_step import next_step

CANDIDATE = {"id": 5, "is_acceptable": True, "refused_because": None}
LIVE = {"id": 4}


def status(**parts: Any) -> dict[str, Any]:
    quiet = {"session": None, "jobs": [], "models": {"live": None, "candidate": None}, "gap": None}
    return {"alarms": {"active": []}, **quiet, **parts}


def guide(**step: Any) -> dict[str, Any]:
    usual = {
        "id": "1.4",
        "title": "Go to pose 3 of 20",
        "instruction": "Move.",
        "button": "Measure here",
        "is_busy": False,
    }
    return {"state": "open", "step": usual | step}


@pytest.mark.parametrize(
    ("now", "of_guide", "state", "button"),
    [
        (status(), None, "No model is live yet", "Start a guided session"),
        (status(models={"live": LIVE, "candidate": None}), None, "Ready: model 4 is live", "Start a guided session"),
        (
            status(models={"live": LIVE, "candidate": None}, gap={"drift": {"alarm": "worse"}}),
            None,
            "Model 4 is live, and check shots drift from it",
            "Start a guided session",
        ),
        (
            status(models={"live": LIVE, "candidate": CANDIDATE}),
            None,
            "Model 5 is better and waits for you",
            "Review the model",
        ),
        (status(), guide(), "Go to pose 3 of 20", "Measure here"),
        (status(), guide(is_busy=True), "Go to pose 3 of 20", None),
        (status(), guide() | {"state": "finished"}, "No model is live yet", "Start a guided session"),
        (
            status(jobs=[{"state": "running", "kind": "gap", "progress": 0.999}]),
            None,
            "Calibrating: identifying the model, 99 %",
            "See the jobs",
        ),
        (status(jobs=[{"state": "queued", "kind": "gap"}]), None, "Calibrating: jobs are queued", "See the jobs"),
        (
            status(session={"id": "s1-r", "prism": "r", "poses": 3}),
            None,
            "Session s1-r on prism r: 3 poses",
            "Open the session",
        ),
    ],
)
def test_the_next_step_follows_from_what_is_going_on(now: Any, of_guide: Any, state: str, button: str | None) -> None:
    found = next_step(now, of_guide)
    assert (found["state"], found["button"]) == (state, button)


def test_the_button_of_a_guide_names_the_step_it_is_for() -> None:
    found = next_step(status(), guide())
    assert (found["command"], found["arguments"]) == ("guide.done", {"step": "1.4"})


def test_a_candidate_that_would_be_refused_says_why() -> None:
    candidate = {"id": 5, "is_acceptable": False, "refused_because": "no gain beyond chance"}
    found = next_step(status(models={"live": LIVE, "candidate": candidate}), None)
    assert "no gain beyond chance" in found["step"]


def test_a_critical_alarm_colours_whatever_is_going_on() -> None:
    alarms = {"active": [{"severity": "critical"}]}
    assert next_step(status(alarms=alarms), None)["tone"] == "critical"
    assert next_step(status(alarms={"active": [{"severity": "warning"}]}), None)["tone"] == "warning"
