"""A guided job with the whole daemon: `python -m tests.bench.guided_daemon`.

Four prisms and a check on a simulated rig that is moved as by hand, then the jobs, then the acceptance. Prints the
commands it took, and how long after each pose the gain meter knew of it.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from daemon.commands import CommandError
from tests.daemon.support.daemon_process import DaemonProcess
from tests.simulated.guided_operator import GuidedOperator


class Lag:
    """Seconds from the instant at which a pose was seen to be done to the instant at which the meter knew of it."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self._since: tuple[str, int, float] | None = None

    def look(self, state: Mapping[str, Any]) -> bool:
        """Note what a state shows; always False, as a guide is followed to its end."""
        poses, accuracy, session = state["poses"], state["accuracy"], state["session"]
        if poses is None or session is None or state["session_kind"] == "check":
            return False
        now, done = time.monotonic(), poses["done"]
        known = 0 if accuracy is None else accuracy["for_poses"]
        if self._since is not None and self._since[0] == session and known >= self._since[1]:
            self.seconds.append(now - self._since[2])
            self._since = None
        if known < done and (self._since is None or self._since[:2] != (session, done)):
            self._since = session, done, now
        return False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=8, help="most poses of a prism")
    parser.add_argument("--rate", type=float, default=10.0, help="simulated seconds per second")
    parser.add_argument("--seed", type=int, default=1000, help="of the simulated machine")
    parser.add_argument("--no-jobs", action="store_true", help="stop before the jobs and the acceptance")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        rig = ("--sim", "--by-hand", "--rate", str(options.rate), "--seed", str(options.seed))
        daemon = DaemonProcess(Path(directory), *rig, jobs=not options.no_jobs)
        try:
            daemon.wait("an answer", daemon.answers)
            daemon.say("simulation.aim", target="w")
            daemon.wait("a fix", daemon.has_fix)
            daemon.say(
                "guide.start",
                new_setup={"id": "S1", "instrument": "simulated"},
                prisms=["w", "b", "r", "s"],
                poses=options.poses,
            )
            lag, began = Lag(), time.monotonic()
            end = GuidedOperator(daemon.say).follow(lag.look, limit_s=3000.0)
            print(f"{end['state']} in {time.monotonic() - began:.0f} s; commands to the guide: {end['taps']}")
            print(
                f"the meter knew a pose after {np.median(lag.seconds):.2f} s in the median, {max(lag.seconds):.2f} "
                f"s at most, {np.mean(np.array(lag.seconds) <= 1.0):.0%} within 1 s, of {len(lag.seconds)} poses"
            )
            if options.no_jobs:
                return
            # A job is due a moment after the last session has ended.
            daemon.wait("a model", lambda: _awaiting(daemon)["jobs"] == 0 and _awaiting(daemon)["id"] is not None)
            awaiting = _awaiting(daemon)
            try:
                said = daemon.say("model.accept", id=awaiting["id"], operator="bench")["reason"]
            except CommandError as error:
                said = f"refused: {error}"
            print(f"commands with `model accept`: {end['taps'] + 1}; {said}")
        finally:
            daemon.stop()


def _awaiting(daemon: DaemonProcess) -> dict[str, Any]:
    return dict(daemon.say("guide.state")["guide"]["model"])


if __name__ == "__main__":
    main()
