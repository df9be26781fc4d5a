"""Runs of a creeping boom with every signal of its rig: what a tracking station sees of work, not of poses held.

A run goes from waypoint to waypoint. On the way some joints move, slowly and together; at each waypoint the boom
stands for a while. Fixes come from both. Each run is a `session`: rows of one know of each other, rows of two do not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import Rig
from simulators.hydraulics import (
    CURRENT_DITHER_MA,
    PRESSURE_NOISE_BAR,
    VALVE_JOINTS,
    boom_load_bar,
    motion_columns,
    oil_temperature_degC,
)
from simulators.rig.dataset import SimulatedObservations, prisms_mm, random_poses, travel_m
from simulators.rig.noise import read_joint, station_measured_mm
from simulators.rig.truth import RigTruth
from tests.simulated.observations import anchored_truth

Floats = NDArray[np.float64]
Strings = NDArray[np.str_]

_MOVING_FIXES, _STANDING_FIXES = 6, 2  # of one leg
_SHARE_THAT_MOVES = 0.7  # of the joints, in a leg
_PEAK_SPEEDS = 0.02, 0.2  # shares of the joints' maximum rate
_DWELL_S = 5.0, 40.0
_PAUSE_S = 60.0, 600.0  # between runs
_TIMING_SIGMA_S = 0.005  # of a fix against its joint readings
_RATE_OVER_S = 0.5  # readings that far apart give a rate
_ROD_KG, _MOST_RODS = 25.0, 4


@dataclass(frozen=True)
class _Path:
    """Where n fixes find the boom: (n, joints) values and rates, deg or mm and per second; (n,) times."""

    held: Floats
    rate: Floats
    direction: Floats
    elapsed_s: Floats
    dwell_s: Floats


def simulate_runs(
    truth: RigTruth,
    runs: int,
    fixes: int,
    seed: int,
    *,
    prisms: Sequence[str] | None = None,
    noise_mm: float | None = None,
    setup: str = "",
) -> SimulatedObservations:
    """Follow a boom through runs.

    Args:
        truth: the machine.
        runs: how many.
        fixes: of each run.
        seed: the same seed gives the same runs and noise.
        prisms: tracked in turn, one in each run; all of the rig's when absent.
        noise_mm: standard deviation of each coordinate; the rig's station noise when absent.
        setup: station set-up, also decides where the machine stands.

    Returns:
        Columns `prism`, the joints, x, y, z, `session`, `time_s`, `dwell_s`, `<joint>_dir`, `<joint>_rate`,
        `payload_kg` where the rig has one, and every channel of the rig that drives no row (`boom_valve_mA`,
        `pump_bar`, `temperature_degC`, ...), with the noise of their sensors. Fix and joint readings are 5 ms apart,
        give or take, which the oracle is not.
    """
    rig, rng = truth.rig, np.random.default_rng([seed, 11])
    names = tuple(rig.prism_names if prisms is None else prisms)
    paths = [_path(rig, fixes, rng) for _ in range(runs)]
    held, rate = np.vstack([p.held for p in paths]), np.vstack([p.rate for p in paths])
    run = np.repeat(np.arange(runs), fixes)
    joints = {j.name: held[:, i] for i, j in enumerate(rig.joints)}
    columns = _motion(rig, paths, rate, rng) | _machine(truth, joints, paths, run, setup, rng)
    columns |= motion_columns({j.name: rate[:, i] / j.max_rate for i, j in enumerate(rig.joints)})

    late_s = rng.normal(0.0, _TIMING_SIGMA_S, len(run))
    fixed = {j.name: held[:, i] + rate[:, i] * late_s for i, j in enumerate(rig.joints)}
    read = {j.name: read_joint(j, joints[j.name], rng) for j in rig.joints}
    prism: Strings = np.array(names, dtype=np.str_)[run % len(names)]
    seen = columns | travel_m(rig, joints)
    anchored = anchored_truth(truth, seen)
    true_mm, oracle_mm = (prisms_mm(anchored, prism, values, seen, setup=setup) for values in (fixed, read))
    if noise_mm is None:
        measured_mm = station_measured_mm(rig.station, true_mm, rng)
    else:
        measured_mm = true_mm + rng.normal(0.0, noise_mm, true_mm.shape)

    table: dict[str, Floats | Strings] = {"prism": prism}
    table |= {j.column: read[j.name] for j in rig.joints}
    table |= {f"{axis}_mm": measured_mm[:, i] for i, axis in enumerate("xyz")}
    if setup:
        table["setup"] = np.full(len(run), setup)
    table["session"] = np.char.add("run", run.astype(np.str_))
    return SimulatedObservations(table | _recorded(rig, columns, rng), measured_mm, oracle_mm)


def _path(rig: Rig, n: int, rng: np.random.Generator) -> _Path:
    most = np.array([j.max_rate for j in rig.joints])
    here = _waypoint(rig, rng)
    direction = rng.choice([-1.0, 1.0], len(most))
    clock_s = 0.0
    legs: list[_Path] = []
    for _ in range(-(-n // (_MOVING_FIXES + _STANDING_FIXES))):
        moves = rng.random(len(most)) < _SHARE_THAT_MOVES
        moves[rng.integers(len(most))] = True
        way = np.where(moves, _waypoint(rig, rng) - here, 0.0)
        direction = np.where(moves, np.sign(way), direction)
        # A cubic from rest to rest: its greatest rate is 1.5 times the mean one.
        peak = rng.uniform(*_PEAK_SPEEDS)
        duration_s = float(np.max(1.5 * np.abs(way) / (peak * most)))
        u = np.append(np.sort(rng.random(_MOVING_FIXES)), np.ones(_STANDING_FIXES))
        dwell_s = np.append(np.zeros(_MOVING_FIXES), np.sort(rng.uniform(*_DWELL_S, _STANDING_FIXES)))
        legs.append(
            _Path(
                here + np.outer(u**2 * (3.0 - 2.0 * u), way),
                np.outer(6.0 * u * (1.0 - u) / duration_s, way),
                np.tile(direction, (len(u), 1)),
                clock_s + u * duration_s + dwell_s,
                dwell_s,
            )
        )
        here = here + way
        clock_s = float(legs[-1].elapsed_s[-1])
    return _Path(
        np.vstack([leg.held for leg in legs])[:n],
        np.vstack([leg.rate for leg in legs])[:n],
        np.vstack([leg.direction for leg in legs])[:n],
        np.concatenate([leg.elapsed_s for leg in legs])[:n],
        np.concatenate([leg.dwell_s for leg in legs])[:n],
    )


def _waypoint(rig: Rig, rng: np.random.Generator) -> Floats:
    return np.concatenate(list(random_poses(rig, 1, rng).values()))


def _motion(rig: Rig, paths: Sequence[_Path], rate: Floats, rng: np.random.Generator) -> dict[str, Floats]:
    """Time, dwell, directions and rates."""
    time_s: list[Floats] = []
    for path in paths:
        begin_s = (float(time_s[-1][-1]) if time_s else 0.0) + rng.uniform(*_PAUSE_S)
        time_s.append(begin_s + path.elapsed_s)
    direction = np.vstack([p.direction for p in paths])
    columns = {"time_s": np.concatenate(time_s), "dwell_s": np.concatenate([p.dwell_s for p in paths])}
    columns |= {f"{j.name}_dir": direction[:, i] for i, j in enumerate(rig.joints)}
    return columns | {f"{j.name}_rate": rate[:, i] for i, j in enumerate(rig.joints)}


def _machine(
    truth: RigTruth,
    joints: Mapping[str, Floats],
    paths: Sequence[_Path],
    run: NDArray[np.intp],
    setup: str,
    rng: np.random.Generator,
) -> dict[str, Floats]:
    """Payload, load pressures, oil temperature and the rod feed: by run what no pose explains."""
    columns: dict[str, Floats] = {}
    if any(mass.payload for mass in truth.rig.masses):
        columns["payload_kg"] = _ROD_KG * rng.integers(0, _MOST_RODS + 1, len(paths)).astype(float)[run]
    if VALVE_JOINTS["boom"] in joints:
        torque = truth.gravity_load(VALVE_JOINTS["boom"], joints, columns, setup=setup)
        columns |= dict.fromkeys(("boom_a_bar", "boom_pressure_bar"), boom_load_bar(torque))
    oil = [oil_temperature_degC(rng.uniform(0, 3600) + p.elapsed_s, rng.uniform(10, 40)) for p in paths]
    return columns | {"temperature_degC": np.concatenate(oil), "rod_feed_mm": rng.uniform(0, 3000, len(paths))[run]}


def _recorded(rig: Rig, columns: Mapping[str, Floats], rng: np.random.Generator) -> dict[str, Floats]:
    """What is written of the machine's signals, if it has a sensor for them."""
    measured = {c.column for c in rig.channels} - {j.column for j in rig.joints}
    out: dict[str, Floats] = {}
    for name, values in columns.items():
        n = len(values)
        if name.endswith("_rate"):
            joint = rig.joint(name.removesuffix("_rate"))
            out[name] = values + rng.normal(0.0, np.sqrt(2.0) * joint.sigma / _RATE_OVER_S, n)
        elif name.endswith("_dir") or name in ("time_s", "dwell_s", "payload_kg"):
            out[name] = values
        elif name not in measured:
            continue
        elif name.endswith("_mA"):
            out[name] = np.rint(values + (values != 0.0) * rng.normal(0.0, CURRENT_DITHER_MA, n))
        elif name.endswith("_bar"):
            out[name] = np.rint(10.0 * (values + rng.normal(0.0, PRESSURE_NOISE_BAR, n))) / 10.0
        else:  # oil temperature and transducers count in whole units
            out[name] = np.rint(values)
    return out
