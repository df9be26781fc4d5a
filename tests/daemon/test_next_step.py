"""One state, one sentence and one button for whatever the daemon does."""

from typing import Any

import pytest

from daemon.next_step import next_for_page, next_line

CANDIDATE = {"id": 5, "is_acceptable": True, "refused_because": None, "comparison": {}}
LIVE = {"id": 4}


SESSION = {
    "id": "s1-r",
    "prism": "r",
    "kind": "static_poses",
    "poses": 3,
    "setup_moved": False,
    "control_shots": [{"point": "cp1", "phase": "start"}],
}


def status(**parts: Any) -> dict[str, Any]:
    quiet = {"session": None, "guide": None, "jobs": [], "models": {"live": None, "candidate": None}, "gap": None}
    return {"alarms": {"active": []}, "setup": {"state": "ok"}, **quiet, **parts}


def guide(**step: Any) -> dict[str, Any]:
    usual = {
        "id": "1.4",
        "title": "Go to pose 3 of 20",
        "instruction": "Move.",
        "button": "Measure here",
        "is_busy": False,
        "is_detected": False,
    }
    return {"id": 1, "prisms": ["r"], "step": usual | step}


@pytest.mark.parametrize(
    ("now", "state", "button"),
    [
        (status(), "No model is live", "Start a guided session"),
        (status(models={"live": LIVE, "candidate": None}), "Ready: model 4 is live", "Start a guided session"),
        (
            status(models={"live": LIVE, "candidate": None}, gap={"drift": {"alarm": "worse"}}),
            "Model 4 is live, but check shots show drift from it",
            "Start a guided session",
        ),
        (
            status(models={"live": LIVE, "candidate": CANDIDATE}),
            "Model 5 is better and waits for you",
            "Review the model",
        ),
        (status(guide=guide()), "Go to pose 3 of 20", "Measure here"),
        (status(guide=guide(is_busy=True)), "Go to pose 3 of 20", None),
        (status(guide=guide(is_detected=True)), "Go to pose 3 of 20", "Open the guide"),
        (
            status(jobs=[{"state": "running", "kind": "gap", "progress": 0.999}]),
            "Calibrating: identifying the model, 99 %",
            "See the jobs",
        ),
        (
            status(jobs_awaited="s4-check"),
            "Calibrating: the jobs of session s4-check are about to be queued",
            "See the jobs",
        ),
        (status(jobs=[{"state": "queued", "kind": "gap"}]), "Calibrating: jobs are queued", "See the jobs"),
        (
            status(session=SESSION),
            "Session s1-r on prism r: 3 poses",
            "Open the session",
        ),
    ],
)
def test_the_next_step_follows_from_what_is_going_on(now: Any, state: str, button: str | None) -> None:
    found = next_for_page(now)
    assert (found["state"], found["button"]) == (state, button)


def test_the_button_of_a_guide_names_the_step_it_is_for() -> None:
    found = next_for_page(status(guide=guide()))
    assert (found["command"], found["arguments"]) == ("guide.done", {"step": "1.4"})


def test_a_candidate_that_would_be_refused_says_why() -> None:
    candidate = {"id": 5, "is_acceptable": False, "refused_because": "no gain beyond chance", "comparison": {}}
    found = next_for_page(status(models={"live": LIVE, "candidate": candidate}))
    assert "no gain beyond chance" in found["step"]


def test_a_candidate_that_no_check_could_judge_needs_a_check_and_nothing_else() -> None:
    refused = "it was compared on no check session: hold a check session"
    candidate = {"id": 5, "is_acceptable": False, "refused_because": refused, "comparison": {"is_stale": True}}
    step = next_line(status(models={"live": LIVE, "candidate": candidate}))
    assert step == f"model 5 would be refused: {refused}"


def test_a_candidate_from_a_rejected_session_needs_a_new_session_and_no_check() -> None:
    candidate = {"id": 5, "is_acceptable": False, "refused_because": "b was rejected", "comparison": None}
    step = next_line(status(models={"live": LIVE, "candidate": candidate | {"is_outdated": True}}))
    assert step.startswith("model 5 would be refused: b was rejected; hold a calibration session, which yields a new")


def test_a_critical_alarm_colours_whatever_is_going_on() -> None:
    alarms = {"active": [{"severity": "critical"}]}
    assert next_for_page(status(alarms=alarms))["tone"] == "critical"
    assert next_for_page(status(alarms={"active": [{"severity": "warning"}]}))["tone"] == "warning"


def test_a_session_in_which_an_encoder_jumped_is_not_to_be_continued() -> None:
    now = status(session={**SESSION, "jumped": ["theta1"]})
    step = "has jumped, so no later fix is used: stop the session, check the joint's zero, then start a new session"
    assert next_for_page(now)["step"] == f"Theta1 {step}."
    assert next_line(now) == f"theta1 {step}: `rigcal session stop`"


def test_a_step_of_a_session_is_a_sentence_with_what_is_left_to_do() -> None:
    step = next_for_page(status(session=SESSION))["step"]
    assert step == "Stand still at 22 more poses, spread over the ranges of all joints."


def test_without_a_live_model_the_one_that_was_live_before_is_named() -> None:
    line = next_line(status(models={"live": None, "candidate": None, "to_put_back": 3}))
    assert "put model 3 back" in line
    assert "`rigcal model rollback 3`" in line
