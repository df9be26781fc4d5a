"""A simulated operator: starts the daemon with a simulated rig and holds sessions with the usual commands."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from daemon.cli.diagnosis import overload
from daemon.commands import CommandError
from daemon.control.protocol import request

RIG = "swdt82"
_OTHER_SETTINGS = """poll_interval_s = 0.25

[sessions]
settle_s = 2.0  # simulated time runs fast, so delays of the computer are longer in it
"""
PRISMS = ("r", "s", "b", "w")
CONTROL_POINTS = ("cp1", "cp2")
DWELL_S = 3.5
DEADLINE_S = 600.0
STUCK_S = 30.0  # without a new pose, until the progress mentions it

Advance = Callable[[str, int], None]
"""Called with a sentence on the progress and the number of steps done since the last call."""


class DemoError(Exception):
    """The demonstration did not finish; the message says where it stopped."""


class Operator:
    """Controls the demonstration's daemon with the commands that an operator would use.

    Args:
        directory: for configuration, store, models and report.
        rate: simulated seconds per second.
        seed: of the simulated machine.
        options: additional options of `rigcal run --sim`.
        settings: additional lines of the configuration.
    """

    def __init__(
        self, directory: Path, rate: float, seed: int, options: Sequence[str] = (), settings: str = ""
    ) -> None:
        from daemon.config.config import SIMULATED_CONFIG

        self._socket = directory / "control.sock"
        self._rate = rate
        config = directory / "rigcal.toml"
        written = SIMULATED_CONFIG.format(written_by="rigcal demo", rig=f'"{RIG}"')
        config.write_text(written + _OTHER_SETTINGS + settings, encoding="utf-8")
        command = [sys.executable, "-m", "daemon.cli.main", "run", "--sim", "--config", str(config)]
        command += ["--rate", str(rate), "--seed", str(seed), "--dwell", str(DWELL_S), *options]
        self._log = (directory / "daemon.log").open("w", encoding="utf-8")
        self._daemon = subprocess.Popen(command, stdout=self._log, stderr=self._log)

    def say(self, command: str, **arguments: Any) -> Any:
        """Send a command to the daemon."""
        return request(self._socket, command, arguments)

    def wait(self, what: str, done: Callable[[], bool], *, simulated_s: float = 0.0) -> None:
        """Wait until `done` returns True, which is checked five times a second.

        Args:
            what: what is waited for, for the error message.
            done: the condition.
            simulated_s: additional simulated time that the plan itself takes.

        Raises:
            DemoError: the daemon ended, or it took too long.
        """
        limit_s = DEADLINE_S + simulated_s / self._rate
        deadline = time.monotonic() + limit_s
        while not done():
            if self._daemon.poll() is not None:
                raise DemoError(f"the daemon ended while waiting for {what}; see {self._log.name}")
            if time.monotonic() > deadline:
                raise DemoError(f"waited {limit_s:.0f} s for {what}{self._why()}; see {self._log.name}")
            time.sleep(0.2)

    def _why(self) -> str:
        """Return a clause on why it takes so long, "" if unknown."""
        busy = overload()
        return f": {busy}, which is too much for --rate {self._rate:g}; use a lower rate" if busy else ""

    def pause(self, simulated_s: float) -> None:
        """Let simulated time pass without an open session; the boom keeps moving."""
        over = time.monotonic() + simulated_s / self._rate
        self.wait("the next round", lambda: time.monotonic() >= over, simulated_s=simulated_s)

    def begin(self) -> None:
        """Wait for the first fix, then record the station's set-up."""
        self.wait("the first fix", self._is_ready)
        self.say("setup.new", id="demo", instrument="simulated Topcon GTS-800A", tilt_arcsec=3.0, ppm=0.0)

    def record(
        self, prism: str, kind: str, poses: int, advance: Advance, planned: Sequence[dict[str, Any]] = ()
    ) -> str:
        """Hold one session: control points first and last, poses in between.

        Args:
            prism: the prism that the station is aimed at.
            kind: of the session.
            poses: least number of poses.
            advance: called for each pose.
            planned: rows of a pose plan that the boom is driven to; the session lasts until all were visited.

        Returns:
            The session's name.
        """
        name = str(self.say("session.start", prism=prism, kind=kind, operator="demo")["id"])
        self._shoot_control_points()
        seen = early = 0
        moved_at = time.monotonic()

        def recorded() -> int:
            return int(self.say("session.show", id=name)["poses"]) - early

        early = recorded()  # poses from before the control points, if a busy computer was slow to shoot these

        if planned:
            # After the control points, fixes count only once they are known to be of the prism.
            self.wait(f"a pose of prism {prism}", lambda: recorded() > 0)
            self.say("simulation.visit", poses=list(planned))

        def enough() -> bool:
            nonlocal seen, moved_at
            now = min(recorded(), poses)
            text = f"{kind.replace('_', ' ')} of prism {prism}: {now} of {poses}"
            if now > seen:
                advance(text, now - seen)
                seen, moved_at = now, time.monotonic()
            elif time.monotonic() - moved_at > STUCK_S:
                advance(f"{text}, no new pose for a while{self._why()}", 0)
            return now >= poses and not (planned and self.say("simulation.visit")["left"])

        stands_s = sum(float(row.get("dwell_s", 0.0)) for row in planned)
        self.wait(f"{poses} poses of prism {prism}", enough, simulated_s=stands_s)
        self._shoot_control_points()
        self.say("session.stop")
        return name

    def close(self) -> None:
        """Stop the daemon, which stops the simulated rig."""
        self._daemon.terminate()
        try:
            self._daemon.wait(timeout=30)
        except subprocess.TimeoutExpired:
            self._daemon.kill()
            self._daemon.wait()
        self._log.close()

    def _shoot_control_points(self) -> None:
        for point in CONTROL_POINTS:
            self.say("session.shoot", point=point)

    def _is_ready(self) -> bool:
        """Return True if the daemon answers and the station is locked to a prism."""
        try:
            stations = self.say("status")["acquisition"]["stations"]
        except CommandError:
            return False
        return any(station["fixes"] > 0 for station in stations)
