"""The simulated rig: its process, and the operator's actions of aiming the station and driving the boom.

The daemon communicates with it over two pseudo-terminals exactly as with a real rig. This module starts and stops the
process, aims the station at a prism, and drives the boom from pose to pose.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from daemon.config.config import ConfigError
from drivers.clock import ScaledClock

log = logging.getLogger(__name__)

BOOM_SPEED = 0.45  # share of the joints' greatest rates
_REFUSES = 2  # exit status of a simulator that cannot simulate what was requested
_ANSWER_S = 60.0
_HAND_S = 0.02  # period, in real time, of checking for new poses from the operator
_ENDED = "the simulated rig has ended; stop the daemon, and start both again with `rigcal run --sim`"
POSES_AHEAD = 30  # poses drawn at a time, and visited in order of distance


Stop = tuple[Mapping[str, float], float]  # joint -> deg or mm; how long to stand there, s


class SimulationError(Exception):
    """The simulated rig did not start, or refused a command."""


class SimulatedRig:
    """A rig simulated by a separate process, at the speed of a shared clock.

    Args:
        rig: name of a shipped rig, or path of a rig file.
        rates: joint name -> its greatest rate, deg/s or mm/s.
        directory: directory of the ports: `can` (an slcan adapter) and `station`.
        clock: clock shared with the process; its rate is the simulation's speed.
        station_delay_s: age of a measurement of the station when its record starts.
        seed: seed of the machine's imperfections, of all noise and of the poses.
        effects: hidden effects, in the simulator's notation.
        secret: directory in which the simulator names one more effect, drawn at random; none by default.

    Raises:
        ConfigError: an effect does not exist, or is not possible on this rig; the process has printed the reason on
            standard error.
        SimulationError: the process does not start.
    """

    def __init__(
        self,
        rig: str,
        rates: Mapping[str, float],
        directory: Path,
        clock: ScaledClock,
        *,
        station_delay_s: float = 0.0,
        seed: int = 1,
        effects: tuple[str, ...] = (),
        secret: Path | None = None,
    ) -> None:
        self.can_port = directory / "can"
        self.station_port = directory / "station"
        self._clock = clock
        self._seed = seed
        self._rates = rates
        self._events: deque[dict[str, Any]] = deque()
        self._arrived = threading.Condition()
        self._commands = threading.Lock()
        origin = f"{clock.origin.utc_ns},{clock.origin.monotonic_ns},{clock.origin.boot_id}"
        command = [sys.executable, "-m", "simulators", "--rig", rig, "--seed", str(seed), "--rate", str(clock.rate)]
        command += ["--origin", origin, "--can-port", str(self.can_port), "--station-port", str(self.station_port)]
        command += ["--bus-master", "host", "--signal-ms", "200", "--effects", ",".join(effects)]
        command += ["--latency-ms", str(station_delay_s * 1e3)]
        command += [] if secret is None else ["--secret", str(secret)]
        # In its own session, so that Ctrl-C ends only the daemon, which then ends the rig.
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        self._reader = threading.Thread(target=self._read, name="simulation", daemon=True)
        self._reader.start()
        self._stops: deque[Stop] = deque()
        self._stopping = threading.Event()
        self._autopilot: threading.Thread | None = None
        try:
            self._expect("ready")
        except SimulationError as error:
            self.close()
            if self._process.returncode == _REFUSES:
                raise ConfigError("the simulated rig refused its options; the reason is printed above") from error
            raise

    def has_ended(self) -> bool:
        """Return True if the process has ended."""
        return self._process.poll() is not None

    def aim(self, target: str) -> None:
        """Turn the station to a prism or a control point."""
        self._do("aim", "aimed", target=target)

    def move(self, pose: Mapping[str, float]) -> None:
        """Drive the joints (deg, mm) to `pose` and wait until they have arrived."""
        self._do("move", "moving", pose=dict(pose), speed=BOOM_SPEED)
        self._expect("arrived")

    def poses(self, number: int, seed: int) -> list[dict[str, float]]:
        """Draw random poses inside the joints' limits, deg or mm."""
        return list(self._do("poses", "poses", n=number, seed=seed)["poses"])

    def visit(self, stops: Iterable[Stop]) -> int:
        """Add poses to drive to next, in this order, and return how many are left to visit.

        Raises:
            SimulationError: the process has ended.
        """
        if self.has_ended():
            raise SimulationError(_ENDED)
        self._stops.extend(stops)
        return len(self._stops)

    def drive_around(self, dwell_s: float, *, is_by_hand: bool = False) -> None:
        """Drive from one random pose to the next until closed.

        Args:
            dwell_s: time to stand at each pose.
            is_by_hand: drive only to the poses of `visit`, and stand still otherwise.
        """
        drive = self._follow if is_by_hand else partial(self._drive, dwell_s)
        self._autopilot = threading.Thread(target=drive, name="autopilot", daemon=True)
        self._autopilot.start()

    def close(self) -> None:
        """End the process."""
        self._stopping.set()
        if self._process.stdin is not None and not self._process.stdin.closed:
            with contextlib.suppress(BrokenPipeError):  # the process ended before it read a command
                self._process.stdin.close()
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(timeout=5)
        if self._autopilot is not None:
            self._autopilot.join(timeout=5)
        if self._process.stdout is not None:
            self._process.stdout.close()

    def _drive(self, dwell_s: float) -> None:
        try:
            here: Mapping[str, float] = {}
            for seed in itertools.count(self._seed):
                ahead = self.poses(POSES_AHEAD, seed)
                while ahead:
                    stand_s = dwell_s
                    if self._stops:
                        here, stand_s = self._stops[0]
                    else:
                        ahead.sort(key=partial(self._way, here), reverse=True)
                        here = ahead.pop()
                    self.move(here)
                    if stand_s > 0.0 and self._clock.wait(self._stopping, stand_s):
                        return
                    if self._stops and self._stops[0][0] is here:
                        self._stops.popleft()
        except SimulationError as error:
            if not self._stopping.is_set():
                log.error("the simulated boom stands still: %s", error)

    def _follow(self) -> None:
        """Drive to the poses of `visit`, and stand at the last one until there is a new one."""
        try:
            while not self._stopping.wait(_HAND_S):
                if self._stops:
                    pose, stand_s = self._stops.popleft()
                    self.move(pose)
                    if self._stops and stand_s > 0.0 and self._clock.wait(self._stopping, stand_s):
                        return
        except SimulationError as error:
            if not self._stopping.is_set():
                log.error("the simulated boom stands still: %s", error)

    def _way(self, here: Mapping[str, float], there: Mapping[str, float]) -> float:
        """Return the time of the slowest joint from one pose to another, in units of the boom's speed."""
        return max((abs(there[name] - here[name]) / self._rates[name] for name in here), default=0.0)

    def _do(self, what: str, answer: str, **arguments: Any) -> dict[str, Any]:
        with self._commands:
            try:
                assert self._process.stdin is not None
                self._process.stdin.write(json.dumps({"do": what, **arguments}) + "\n")
                self._process.stdin.flush()
            except (OSError, ValueError) as error:
                raise SimulationError(_ENDED) from error
            return self._expect(answer, "error")

    def _expect(self, *wanted: str) -> dict[str, Any]:
        """Return the next event of the process whose kind is in `wanted`; other events keep their order."""

        def found() -> dict[str, Any] | None:
            return next((e for e in self._events if e["event"] in {*wanted, "ended"}), None)

        with self._arrived:
            if not self._arrived.wait_for(lambda: found() is not None, _ANSWER_S):
                raise SimulationError(f"the simulated rig did not answer {wanted[0]!r} within {_ANSWER_S:g} s")
            answer = found()
            assert answer is not None
            if answer["event"] != "ended":
                self._events.remove(answer)
        if answer["event"] != wanted[0]:
            raise SimulationError(f"the simulated rig: {answer['text']}" if "text" in answer else _ENDED)
        return answer

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with self._arrived:
                self._events.append(json.loads(line))
                self._arrived.notify_all()
        self._process.wait()
        with self._arrived:
            self._events.append({"event": "ended"})
            self._arrived.notify_all()
