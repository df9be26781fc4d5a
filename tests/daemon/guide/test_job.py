"""The state machine of a guide, without a daemon."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import pytest

from daemon.guide.job import Job, Request
from daemon.guide.stop_rule import LEAST_POSES, Forecast, least_poses, stop_reason

POSES = [{"theta1": float(n)} for n in range(3)]
REQUEST = Request(("cp1", "cp2"), ("r", "s"), 3, 3)


class Story:
    """A job and the events that led to its state."""

    def __init__(self, request: Request = REQUEST) -> None:
        self.job, self.events = Job.of(request), list[tuple[str, Mapping[str, Any]]]()

    def __call__(self, kind: str, **details: Any) -> Job:
        self.events.append((kind, details))
        self.job = self.job.after(kind, details)
        return self.job

    def to_poses(self) -> Job:
        """Everything up to the first pose of the run that is on."""
        self("opened", session=f"s{self.job.at}", last=0)
        for _ in self.job.request.control_points:
            assert self.job.step is not None
            self("shot", point=self.job.step.point, misclosure_mm=0.5)
        self("aimed")
        return self("planned", poses=POSES) if self.job.run.poses is None else self.job

    def to_end_of_run(self) -> Job:
        while not self.job.is_enough:
            self("measured", pose="1.1", last=7)
        self("left")
        for _ in self.job.request.control_points:
            assert self.job.step is not None
            self("shot", point=self.job.step.point, misclosure_mm=0.5)
        return self("closed", session=self.job.run.session)


def test_a_job_has_a_session_for_each_prism_and_a_check_on_the_last() -> None:
    story = Story()
    seen = []
    while story.job.state == "open":
        seen.append((story.job.run.prism, story.job.run.kind))
        story.to_poses()
        story.to_end_of_run()
    assert seen == [("r", "static_poses"), ("s", "static_poses"), ("s", "check")]
    assert story.job.state == "finished"
    assert story.job.sessions == ("s0", "s1", "s2")


def test_the_point_that_a_session_ends_with_begins_the_next() -> None:
    runs = Job.of(REQUEST).runs
    shots = [[step.point for step in run.steps if step.kind == "shoot_control_point"] for run in runs]
    assert shots == [["cp1", "cp2", "cp1", "cp2"], ["cp2", "cp1", "cp2", "cp1"], ["cp1", "cp2", "cp1", "cp2"]]


def test_every_state_follows_from_the_stored_request_and_events() -> None:
    story = Story()
    story.to_poses()
    story("measured", pose="1.4", last=31)
    story("skipped", reason="a wall", rest=False)
    story("failed", text="no fix")
    again = Job.of(Request.of(json.loads(json.dumps(REQUEST.as_dict()))))
    for kind, details in story.events:
        again = again.after(kind, json.loads(json.dumps(details)))
    assert again == story.job
    assert again.step_id == "1.4.3"
    assert again.trouble == "no fix"


def test_every_step_and_pose_has_an_id_of_its_own() -> None:
    story = Story()
    ids = [story.job.step_id]
    story.to_poses()
    while story.job.state == "open":
        ids.append(story.job.step_id)
        if story.job.step is not None and story.job.step.kind == "poses" and not story.job.is_enough:
            story("measured", pose="1.1", last=1)
        elif story.job.step is not None and story.job.step.kind == "poses":
            story("left")
        elif story.job.step is not None and story.job.step.kind == "close":
            story("closed", session="s")
            if story.job.state == "open":
                story.to_poses()
        else:
            story("shot", point="cp", misclosure_mm=None)
    assert len(set(ids)) == len(ids)


def test_skipped_poses_and_steps_keep_their_reason() -> None:
    story = Story()
    story("opened", session="s0", last=0)
    job = story("skipped", reason="fog", rest=False)
    assert (job.run.steps[0].state, job.run.steps[0].reason) == ("skipped", "fog")
    story("shot", point="cp2", misclosure_mm=None)
    story("aimed")
    story("planned", poses=POSES)
    job = story("skipped", reason="a wall", rest=False)
    assert job.run.poses is not None
    assert (job.run.poses[0].state, job.run.poses[0].reason) == ("skipped", "a wall")
    story("measured", pose="1.2", last=9)
    job = story("skipped", reason="dinner", rest=True)
    assert job.step is not None
    assert job.step.phase == "end"
    assert [pose.state for pose in job.run.poses or ()] == ["skipped", "done", "skipped"]


def test_a_prism_that_is_skipped_leaves_out_its_session_and_nothing_else() -> None:
    story = Story()
    story("opened", session="s0", last=0)
    story("shot", point="cp1", misclosure_mm=None)
    story("shot", point="cp2", misclosure_mm=None)
    job = story("skipped", reason="prism r is broken", rest=False)
    assert job.run.prism == "s"
    assert {step.reason for step in job.runs[0].steps if step.state == "skipped"} == {"prism r is broken"}


def test_more_poses_come_after_those_that_are_left_and_silence_the_stop_rule() -> None:
    story = Story()
    story.to_poses()
    story("measured", pose="1.1", last=1)
    assert story("enough", reason="it is enough").is_enough
    job = story("more", poses=[{"theta1": 9.0}])
    assert not job.is_enough
    assert job.run.upcoming(9) == [*POSES[1:], {"theta1": 9.0}]
    assert job.run.least == 4


@pytest.mark.parametrize(
    ("kind", "details"),
    [
        ("measured", {"pose": "1", "last": 1}),
        ("left", {}),
        ("aimed", {}),
        ("closed", {"session": "s"}),
        ("nonsense", {}),
    ],
)
def test_events_that_cannot_have_happened_are_refused(kind: str, details: Mapping[str, Any]) -> None:
    with pytest.raises(ValueError, match=kind):
        Job.of(REQUEST).after(kind, details)


def test_nothing_happens_in_a_guide_that_is_over() -> None:
    job = Job.of(REQUEST).after("stopped", {"reason": "rain"})
    assert (job.state, job.ended_because, job.step) == ("abandoned", "rain", None)
    with pytest.raises(ValueError, match="abandoned"):
        job.after("aimed", {})


def test_a_plan_gives_each_prism_the_poses_in_which_it_is_in_view() -> None:
    plan = (({"theta1": 1.0}, ("r",)), ({"theta1": 2.0}, ("r", "s")))
    runs = Job.of(Request(("cp1",), ("r", "s"), 20, 4, plan=plan)).runs
    assert [run.most for run in runs] == [2, 1, 4]
    assert [run.poses is None for run in runs] == [False, False, True]


def test_the_prisms_of_a_guide_share_the_poses_that_a_calibration_needs() -> None:
    job = Job.of(Request(("cp1",), ("r", "s"), 20, 4))
    assert least_poses(job, 0) == LEAST_POSES
    assert least_poses(job, 40) == 25


def test_it_is_enough_when_the_target_is_reached_or_little_is_to_gain() -> None:
    much, little = Forecast(2.0, 2.0, 1.5), Forecast(2.0, 2.0, 1.95)
    assert stop_reason(much, None, 20) == ""
    assert "by only 3%" in stop_reason(little, None, 20)
    assert "target of 2.5 mm" in stop_reason(much, 2.5, 20)
    assert stop_reason(much, 1.9, 20) == ""
    assert stop_reason(little, None, LEAST_POSES - 1) == ""
    assert stop_reason(little, None, 20, least=25) == ""
