"""Commands to a running rig: one JSON object per line, each answered by one JSON object.

    {"do": "aim", "target": "r"}                                    -> {"event": "aimed", ...}
    {"do": "move", "pose": {"theta1": 10, ...}, "speed": 0.25}      -> {"event": "moving", "seconds": ...}, "arrived"
    {"do": "fault", "kind": "lock_loss", "seconds": 4}              -> {"event": "accepted"}, later "fault"
    {"do": "truth", "prism": "r", "pose": {...}, "columns": {...}}  -> {"event": "truth", "x_mm": ..., ...}
    {"do": "control_points"}                                        -> {"event": "control_points", "points": {...}}
    {"do": "poses", "n": 5, "seed": 1}                              -> {"event": "poses", "poses": [{...}, ...]}
    {"do": "tracked"}                                               -> {"event": "tracked", "target": "r" or null}
    {"do": "quit"}                                                  -> {"event": "bye"}

A command that cannot be carried out is answered by {"event": "error", "text": ...}.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping

from simulators.devices.machine import Floats
from simulators.faults import make_fault
from simulators.rig_simulator import RigSimulator

Message = Mapping[str, object]

_MOST_POSES = 10_000


class Control:
    """Carries out commands.

    Attributes:
        finished: True after the command `quit`.

    Args:
        simulator: the rig.
    """

    def __init__(self, simulator: RigSimulator) -> None:
        self.finished = False
        self._simulator = simulator
        self._commands: Mapping[str, Callable[[Message, float], Message]] = {
            "aim": self._aim,
            "move": self._move,
            "fault": self._fault,
            "truth": self._truth,
            "control_points": self._control_points,
            "poses": self._poses,
            "tracked": self._tracked,
            "quit": self._quit,
        }

    def obey(self, line: bytes, now_s: float) -> Message:
        """Carry out the command in one line; return the answer."""
        try:
            command = json.loads(line)
            if not isinstance(command, dict):
                raise ValueError("a command must be a JSON object")
            action = self._commands.get(str(command.get("do")))
            if action is None:
                raise ValueError(f"unknown command {command.get('do')!r}; known: {', '.join(self._commands)}")
            return action(command, now_s)
        except (ValueError, RecursionError) as error:  # json's errors are ValueErrors
            return {"event": "error", "text": str(error)}

    def _aim(self, command: Message, now_s: float) -> Message:
        target = str(command.get("target", ""))
        self._simulator.aim(target, now_s)
        return {"event": "aimed", "target": target}

    def _move(self, command: Message, now_s: float) -> Message:
        pose = _numbers(command, "pose")
        if not pose:
            raise ValueError("move: pose names no joint")
        speed, dwell_s = _number(command, "speed", 0.25), _number(command, "dwell_s", 0.0)
        arrival_s = self._simulator.move(pose, now_s, speed=speed, dwell_s=max(0.0, dwell_s))
        return {"event": "moving", "seconds": arrival_s - now_s}

    def _fault(self, command: Message, now_s: float) -> Message:
        given = {k: v for k, v in command.items() if k not in ("do", "kind", "in_s")}
        fault = make_fault(str(command.get("kind")), now_s + _number(command, "in_s", 0.0), given)
        self._simulator.inject(fault)
        return {"event": "accepted", "kind": fault.kind}

    def _truth(self, command: Message, now_s: float) -> Message:
        machine, prism = self._simulator.machine, str(command.get("prism", ""))
        pose = _numbers(command, "pose") if "pose" in command else machine.motion.values(now_s)
        place = machine.prism_at_mm(prism, pose, _numbers(command, "columns"))
        return {"event": "truth", "prism": prism, **self._coordinates(place)}

    def _control_points(self, command: Message, now_s: float) -> Message:
        del command, now_s
        points = self._simulator.machine.control_points_mm
        return {"event": "control_points", "points": {n: self._coordinates(p) for n, p in points.items()}}

    def _coordinates(self, place_mm: Floats) -> dict[str, float]:
        turned = self._simulator.in_instrument_frame_mm(place_mm)
        return {f"{axis}_mm": float(value) for axis, value in zip("xyz", turned, strict=True)}

    def _poses(self, command: Message, now_s: float) -> Message:
        del now_s
        n = int(_number(command, "n", 1))
        if not 1 <= n <= _MOST_POSES:
            raise ValueError(f"poses: n = {n}; allowed: 1 to {_MOST_POSES}")
        seed = int(_number(command, "seed", 0))
        if seed < 0:
            raise ValueError(f"poses: seed = {seed}; it must not be negative")
        return {"event": "poses", "poses": self._simulator.machine.random_poses(n, seed)}

    def _tracked(self, command: Message, now_s: float) -> Message:
        del command
        return {"event": "tracked", "target": self._simulator.station.tracker.target(now_s)}

    def _quit(self, command: Message, now_s: float) -> Message:
        del command, now_s
        self.finished = True
        return {"event": "bye"}


def _number(command: Message, name: str, default: float) -> float:
    value = command.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{command.get('do')}: {name} = {value!r} is not a number")
    return float(value)


def _numbers(command: Message, name: str) -> dict[str, float]:
    value = command.get(name, {})
    if not isinstance(value, dict):
        raise ValueError(f"{command.get('do')}: {name} must be an object of names and numbers")
    return {str(key): _number({"do": command.get("do"), key: number}, key, 0.0) for key, number in value.items()}
