"""An operator who does at random what operators do, with the commands of any operator."""

from __future__ import annotations

import random
import threading
from collections import Counter
from typing import Any

from daemon.commands import CommandError
from tests.soak.daemon_process import DaemonProcess
from tests.soak.rig_process import RigProcess

PRISMS = ("r", "s", "b", "w")
CONTROL_POINTS = ("cp1", "cp2")
KINDS = ("static_poses", "multi_joint", "single_joint", "check")
QUESTIONS = ("session.list", "setup.list", "jobs.list", "model.list", "session.show", "status")


class Operator:
    """Holds sessions: control points first and last, or forgotten; stopped, or aborted.

    Args:
        daemon, rig: who obeys, whose clock counts.
        seed: what is done when.

    Attributes:
        done: command -> how often it was obeyed.
        refused: command and what it was refused for -> how often.
    """

    def __init__(self, daemon: DaemonProcess, rig: RigProcess, seed: int) -> None:
        self._daemon, self._rig = daemon, rig
        self._rng = random.Random(seed)
        self._stop = threading.Event()
        self._setups = 0
        self.done: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()

    def work(self, stop: threading.Event) -> None:
        """Until `stop`; a session may stay open."""
        self._stop = stop
        self._new_setup()
        while not stop.is_set():
            if self._rng.random() < 0.15:
                self._new_setup()
            self._session()
            self._pause(1.0, 6.0)

    def _session(self) -> None:
        kind = self._rng.choice(KINDS)
        if self._say("session.start", prism=self._rng.choice(PRISMS), kind=kind, operator="soak") is None:
            self._say("session.abort")  # one of a time before
            self._new_setup()
            return
        if self._rng.random() < 0.8:
            self._shoot()
        for _ in range(self._rng.randint(1, 4)):
            self._pause(4.0, 15.0)
            self._ask()
            self._look_after_the_prism()
        if self._rng.random() < 0.7:
            self._shoot()
        self._pause(1.0, 5.0)
        self._say("session.abort" if self._rng.random() < 0.25 else "session.stop")

    def _shoot(self) -> None:
        for point in CONTROL_POINTS:
            if not self._stop.is_set():
                self._say("session.shoot", point=point)

    def _look_after_the_prism(self) -> None:
        """Aim anew where the station's fixes are doubted, and say so when the prism is seen to be the session's."""
        status = self._say("status")
        session = status and status["session"]
        if not session or not session.get("prism_suspicions"):
            return
        if self._rig.tracked() != session["prism"]:
            self._rig.aim(session["prism"])
            self._pause(3.0, 6.0)
        if self._rig.tracked() == session["prism"]:
            self._say("session.confirm-prism", operator="soak")

    def _ask(self) -> None:
        question = self._rng.choice(QUESTIONS)
        if question == "session.show":
            sessions = self._say("session.list")
            if sessions:
                self._say(question, id=sessions[-1]["id"])
        else:
            self._say(question)

    def _new_setup(self) -> None:
        self._setups += 1
        self._say("setup.new", id=f"soak{self._setups}", instrument="simulated", tilt_arcsec=3.0, ppm=0.0)

    def _say(self, command: str, **arguments: Any) -> Any:
        try:
            result = self._daemon.say(command, **arguments)
        except CommandError as error:
            self.refused[f"{command}: {error!s:.90}"] += 1
            return None
        self.done[command] += 1
        return result

    def _pause(self, least_s: float, most_s: float) -> None:
        self._rig.clock.wait(self._stop, self._rng.uniform(least_s, most_s))
