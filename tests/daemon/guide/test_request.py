"""What `guide.start` accepts."""

from __future__ import annotations

from typing import Any

import pytest

from calibration.rig.description import shipped_rig
from daemon.commands import CommandError
from daemon.guide.job import Job, Request
from daemon.guide.request import misfit, request_of

RIG = shipped_rig("swdt82")
POSE: dict[str, Any] = {joint.column: sum(joint.limits) / 2 for joint in RIG.joints}


def test_the_defaults_are_all_prisms_the_points_of_the_set_up_and_a_check() -> None:
    request = request_of({}, RIG, ["p1", "p2"])
    assert request.control_points == ("p1", "p2")
    assert request.prisms == RIG.prism_names
    assert (request.poses, request.check_poses, request.target_mm, request.plan) == (20, 4, None, None)
    assert request_of({}, RIG, []).control_points == ("cp1",)


def test_a_plan_comes_with_the_prisms_in_view() -> None:
    request = request_of({"plan": [POSE | {"pose": 1, "prisms": ["r"]}, POSE], "prisms": ["r", "s"]}, RIG, [])
    assert [len(request.planned(prism) or ()) for prism in ("r", "s")] == [2, 1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"prisms": ["r", "x"]}, "no prism 'x'"),
        ({"prisms": "r"}, "list of names"),
        ({"prisms": ["r", "r"]}, "twice"),
        ({"control_points": ["r"]}, "is a prism of the rig"),
        ({"control_points": ["a b"]}, "1 to 64 letters"),
        ({"poses": 0}, "whole number from 1"),
        ({"poses": True}, "whole number"),
        ({"check_poses": 2}, "3 to 5 poses, or 0"),
        ({"target_mm": 0}, "0.001 mm or more"),
        ({"target_mm": "1"}, "finite number"),
        ({"plan": []}, "list of 1 to 1000 poses"),
        ({"plan": [POSE], "poses": 5}, "not both"),
        ({"plan": [{"theta1_deg": 1.0}]}, "pose 1 of the plan has no theta3_deg"),
        ({"plan": [POSE | {"theta1_deg": 90.0}]}, "beyond its limits, -15 to 60"),
        ({"plan": [POSE | {"prisms": ["q"]}]}, "must be a list of"),
        ({"plan": [POSE | {"prisms": ["w"]}], "prisms": ["r"]}, "no pose of the plan has prism r in view"),
    ],
)
def test_what_no_guide_can_do_is_refused_with_its_reason(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(CommandError, match=message):
        request_of(arguments, RIG, [])


def test_a_guide_does_not_go_on_with_a_rig_file_of_other_joints_or_prisms() -> None:
    job = Job.of(request_of({"plan": [POSE], "prisms": ["r"]}, RIG, []))
    assert misfit(job, RIG) == ""
    assert "no prism r any more" in misfit(job, shipped_rig("ur10"))
    of_others = Request(("cp1",), ("r",), 1, 0, None, (({"theta1": 0.0}, ("r",)),))
    assert "have different joints" in misfit(Job.of(of_others), RIG)
