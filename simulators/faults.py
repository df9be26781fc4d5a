"""What goes wrong, and when: a scripted or seeded schedule of faults.

As text: `KIND@SECONDS[:NAME=VALUE...]`, separated by commas: `lock_loss@30:seconds=4,node_reboot@45:node=33`.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

Parameter = str | float

# kind -> its parameters with what they are if not given; numbers are counts, seconds, or codes
KINDS: Mapping[str, Mapping[str, Parameter]] = {
    "lock_loss": {"seconds": 3.0},  # something stands in the line of sight
    "prism_jump": {"to": ""},  # the station follows another prism without a word; "": any other
    "bad_check": {"count": 1},  # records with a wrong block check
    "dropped_ack": {"count": 1},
    "joined_buffers": {"count": 1},  # acknowledgement and record in one buffer, its first byte lost
    "clutter": {"count": 12},  # random bytes before the next record
    "station_silent": {"seconds": 5.0},
    "node_silent": {"node": 0, "seconds": 3.0},  # node 0: the first one
    "node_reboot": {"node": 0},
    "emergency": {"node": 0, "code": 0x5000, "register": 0x81},
    "emergency_clear": {"node": 0},
    "alarm": {"node": 0, "bits": 1, "seconds": 2.0},  # 0 s: until an alarm with bits 0
    "warning": {"node": 0, "bits": 0x10},  # bits 0: the end of all warnings
    "preset_jump": {"node": 0, "counts": 1000},
    "counter_gap": {"count": 3},  # machine frames that never arrive
    "not_available": {"seconds": 1.0},  # machine signals all ones
    "bus_error": {"state": "passive"},  # warning, passive, bus_off, active, acknowledge
    "unplug": {"link": "can", "seconds": 2.0},  # can or station
}
_CHOICES: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("bus_error", "state"): ("warning", "passive", "bus_off", "active", "acknowledge"),
    ("unplug", "link"): ("can", "station"),
}


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong.

    Attributes:
        at_s: when, simulated seconds.
        kind: one of KINDS.
        parameters: all of the kind's.
    """

    at_s: float
    kind: str
    parameters: Mapping[str, Parameter]

    def number(self, name: str) -> float:
        """A numeric parameter."""
        return float(self.parameters[name])

    def count(self, name: str) -> int:
        """A whole-number parameter."""
        return int(float(self.parameters[name]))

    def text(self, name: str) -> str:
        """A textual parameter."""
        return str(self.parameters[name])


def make_fault(kind: str, at_s: float, given: Mapping[str, object]) -> Fault:
    """A checked fault.

    Raises:
        ValueError: unknown kind or parameter, or a value of the wrong sort; the message says what is known.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown fault {kind!r}; known: {', '.join(KINDS)}")
    if not math.isfinite(at_s) or at_s < 0:
        raise ValueError(f"fault {kind}: {at_s} is no instant; give seconds from the start")
    known = KINDS[kind]
    parameters: dict[str, Parameter] = dict(known)
    for name, value in given.items():
        if name not in known:
            raise ValueError(f"fault {kind} has no {name!r}; it has {', '.join(known)}")
        parameters[name] = _checked(kind, name, value, known[name])
    return Fault(at_s, kind, parameters)


def _checked(kind: str, name: str, value: object, default: Parameter) -> Parameter:
    if isinstance(default, str):
        allowed = _CHOICES.get((kind, name))
        if not isinstance(value, str) or (allowed and value not in allowed):
            raise ValueError(f"fault {kind}: {name} = {value!r}; allowed: {', '.join(allowed or ('a name',))}")
        return value
    try:
        number = float(int(value, 0)) if isinstance(value, str) and value.startswith("0x") else float(str(value))
    except ValueError:
        raise ValueError(f"fault {kind}: {name} = {value!r} is not a number") from None
    whole = isinstance(default, int)
    if not math.isfinite(number) or (whole and number != int(number)) or (number < 0 and name != "counts"):
        raise ValueError(f"fault {kind}: {name} = {value!r} is not a {'whole ' if whole else ''}number from 0 up")
    return int(number) if whole else number


def parse_faults(text: str) -> tuple[Fault, ...]:
    """A schedule from text (see the module's head); ValueError says what is wrong."""
    faults = []
    for part in (p.strip() for p in text.split(",")):
        if not part:
            continue
        head, *settings = part.split(":")
        kind, at, seconds = head.partition("@")
        try:
            at_s = float(seconds)
        except ValueError:
            raise ValueError(f"{part!r}: say when, as in {kind or 'lock_loss'}@30") from None
        pairs = [setting.partition("=") for setting in settings]
        if not at or any(not sign for _, sign, _ in pairs):
            raise ValueError(f"{part!r}: expected KIND@SECONDS[:NAME=VALUE...]")
        faults.append(make_fault(kind, at_s, {name: value for name, _, value in pairs}))
    return tuple(faults)


def random_faults(
    seed: int, duration_s: float, mean_interval_s: float, kinds: Iterable[str] = tuple(KINDS)
) -> tuple[Fault, ...]:
    """Faults at random instants (exponential intervals), of the given kinds with their usual parameters."""
    rng = np.random.default_rng([seed, 20])
    names = tuple(kinds)
    faults, at_s = [], float(rng.exponential(mean_interval_s))
    while at_s < duration_s:
        faults.append(make_fault(names[int(rng.integers(len(names)))], at_s, {}))
        at_s += float(rng.exponential(mean_interval_s))
    return tuple(faults)


class FaultSchedule:
    """Faults in the order of time; those of one instant in the order in which they were added."""

    def __init__(self, faults: Iterable[Fault] = ()) -> None:
        self._waiting: list[tuple[float, int, Fault]] = []
        self._number = 0
        for fault in faults:
            self.add(fault)

    def add(self, fault: Fault) -> None:
        """One more."""
        self._number += 1
        heapq.heappush(self._waiting, (fault.at_s, self._number, fault))

    def due(self, now_s: float) -> list[Fault]:
        """Those whose time has come; each is returned once."""
        out = []
        while self._waiting and self._waiting[0][0] <= now_s:
            out.append(heapq.heappop(self._waiting)[2])
        return out

    def next_deadline(self) -> float:
        """When the next one is due."""
        return self._waiting[0][0] if self._waiting else math.inf
