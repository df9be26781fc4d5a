"""The machine controller's own frames: valve currents (200h) and pressures with oil temperature (201h).

The layout is that of `calibration/rigs/machine.dbc`, packed here by hand: little endian; currents in mA as signed
16 bit; pressures in 0.1 bar as unsigned 16 bit, temperature in degC + 40 as 8 bit, and a message counter of 4 bit.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from simulators.devices.can.bus import Frame
from simulators.hydraulics import (
    CURRENT_DITHER_MA,
    PRESSURE_NOISE_BAR,
    START_TEMPERATURE_DEGC,
    oil_temperature_degC,
    pump_bar,
    return_bar,
    valve_current_mA,
)

VALVE_CURRENTS = 0x200
PRESSURES = 0x201
VALVES = ("boom", "arm", "feed", "slew")  # in the order of the frame


@dataclass(frozen=True)
class MachineState:
    """Speeds and load on which the controller's signals depend.

    Attributes:
        speeds: valve name -> signed speed of its joint as a share of the maximum.
        boom_load_bar: pressure in the boom cylinder's lower side due to the load.
    """

    speeds: Mapping[str, float]
    boom_load_bar: float


class MachineSignals:
    """The machine controller as a sender of frames.

    Args:
        state: function that returns the machine's state at an instant in simulated seconds.
        rng: random generator for the noise of currents and pressures.
        period_s: cycle time of each frame.
    """

    def __init__(
        self,
        state: Callable[[float], MachineState],
        rng: np.random.Generator,
        *,
        period_s: float = 0.01,
    ) -> None:
        self._state = state
        self._rng = rng
        self._period_s = period_s
        self._next_s = 0.0
        self._counter = 0
        self._void_until = -math.inf

    def skip_frames(self, count: int) -> None:
        """Simulate lost frames: the message counter jumps by `count`."""
        self._counter = (self._counter + count) % 16

    def void(self, until_s: float) -> None:
        """Send `not available` (all ones) for pressures and temperature until `until_s`."""
        self._void_until = until_s

    def next_deadline(self) -> float:
        """Return the instant at which the next frames are due."""
        return self._next_s

    def poll(self, now_s: float) -> list[Frame]:
        """Return the frames that are due."""
        if now_s < self._next_s:
            return []
        late = now_s - self._next_s >= self._period_s
        self._next_s = (now_s if late else self._next_s) + self._period_s
        state = self._state(now_s)
        frames = [Frame(VALVE_CURRENTS, self._currents(state)), Frame(PRESSURES, self._pressures(state, now_s))]
        self._counter = (self._counter + 1) % 16
        return frames

    def _currents(self, state: MachineState) -> bytes:
        currents = []
        for valve in VALVES:
            speed = state.speeds.get(valve, 0.0)
            dither = self._rng.normal(0.0, CURRENT_DITHER_MA) if speed else 0.0
            currents.append(round(max(-2000.0, min(2000.0, float(valve_current_mA(speed)) + dither))))
        return struct.pack("<4h", *currents)

    def _pressures(self, state: MachineState, now_s: float) -> bytes:
        if now_s < self._void_until:
            return b"\xff" * 7 + bytes([self._counter | 0xF0])
        fastest = max((abs(s) for s in state.speeds.values()), default=0.0)
        temperature = float(oil_temperature_degC(now_s, START_TEMPERATURE_DEGC))
        bars = (float(pump_bar(fastest)), state.boom_load_bar, float(return_bar(state.speeds.get("boom", 0.0))))
        tenths = [max(0, min(6000, round(10 * (b + self._rng.normal(0.0, PRESSURE_NOISE_BAR))))) for b in bars]
        return struct.pack("<3HBB", *tenths, max(0, min(250, round(temperature + 40))), self._counter)
