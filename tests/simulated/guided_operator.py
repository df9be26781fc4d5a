"""A simulated operator who does what a guide says: drives, aims, and presses the button where one must.

The daemon runs with `--sim --by-hand`: boom and station move only as they are told here.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

Say = Callable[..., Any]
"""Sends a command with its arguments to the daemon and returns the result."""

PACE_S = 0.05


class GuidedOperator:
    """Follows the open guide.

    Attributes:
        taps: buttons that were pressed, beside the start.

    Args:
        say: asks the daemon.
        slack: share of each joint's tolerance by which a pose is missed.
    """

    def __init__(self, say: Say, slack: float = 0.5) -> None:
        self.taps = 0
        self._say, self._slack = say, slack
        self._obeyed = ""

    def follow(self, until: Callable[[Mapping[str, Any]], bool], limit_s: float = 200.0) -> dict[str, Any]:
        """Do step after step until the state is as wanted; returns that state.

        Raises:
            TimeoutError: it takes too long; the message has the step.
        """
        deadline = time.monotonic() + limit_s
        while True:
            state = dict(self._say("guide.state")["guide"])
            if until(state) or state["state"] != "open":
                return state
            if time.monotonic() > deadline:
                raise TimeoutError(f"step {state['step']}, messages {state['messages']}")
            self._obey(state)
            time.sleep(PACE_S)

    def _obey(self, state: Mapping[str, Any]) -> None:
        step = state["step"]
        if any("confirm-prism" in message["text"] for message in state["messages"]):
            self._say("session.confirm-prism", operator="Ada")  # an operator looks, and it is the prism
        if step["is_busy"] or step["id"] == self._obeyed:
            return
        self._obeyed = step["id"]
        match step["kind"]:
            case "shoot_control_point":
                self._say("simulation.aim", target=step["point"])
                if not step["is_detected"]:
                    self._press(step)
            case "change_prism":
                self._say("simulation.aim", target=state["prism"])
                self._press(step)
            case "go_to_pose" | "hold":
                self._say("simulation.visit", poses=[self._pose(state["joints"])])
            case "enough":
                ends = [
                    row for row in state["steps"] if row["kind"] == "shoot_control_point" and row["state"] == "to do"
                ]
                if step["is_detected"] and ends:
                    self._say("simulation.aim", target=ends[0]["title"].split()[2].rstrip(","))
                else:
                    self._press(step)

    def _press(self, step: Mapping[str, Any]) -> None:
        self._say("guide.done", step=step["id"])
        self.taps += 1

    def _pose(self, joints: list[dict[str, Any]]) -> dict[str, float]:
        """The target, missed by a part of the tolerance as hands on levers do, inside the limits."""
        pose = {}
        for number, joint in enumerate(joints):
            missed = joint["target"] + self._slack * joint["tolerance"] * (-1) ** number
            pose[f"{joint['name']}_{joint['unit']}"] = min(max(missed, joint["low"]), joint["high"])
        return pose
