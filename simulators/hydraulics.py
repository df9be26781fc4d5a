"""The hydraulics behind the machine's own signals: one set of laws for live frames and for whole tables.

Speeds are shares of a joint's `max_rate`, signed. All functions take scalars or arrays.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

VALVE_JOINTS: Mapping[str, str] = {"boom": "theta4", "arm": "theta1", "feed": "L3", "slew": "theta3"}
"""Which joint a valve moves, on machines that have one of that name."""

DEAD_BAND_MA = 180.0  # a spool starts to open
RATED_BAR = 200.0  # of the pump
CURRENT_DITHER_MA = 4.0
PRESSURE_NOISE_BAR = 0.4

_FULL_MA = 750.0
_IDLE_BAR = 22.0
_WORKING_BAR = 180.0
_RETURN_BAR = 12.0
_UNLOADED_BAR = 20.0
_BAR_PER_NM = 7e-4  # of the boom's lifting joint in its cylinder
START_TEMPERATURE_DEGC = 38.0  # of the oil, when the simulation begins
TEMPERATE_DEGC = 45.0  # of the oil, at which the machine has the lengths that were built

_WARM_DEGC = 55.0
_WARMING_S = 1500.0


def valve_current_mA(speed: ArrayLike) -> Floats:  # noqa: N802 - the unit is mA
    """Current of a proportional valve: none at rest, past the spool's overlap in any motion."""
    speed = np.asarray(speed, dtype=float)
    return np.where(speed == 0.0, 0.0, np.copysign(DEAD_BAND_MA + (_FULL_MA - DEAD_BAND_MA) * np.abs(speed), speed))


def pump_bar(fastest: ArrayLike) -> Floats:
    """Pressure of the pump; `fastest` is the greatest speed of any valve's joint, 0 or more."""
    fastest = np.asarray(fastest, dtype=float)
    return np.where(fastest == 0.0, _IDLE_BAR, _IDLE_BAR + _WORKING_BAR * np.minimum(1.0, 0.5 + fastest))


def return_bar(boom_speed: ArrayLike) -> Floats:
    """Back pressure of the boom cylinder's other side, higher while the boom goes down."""
    lowering: Floats = np.maximum(0.0, -np.asarray(boom_speed, dtype=float))
    return _RETURN_BAR + 40.0 * lowering


def boom_load_bar(torque_newton_m: ArrayLike) -> Floats:
    """Pressure that gravity's torque on the lifting joint puts on the lower side of the boom cylinder."""
    load: Floats = np.abs(np.asarray(torque_newton_m, dtype=float))
    return _UNLOADED_BAR + _BAR_PER_NM * load


def oil_temperature_degC(running_s: ArrayLike, start_degC: float) -> Floats:  # noqa: N802 - the unit is degC
    """Temperature of the oil of a machine that has run for a while; it warms towards 55 degC within an hour."""
    return _WARM_DEGC - (_WARM_DEGC - start_degC) * np.exp(-np.asarray(running_s, dtype=float) / _WARMING_S)


def motion_columns(speeds: Mapping[str, ArrayLike]) -> dict[str, Floats]:
    """Signals that follow from the machine's motion alone, before any sensor's noise.

    Args:
        speeds: joint -> speed, of all joints of a machine.

    Returns:
        `<valve>_valve_mA` for every valve whose joint there is, `pump_bar`, and `boom_b_bar` if a valve moves the boom;
        nothing for a machine that has no valve.
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
