"""The hydraulics behind the machine's own signals: the same laws for live frames and for whole tables.

Speeds are signed shares of a joint's `max_rate`. All functions take scalars or arrays.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

VALVE_JOINTS: Mapping[str, str] = {"boom": "theta4", "arm": "theta1", "feed": "L3", "slew": "theta3"}
"""Valve -> joint that it moves, on machines with a joint of that name."""

DEAD_BAND_MA = 180.0  # current at which a spool starts to open
RATED_BAR = 200.0  # rated pressure of the pump
CURRENT_DITHER_MA = 4.0
PRESSURE_NOISE_BAR = 0.4

_FULL_MA = 750.0
_IDLE_BAR = 22.0
_WORKING_BAR = 180.0
_RETURN_BAR = 12.0
_UNLOADED_BAR = 20.0
_BAR_PER_NM = 7e-4  # cylinder pressure per torque on the boom's lifting joint
START_TEMPERATURE_DEGC = 38.0  # oil temperature at the start of the simulation
TEMPERATE_DEGC = 45.0  # oil temperature at which the machine has its built lengths

_WARM_DEGC = 55.0
_WARMING_S = 1500.0


def valve_current_mA(speed: ArrayLike) -> Floats:  # noqa: N802 - the unit is mA
    """Return the current of a proportional valve: zero at rest, above the spool's overlap in any motion."""
    speed = np.asarray(speed, dtype=float)
    return np.where(speed == 0.0, 0.0, np.copysign(DEAD_BAND_MA + (_FULL_MA - DEAD_BAND_MA) * np.abs(speed), speed))


def pump_bar(fastest: ArrayLike) -> Floats:
    """Return the pressure of the pump; `fastest` is the largest absolute speed of all valves' joints."""
    fastest = np.asarray(fastest, dtype=float)
    return np.where(fastest == 0.0, _IDLE_BAR, _IDLE_BAR + _WORKING_BAR * np.minimum(1.0, 0.5 + fastest))


def return_bar(boom_speed: ArrayLike) -> Floats:
    """Return the back pressure on the boom cylinder's upper side, which is higher while the boom is lowered."""
    lowering: Floats = np.maximum(0.0, -np.asarray(boom_speed, dtype=float))
    return _RETURN_BAR + 40.0 * lowering


def boom_load_bar(torque_newton_m: ArrayLike) -> Floats:
    """Return the pressure in the lower side of the boom cylinder due to gravity's torque on the lifting joint."""
    load: Floats = np.abs(np.asarray(torque_newton_m, dtype=float))
    return _UNLOADED_BAR + _BAR_PER_NM * load


def oil_temperature_degC(running_s: ArrayLike, start_degC: float) -> Floats:  # noqa: N802 - the unit is degC
    """Return the oil temperature after a running time; the oil warms towards 55 degC within about an hour."""
    return _WARM_DEGC - (_WARM_DEGC - start_degC) * np.exp(-np.asarray(running_s, dtype=float) / _WARMING_S)


def motion_columns(speeds: Mapping[str, ArrayLike]) -> dict[str, Floats]:
    """Return the signals that depend only on the machine's motion, without sensor noise.

    Args:
        speeds: joint -> speed, for all joints of a machine.

    Returns:
        `<valve>_valve_mA` for every valve whose joint the machine has, `pump_bar`, and `boom_b_bar` if a valve moves
        the boom; empty for a machine without valves.
    """
    by_valve = {valve: np.asarray(speeds[joint], float) for valve, joint in VALVE_JOINTS.items() if joint in speeds}
    if not by_valve:
        return {}
    fastest = np.max([np.abs(speed) for speed in by_valve.values()], axis=0)
    columns = {f"{valve}_valve_mA": valve_current_mA(speed) for valve, speed in by_valve.items()}
    columns["pump_bar"] = pump_bar(fastest)
    if "boom" in by_valve:
        columns["boom_b_bar"] = return_bar(by_valve["boom"])
    return columns
